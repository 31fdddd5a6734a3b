"""Shadows within an error."""

import functools as ft
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Num

from jaxfx._checks import Number, WholeNumber, parameter
from jaxfx.budget._plan import Plan, Search, Trial, check_call, plan, timed
from jaxfx.budget._tiles import blocks, spend
from jaxfx.shadow.arguments import filter_arguments
from jaxfx.shadow.compare import mean_comparison, set_up
from jaxfx.shadow.edge import candidates, edge_pcf
from jaxfx.shadow.pcf import pcf
from jaxfx.shadow.receivers import Receivers


# Pixels that tell how a smaller filter errs.
_SOME = 4096


class Filter(eqx.Module):
    """`shadow.pcf`, everywhere or where the mask by depth has it, to the same end.

    Of size 1 it is `shadow.hard`, and needs no mask. A bias that is left out is what the full
    filter needs, whatever the size, so that smaller filters differ from it by nothing else.
    """

    bias: Float[Array, ""] | None
    slope_bias: Float[Array, ""] | None
    full_size: int = eqx.field(static=True)
    size: int = eqx.field(static=True)
    masked: bool = eqx.field(static=True)

    @property
    def title(self) -> str:
        """What it is."""
        if self.size == 1:
            return "hard shadow"
        return f"shadow filtered {'where its edges are' if self.masked else 'everywhere'}"

    def __call__(self, shadow_map: Any, receivers: Any) -> Any:
        """As the effect."""
        data = (shadow_map, receivers, self.bias, self.slope_bias)
        *data, bias, slope_bias, _ = filter_arguments("shadow", *data, size=self.full_size)
        how = {"size": self.size, "bias": bias, "slope_bias": slope_bias}
        if self.masked and self.size > 1:
            return edge_pcf(*data, edges="depth", **how)
        return pcf(*data, **how)


class Picked(eqx.Module):
    """`shadow.pcf` in some pixels, row by row, the comparison alone in the others."""

    bias: Float[Array, ""] | None
    slope_bias: Float[Array, ""] | None
    size: int = eqx.field(static=True)
    pixels: Int[Array, " pixel"]
    title: ClassVar[str] = "shadow filtered in some pixels"

    def __call__(self, shadow_map: Any, receivers: Any) -> Any:
        """As the effect."""
        data = (shadow_map, receivers, self.bias, self.slope_bias)
        data = filter_arguments("shadow", *data, size=self.size)
        return _picked(self.size, self.pixels, *data[:4])


@ft.partial(jax.jit, static_argnums=0)
def _picked(size, pixels, shadow_map, receivers, bias, slope_bias):
    texels, places, some = _at(size, pixels, shadow_map, receivers, bias, slope_bias)
    soft = mean_comparison(texels, some, None, size, "box")
    result = mean_comparison(texels, places, None, 1, "box").reshape(-1)
    result = result.at[pixels].set(soft, mode="drop").reshape(receivers.z.shape)
    return jax.lax.stop_gradient(result).astype(receivers.z.dtype)


@ft.partial(jax.jit, static_argnums=0)
def _squares(size, pixels, *data):
    """The mean squared errors of all smaller filters in some pixels, from size 1 on."""
    texels, _, some = _at(size, pixels, *data)
    *less, full = (mean_comparison(texels, some, None, n, "box") for n in range(1, size + 1, 2))
    return [jnp.mean((each - full) ** 2) for each in less]


def _at(size, pixels, shadow_map, receivers, bias, slope_bias):
    """What is compared: the map, the places of all pixels, and those of some."""
    texels, places = set_up(shadow_map, receivers, bias, slope_bias, size)
    some = jax.tree.map(lambda x: x.reshape(-1).at[pixels].get(mode="clip"), places)
    return texels, places, some


def shadow(
    shadow_map: Num[ArrayLike, "rows columns"],
    receivers: Receivers,
    *,
    size: WholeNumber,
    bias: Float[ArrayLike, ""] | float | None = None,
    slope_bias: Float[ArrayLike, ""] | float | None = None,
    max_error: Number,
) -> Plan:
    """The quickest shadow within an error of `shadow.pcf` with a filter of `size`.

    Outside the mask by depth the hard shadow is the filtered one, inside it differs by less
    than 1: where the square root of the mask's share is within the error, the hard shadow is
    taken and nothing else is tried. Else the filter is tried in the pixels alone where it makes
    most of a difference on this scene, which knows no other scene; where the mask has it, if
    that is less, which costs no error; and the smallest filter that keeps to the error in 4096
    pixels of the mask.

    It costs one rendering for the proof, one by each way, and about as much as another two to
    find the mask and the pixels.

    **Arguments:**

    - `shadow_map`, `receivers`: height width, as in `shadow.pcf`.
    - `size`: static; odd, in texels, of the full filter.
    - `bias`, `slope_bias`: scene units and texels, as in `shadow.pcf`.
    - `max_error`: root mean square of the visibility, a ratio, over all pixels.

    **Returns:** a `Plan`, to be called with `shadow_map, receivers`.

    **Raises:** `ValueError` as `shadow.pcf`, for a negative `max_error` or traced data.

    **Gradient:** none through the choice; the plan's shadow has that of what it draws.
    """
    max_error = check_call("shadow", max_error, (shadow_map, receivers, bias, slope_bias))
    shadow_map = filter_arguments("shadow", shadow_map, receivers, bias, slope_bias, size=size)[
        0
    ]
    given = lambda name, each: None if each is None else parameter(f"shadow({name}=...)", each)
    biases, size = (given("bias", bias), given("slope_bias", slope_bias)), int(size)
    where = candidates(
        shadow_map, receivers, size=size, bias=biases[0], slope_bias=biases[1]
    ).where
    share = float(jnp.mean(where))
    by = lambda less, masked=True: Filter(*biases, size, less, masked)
    data, text = (shadow_map, receivers), "the filter"
    if share**0.5 <= max_error:
        why = f"it can't matter in more than {share:.2%} of the pixels."
        seconds = timed(by(1), data)[1]
        return plan(by(1), share**0.5, seconds, float("nan"), [f"{text}, for {why}"])
    search = Search(by(size, False), data, max_error)
    picked = _pick(search, by(1))
    few = np.count_nonzero(picked < where.size) / where.size
    if few:
        some = f"{text} but in {few:.1%} of the pixels, held fixed"
        search.measure(Picked(*biases, size, jnp.asarray(picked, jnp.int32)), some)
    # Fewer pixels, and no mask, can't take longer.
    if not 0 < few < share:
        outside = f"{text} outside of the {share:.1%} of the pixels where it matters"
        search.measure(by(size), outside)
    # Filters differ inside the mask alone, and so by how much can be told from some of it.
    inside = np.flatnonzero(where)
    inside = inside[np.linspace(0, inside.size - 1, min(_SOME, where.size)).astype(int)]
    probed = filter_arguments("shadow", *data, *biases, size=size)[:4]
    for smaller, square in zip(range(1, size, 2), _squares(size, inside, *probed), strict=True):
        less = text if smaller == 1 else f"a filter larger than {smaller} x {smaller}"
        if (square := share * float(square)) > max_error**2:
            search.tried.append(Trial(by(smaller), less, (square,), math.inf))
        elif search.measure(by(smaller), less).error <= max_error:
            break
    return search.plan()


def _pick(search: Search, hard: Filter) -> Int[np.ndarray, " pixel"]:
    """The pixels that need the filter, to whole blocks; those first where it matters most."""
    full = search.whole[1]
    squares = np.square(np.asarray(hard(*search.data) - full, float)).ravel()
    # All others take no step.
    differ = np.flatnonzero(squares)
    steps = np.pad(squares[differ, None], ((0, 0), (1, 0)))
    uses = np.zeros((1, full.size), bool)
    uses[0, differ] = spend(steps, search.max_error, full.size) == 0
    return np.concatenate(
        [np.zeros(0, int), *(part.pixels.ravel() for part in blocks(uses, [full]))]
    )
