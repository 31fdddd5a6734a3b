"""A process with eight devices, which answers what effects are there, a line of JSON each.

`python -m tests.sharding.worker` reads lines `{"check": NAME, ...}` with that function's other
arguments. JAX counts its devices once, so that they can't be made in the process of the tests:
`XLA_FLAGS` makes them in this one.
"""

import json
import re
import sys
import traceback

import equinox as eqx
import jax
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from tests.helpers import quick
from tests.test_transforms import CASES


DEVICES = 8
COLLECTIVE = re.compile(
    r"\b(all-gather|all-reduce|all-to-all|collective-permute|reduce-scatter"
    r"|collective-broadcast)(?:-start)?\("
)


def collectives(compiled):
    """The names of the collectives in a compiled program, as often as they occur."""
    return COLLECTIVE.findall(compiled.as_text())


def error(found, expected):
    """The largest difference between two trees, against 1 or the expected value."""
    worst = 0.0
    for pair in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        x, y = (np.asarray(leaf).astype(float) for leaf in pair)
        np.testing.assert_array_equal(np.isfinite(x), np.isfinite(y))
        is_finite = np.isfinite(y)
        difference = np.abs(x - y, where=is_finite, out=np.zeros_like(y))
        scale = np.maximum(np.abs(y, where=is_finite, out=np.ones_like(y)), 1)
        worst = max(worst, float(np.max(difference / scale, initial=0)))
    return worst


def mesh_of(kind, shape=(DEVICES,), names=("batch",)):
    """A mesh of JAX's own default, whose axes are explicit, or of automatic axes."""
    types = {} if kind == "explicit" else {"axis_types": (AxisType.Auto,) * len(names)}
    mesh = jax.make_mesh(shape, names, **types)
    assert (AxisType.Explicit in mesh.axis_types) == (kind == "explicit")
    return mesh


def stacked(name, size):
    """The function of a case, with its gradient or without, and a batch of its arguments."""
    cases = [CASES[name].split(eqx.is_array, size=size, seed=seed) for seed in range(DEVICES)]
    call = cases[0][0]

    def with_gradient(arguments):
        floats, others = eqx.partition(arguments, eqx.is_inexact_array)
        out, pull = jax.vjp(lambda floats: call(eqx.combine(floats, others)), floats)
        return out, pull(out)[0]

    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *(case[1] for case in cases))
    return call, with_gradient, batch


def batch(name, mesh, gradient=True, size=(9, 7), shape=(DEVICES,), names=("batch",)):
    """A batch of a case over eight devices against one device.

    `mesh` is "explicit" or "auto", for `jit(vmap(f))`, or "shard_map".
    """
    call, with_gradient, batch = stacked(name, size)
    mapped = jax.vmap(with_gradient if gradient else call)
    expected = jax.jit(mapped)(batch)
    devices, spec = mesh_of(mesh, shape, names), PartitionSpec(names[0])
    placed = jax.device_put(batch, NamedSharding(devices, spec))
    if mesh == "shard_map":
        mapped = jax.shard_map(mapped, mesh=devices, in_specs=spec, out_specs=spec)
    compiled = jax.jit(mapped).lower(placed).compile()
    found = compiled(placed)
    # What is 0 whatever the data are is computed of none, and lies anywhere.
    is_spread = all(
        leaf.sharding.spec[:1] == spec[:1] or not np.any(leaf)
        for leaf in jax.tree.leaves(found)
    )
    return {
        "error": error(found, expected),
        "collectives": collectives(compiled),
        "is_spread": is_spread,
    }


CHECKS = {"batch": batch}


def main():
    """Answer until the input ends."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_rank_promotion", "raise")
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    assert jax.device_count() == DEVICES
    with quick.quickly():
        for line in sys.stdin:
            asked = json.loads(line)
            try:
                answer = CHECKS[asked.pop("check")](**asked)
            except Exception:
                answer = {"failed": traceback.format_exc()}
            print("answer", json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
