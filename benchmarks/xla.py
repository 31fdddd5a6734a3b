"""Time each workaround of `jaxfx._xla` against the plain form that it replaces.

    python -m benchmarks.xla

Prints a line per workaround: milliseconds of the plain form and of ours, and their ratio. A
workaround whose ratio is 1 on every supported release can be removed.
"""

import functools as ft
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxfx._xla import added, added_in_groups, apart, stored, sum_planes


SIZE = 512
REPEATS = 50


class Reproducer(NamedTuple):
    """Two functions of one array with equal values, the second with the workaround."""

    array: Array
    plain: Callable[[Array], Array]
    ours: Callable[[Array], Array]


def _shifted(padded: Array, count: int) -> list[Callable[[], Array]]:
    return [
        lambda k=k: (k + 1.0) * lax.dynamic_slice_in_dim(padded, k, SIZE) for k in range(count)
    ]


def _nine_reads(value: Array) -> Array:
    return ft.reduce(jnp.add, [value[k : k + SIZE - 9] for k in range(9)])


def reproducers() -> dict[str, Reproducer]:
    """By the name of the workaround."""
    noise = jax.random.uniform(jax.random.key(0), (SIZE, SIZE, 3))
    padded = jnp.pad(noise, ((20, 20), (0, 0), (0, 0)))
    plane = noise[..., 0]
    return {
        "apart": Reproducer(
            plane,
            lambda x: _nine_reads(jnp.exp(x)),
            lambda x: _nine_reads(apart(x, lambda: jnp.exp(x))),
        ),
        "stored": Reproducer(
            plane,
            lambda x: _nine_reads(jnp.exp(x)),
            lambda x: _nine_reads(stored(x[0, 0] >= 0, jnp.exp, x)),
        ),
        "added_in_groups": Reproducer(
            padded,
            lambda x: added(_shifted(x, 40)),
            lambda x: added_in_groups(x, _shifted(x, 40)),
        ),
        "sum_planes": Reproducer(
            noise, lambda x: jnp.sum(x * x, axis=-1), lambda x: sum_planes(x * x, -1)
        ),
    }


def milliseconds(function: Callable[[Array], Array], array: Array) -> float:
    """The least of many calls, which other work on the machine disturbs least."""
    compiled = jax.jit(function)
    compiled(array).block_until_ready()
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        compiled(array).block_until_ready()
        times.append(time.perf_counter() - begin)
    return 1e3 * min(times)


def main() -> None:
    print(f"JAX {jax.__version__}, {jax.default_backend()}, {SIZE} x {SIZE}, ms")
    print(f"{'workaround':<18}{'plain':>8}{'ours':>8}{'ratio':>8}")
    for name, (array, plain, ours) in reproducers().items():
        times = milliseconds(plain, array), milliseconds(ours, array)
        print(f"{name:<18}{times[0]:8.3f}{times[1]:8.3f}{times[0] / times[1]:8.1f}")


if __name__ == "__main__":
    main()
