"""Shadows within an error."""

import functools as ft
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, parameter
from jaxfx.budget._search import Search, Trial, check_call, plan, timed
from jaxfx.budget._tiles import blocks, spend
from jaxfx.budget.plan import Plan
from jaxfx.shadow.arguments import filter_arguments
from jaxfx.shadow.compare import mean_comparison, set_up
from jaxfx.shadow.edge import candidates, edge_pcf
from jaxfx.shadow.pcf import pcf
from jaxfx.shadow.receivers import Receivers


# Pixels of the mask from which the error of a smaller filter is estimated; fewer estimate it
# poorly, more take longer.
_SOME = 4096


class Filter(eqx.Module):
    """`shadow.pcf`, everywhere or only in the mask by depth, outside of which it is the same.

    Of size 1 it is `shadow.hard`, and needs no mask. A bias that is None is the default of the
    full filter, whatever the size, so that smaller filters differ from it by nothing else.
    """

    bias: Float[Array, ""] | None
    slope_bias: Float[Array, ""] | None
    full_size: int = eqx.field(static=True)
    size: int = eqx.field(static=True)
    masked: bool = eqx.field(static=True)

    @property
    def title(self) -> str:
        """Its name, for a plan that is printed."""
        if self.size == 1:
            return "hard shadow"
        return f"shadow filtered {'where its edges are' if self.masked else 'everywhere'}"

    def __call__(self, shadow_map: Any, receivers: Any) -> Any:
        """The visibility, called like `shadow.pcf`."""
        data = (shadow_map, receivers, self.bias, self.slope_bias)
        *data, bias, slope_bias, _ = filter_arguments("shadow", *data, size=self.full_size)
        options = {"size": self.size, "bias": bias, "slope_bias": slope_bias}
        if self.masked and self.size > 1:
            return edge_pcf(*data, edges="depth", **options)
        return pcf(*data, **options)


class Picked(eqx.Module):
    """`shadow.pcf` in some pixels, by their indices, `shadow.hard` in the others."""

    bias: Float[Array, ""] | None
    slope_bias: Float[Array, ""] | None
    size: int = eqx.field(static=True)
    pixels: Int[Array, " pixel"]
    title: ClassVar[str] = "shadow filtered in some pixels"

    def __call__(self, shadow_map: Any, receivers: Any) -> Any:
        """The visibility, called like `shadow.pcf`."""
        data = (shadow_map, receivers, self.bias, self.slope_bias)
        data = filter_arguments("shadow", *data, size=self.size)
        return _picked(self.size, self.pixels, *data[:4])


@ft.partial(jax.jit, static_argnums=0)
def _picked(size, pixels, shadow_map, receivers, bias, slope_bias):
    """The visibility of all pixels, filtered in `pixels`."""
    texels, places, some = _at(size, pixels, shadow_map, receivers, bias, slope_bias)
    soft = mean_comparison(texels, some, None, size, "box")
    result = mean_comparison(texels, places, None, 1, "box").reshape(-1)
    result = result.at[pixels].set(soft, mode="drop").reshape(receivers.z.shape)
    return jax.lax.stop_gradient(result).astype(receivers.z.dtype)


@ft.partial(jax.jit, static_argnums=0)
def _squares(size, pixels, *data):
    """The mean squared error in `pixels` of every smaller filter, from size 1 on."""
    texels, _, some = _at(size, pixels, *data)
    sizes = range(1, size + 1, 2)
    *smaller, full = (mean_comparison(texels, some, None, n, "box") for n in sizes)
    return [jnp.mean((visibility - full) ** 2) for visibility in smaller]


def _at(size, pixels, shadow_map, receivers, bias, slope_bias):
    """The padded map, the places in it of all receivers, and those of `pixels`."""
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

    For a shadow map that is looked up again and again.

    **Arguments:**

    - `shadow_map`, `receivers`: height width, as in `shadow.pcf`.
    - `size`: static; odd, in texels, of the full filter.
    - `bias`, `slope_bias`: as in `shadow.pcf`.
    - `max_error`: root mean square of the visibility, a ratio, over all pixels.

    **Returns:** a `Plan`, to be called with `shadow_map, receivers`.

    **Raises:** `ValueError` as `shadow.pcf`, for a negative `max_error` or traced data.

    **Gradient:** none through the choice; the plan's shadow has that of what it draws.

    **Example:** without an occluder nothing is filtered.

    >>> import numpy as np
    >>> from jaxfx import OrthographicCamera, budget, shadow
    >>> camera, depth = OrthographicCamera(4.0, [4.0, 4.0], np.eye(4)), np.full((8, 8), 2.0)
    >>> receivers = shadow.receivers(depth, camera, camera)
    >>> print(budget.shadow(depth, receivers, size=3, max_error=0.01).recipe.title)
    hard shadow

    Outside the mask by depth the hard shadow is the filtered one, inside it differs by less
    than 1: where the square root of the mask's share is within the error, the hard shadow is
    taken and nothing else is tried. Otherwise the candidates are: the filter in those pixels
    alone where it makes most of a difference, which holds for this scene only; the filter
    inside the mask, if that is smaller, which costs no error; and the smallest filter that
    keeps to the error in 4096 pixels of the mask.

    It costs one rendering for the proof, one by each candidate, and about as much as another
    two to find the mask and the pixels.
    """
    max_error = check_call("shadow", max_error, (shadow_map, receivers, bias, slope_bias))
    arguments = filter_arguments("shadow", shadow_map, receivers, bias, slope_bias, size=size)
    shadow_map = arguments[0]
    read = lambda name, value: (
        None if value is None else parameter(f"shadow({name}=...)", value)
    )
    biases, size = (read("bias", bias), read("slope_bias", slope_bias)), int(size)
    where = candidates(
        shadow_map, receivers, size=size, bias=biases[0], slope_bias=biases[1]
    ).where
    mask_share = float(jnp.mean(where))
    filtered = lambda smaller, masked=True: Filter(*biases, size, smaller, masked)
    data, text = (shadow_map, receivers), "the filter"
    if mask_share**0.5 <= max_error:
        why = f"it can't matter in more than {mask_share:.2%} of the pixels."
        seconds = timed(filtered(1), data)[1]
        return plan(filtered(1), mask_share**0.5, seconds, float("nan"), [f"{text}, for {why}"])
    search = Search(filtered(size, False), data, max_error)
    picked = _pick(search, filtered(1))
    few = np.count_nonzero(picked < where.size) / where.size
    if few:
        some = f"{text} but in {few:.1%} of the pixels, held fixed"
        search.measure(Picked(*biases, size, jnp.asarray(picked, jnp.int32)), some)
    # Fewer pixels, and no mask, can't take longer.
    if not 0 < few < mask_share:
        outside = f"{text} outside of the {mask_share:.1%} of the pixels where it matters"
        search.measure(filtered(size), outside)
    # Filters differ inside the mask alone: some of its pixels tell by how much.
    inside = np.flatnonzero(where)
    inside = inside[np.linspace(0, inside.size - 1, min(_SOME, where.size)).astype(int)]
    probed = filter_arguments("shadow", *data, *biases, size=size)[:4]
    for smaller, square in zip(range(1, size, 2), _squares(size, inside, *probed), strict=True):
        left_out = text if smaller == 1 else f"a filter larger than {smaller} x {smaller}"
        if (square := mask_share * float(square)) > max_error**2:
            search.tried.append(Trial(filtered(smaller), left_out, (square,), math.inf))
        elif search.measure(filtered(smaller), left_out).error <= max_error:
            break
    return search.plan()


def _pick(search: Search, hard: Filter) -> Int[np.ndarray, " pixel"]:
    """The pixels whose filter is kept for the error, in whole blocks: where it changes most."""
    full = search.whole[1]
    squares = np.square(np.asarray(hard(*search.data) - full, float)).ravel()
    # Pixels that do not differ cost nothing.
    differ = np.flatnonzero(squares)
    steps = np.pad(squares[differ, None], ((0, 0), (1, 0)))
    uses = np.zeros((1, full.size), bool)
    uses[0, differ] = spend(steps, search.max_error, full.size) == 0
    return np.concatenate(
        [np.zeros(0, int), *(part.pixels.ravel() for part in blocks(uses, [full]))]
    )
