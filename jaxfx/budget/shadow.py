"""Shadows within an error."""

import functools as ft
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxfx._numerics import parameter
from jaxfx.budget._plan import Plan, Search, check_call, plan, timed
from jaxfx.budget._tiles import blocks, spend
from jaxfx.shadow import _taps
from jaxfx.shadow.edge import candidates, edge_pcf
from jaxfx.shadow.pcf import average, hard, pcf
from jaxfx.shadow.receivers import Receivers


class Hard(eqx.Module):
    """`shadow.hard`."""

    bias: Float[Array, ""]
    slope_bias: Float[Array, ""]
    title: ClassVar[str] = "hard shadow"

    def __call__(self, shadow_map: Any, receivers: Any) -> Any:
        """As the effect."""
        return hard(shadow_map, receivers, bias=self.bias, slope_bias=self.slope_bias)


class Everywhere(eqx.Module):
    """`shadow.pcf`."""

    bias: Float[Array, ""]
    slope_bias: Float[Array, ""]
    size: int = eqx.field(static=True)
    title: ClassVar[str] = "shadow filtered everywhere"

    def __call__(self, shadow_map: Any, receivers: Any) -> Any:
        """As the effect."""
        return pcf(
            shadow_map, receivers, size=self.size, bias=self.bias, slope_bias=self.slope_bias
        )


class Edge(eqx.Module):
    """`shadow.edge_pcf` with the mask by depth, which is `shadow.pcf` of its size exactly."""

    bias: Float[Array, ""]
    slope_bias: Float[Array, ""]
    size: int = eqx.field(static=True)
    title: ClassVar[str] = "shadow filtered where its edges are"

    def __call__(self, shadow_map: Any, receivers: Any) -> Any:
        """As the effect."""
        return edge_pcf(
            shadow_map,
            receivers,
            size=self.size,
            bias=self.bias,
            slope_bias=self.slope_bias,
            mask="depth",
        )


class Picked(eqx.Module):
    """`shadow.pcf` in some pixels, row by row, `shadow.hard` in the others."""

    bias: Float[Array, ""]
    slope_bias: Float[Array, ""]
    size: int = eqx.field(static=True)
    pixels: Int[Array, " pixel"]
    title: ClassVar[str] = "shadow filtered in some pixels"

    def __call__(self, shadow_map: Any, receivers: Any) -> Any:
        """As the effect."""
        data = (shadow_map, receivers, self.bias, self.slope_bias)
        data = _taps.checked("shadow", *data, size=self.size)
        return _picked(*data[:4], self.size, self.pixels)


@ft.partial(jax.jit, static_argnames=("size",))
def _picked(shadow_map, receivers, bias, slope_bias, size, pixels):
    dtype = _taps.common_dtype(shadow_map, receivers)
    texels = _taps.pad_map(shadow_map, size, dtype)
    places = _taps.find_places(receivers, bias, slope_bias, shadow_map.shape, size, dtype)
    some = jax.tree.map(lambda x: x.reshape(-1).at[pixels].get(mode="clip"), places)
    soft = average(texels, some, None, size, "box")
    result = average(texels, places, None, 1, "box").reshape(-1)
    result = result.at[pixels].set(soft, mode="drop").reshape(receivers.z.shape)
    return jax.lax.stop_gradient(result).astype(receivers.z.dtype)


def shadow(
    shadow_map: Float[ArrayLike, "rows columns"],
    receivers: Receivers,
    *,
    size: int,
    bias: Float[ArrayLike, ""] | float = 0.0,
    slope_bias: Float[ArrayLike, ""] | float = 0.0,
    max_error: int | float,
) -> Plan:
    """The quickest shadow within an error of `shadow.pcf` with a filter of `size`.

    Outside the mask by depth the hard shadow is the filtered one, inside it differs by less
    than 1: where the square root of the mask's share is within the error, the hard shadow is
    taken and nothing else is tried. Else the filter is tried where the mask has it, which costs
    no error; in the pixels alone where it makes most of a difference on this scene, which needs
    no mask, but knows no other scene; and smaller filters.

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
    biases = (
        parameter("shadow(bias=...)", bias),
        parameter("shadow(slope_bias=...)", slope_bias),
    )
    where = candidates(
        shadow_map, receivers, size=size, bias=biases[0], slope_bias=biases[1], mask="depth"
    ).where
    share = float(jnp.mean(where))
    text = "the filter"
    data = (shadow_map, receivers)
    if share**0.5 <= max_error:
        why = f"it can't matter in more than {share:.2%} of the pixels."
        seconds = timed(Hard(*biases), data)[1]
        return plan(Hard(*biases), share**0.5, seconds, float("nan"), [f"{text}, for {why}"])
    search = Search(Everywhere(*biases, size), data, max_error)
    outside = f"the filter outside of the {share:.1%} of the pixels where it matters"
    search.trial(Edge(*biases, size), outside)
    picked = _pick(search, Hard(*biases))
    if picked.size:
        few = np.count_nonzero(picked < where.size) / where.size
        some = f"the filter but in {few:.1%} of the pixels, held fixed"
        search.trial(Picked(*biases, size, jnp.asarray(picked, jnp.int32)), some)
    for smaller in range(1, size, 2):
        call = Hard(*biases) if smaller == 1 else Edge(*biases, smaller)
        less = text if smaller == 1 else f"a filter larger than {smaller} x {smaller}"
        if search.trial(call, less).error <= max_error:
            break
    return search.plan()


def _pick(search: Search, hard: Hard) -> Int[np.ndarray, " pixel"]:
    """The pixels that need the filter, to whole blocks; those first where it matters most."""
    (full,) = search.references
    squares = np.square(np.asarray(hard(*search.whole[0].data) - full, float)).reshape(-1, 1)
    steps = spend(np.pad(squares, ((0, 0), (1, 0))), search.max_error, full.size)
    pixels = [np.asarray(part.pixels) for part in blocks((steps == 0)[None], [full])]
    return pixels[0].reshape(-1) if pixels else np.zeros(0, int)
