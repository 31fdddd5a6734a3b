"""Depth of field by sprites in order of depth, each as visible as what is nearer leaves it."""

import functools as ft
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, whole_number
from jaxfx._loops import scan
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import absolute, clip01
from jaxfx.dof.arguments import check_arguments, defocused, with_own
from jaxfx.dof.kernels._tiles import sum_all
from jaxfx.dof.spoiled import spoiled
from jaxfx.dof.sprites import POINT_RADIUS, coverage, reach, row_half_width
from jaxfx.lens import Lens


# Opacity below this counts as 0: guards a quotient.
_LEAST = 1e-12


@on_any_mesh
def depth_sorted(
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    lens: Lens,
    *,
    max_coc: Number | None = None,
    slices: WholeNumber | Literal["all"] = 8,
) -> Float[Array, "height width channel"]:
    """Depth of field by point sprites in order of depth: each fills what nearer ones leave.

    A blurred edge hides what is behind it by the share of the lens that it covers, with no
    amplification to be set. Kept for comparison: `layered` does this more exactly.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background; 0, negative
      or NaN where it is missing.
    - `lens`: gives each depth its signed defocus, in pixels.
    - `max_coc`: static; the largest diameter, in pixels. Larger sprites are clamped to it.
      Outside `jit`, `grad` and `vmap` it may be left out and is then taken from the data.
    - `slices`: static; steps of the order, equal in defocus from `-max_coc` to `max_coc`. A
      sprite is shared between the two nearest, so that nothing jumps. `"all"` orders every
      sprite by its own depth, in time pixels times taps squared: the oracle.

    **Returns:** height width channel, in the type of `image`. A pixel that is not a number
    spoils `max_coc / 2` pixels about it, and no more. One whose depth is missing has no sprite:
    it shows what reaches it or, where nothing does, its own colour.

    **Raises:** `ValueError` for a wrong shape, an integer image, no lens, a bad `slices`, or no
    `max_coc` under a transform.

    **Gradient:** exact with respect to `image`, `depth` and every field of `lens`; in the last
    two, zero where a circle is below a pixel or above `max_coc`. With `slices="all"` that of
    the order itself is missing: where two surfaces change places, the result jumps.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import ThinLens, dof
    >>> image, depth = jnp.ones((8, 8, 3)), jnp.full((8, 8), 4.0)
    >>> lens = ThinLens(aperture=0.1, focus_distance=2.0, focal_pixels=100.0)
    >>> dof.depth_sorted(image, depth, lens).shape
    (8, 8, 3)

    Every source pixel p covers a share `a_p = coverage(q - p; C_p / 2) / area(C_p / 2)` of the
    lens as q sees it. From front to back, each sprite is visible in what the nearer ones have
    left: `v_p = clamp(1 - sum of nearer a, 0, a_p)`, in one proportion for all of equal depth;
    the result is the mean under v. Sprites of one surface add up to 1 at any slant and in any
    order, so that an opaque plane stays opaque.

    What is hidden in the image is missing: under a blurred edge the background is taken from
    the rest of it. Shares of two surfaces are taken to be disjoint, so that two overlapping
    blurred edges hide too much.

    Source: Potmesil & Chakravarty 1981, partial visibility of a sprite; Demers 2004, blending
    in order of depth. Reconstructed: the order is kept front to back, since "over" of single
    sprites lets 1/e of what is behind through an opaque surface. Our own: slices that share
    sprites.
    """
    image, depth, lens, max_coc = check_arguments("depth_sorted", image, depth, lens, max_coc)
    if not (isinstance(slices, str) and slices == "all"):
        expected = 'a positive integer or "all"'
        slices = whole_number("depth_sorted(slices=...)", slices, expected=expected)
    return _depth_sorted(image, depth, lens, max_coc, slices)


@ft.partial(jax.jit, static_argnames=("max_coc", "slices"))
def _depth_sorted(image, depth, lens, max_coc, slices):
    dtype = image.dtype
    image, defocus, missing, lost, bad = defocused(image, depth, lens, max_coc)
    coc = absolute(defocus)
    radius = jnp.where(coc / 2 < POINT_RADIUS, POINT_RADIUS, coc / 2)
    value = jnp.concatenate([image, jnp.ones_like(image[..., :1])], axis=-1)
    value = value / (jnp.pi * radius * radius)[..., None]
    value = jnp.where(missing[..., None], 0, value)
    far = reach(max_coc)
    if slices == "all":
        sums = _in_order(value, radius, depth.astype(image.dtype), far)
    else:
        sums = _in_slices(value, radius, defocus / max_coc, far, slices)
    sums = with_own(sums, image, missing)
    result = sums[..., :-1] / sums[..., -1:]

    spoils = spoiled(bad, jnp.abs(defocus), max_coc) | lost
    return jnp.where(spoils[..., None], jnp.nan, result).astype(dtype)


def _in_slices(
    value: Float[Array, "height width value"],
    radius: Float[Array, "height width"],
    place: Float[Array, "height width"],
    far: int,
    slices: int,
) -> Float[Array, "height width value"]:
    """The visible sums, slice by slice; `place` is the defocus over `max_coc`, -1 to 1."""
    place = (place + 1) / 2 * (slices - 1)

    def add_slice(carry, index):
        sums, covered = carry
        share = 1 - absolute(place - index)
        within = share > 0
        # A sprite of another slice is a point, so that it reaches no further than itself.
        part = jnp.where(within, share, 0)[..., None] * value
        added = sum_all(part, jnp.where(within, radius, POINT_RADIUS), far)
        opacity = added[..., -1:]
        visible = clip01((1 - covered) / jnp.maximum(opacity, _LEAST))
        return (sums + visible * added, covered + opacity), None

    start = jnp.zeros_like(value), jnp.zeros_like(value[..., :1])
    indices = jnp.arange(slices, dtype=value.dtype)
    (sums, _), _ = scan(jax.checkpoint(add_slice), start, indices)
    return sums


def _in_order(
    value: Float[Array, "height width value"],
    radius: Float[Array, "height width"],
    depth: Float[Array, "height width"],
    far: int,
) -> Float[Array, "height width value"]:
    """The visible sums, with every sprite at its own depth: the oracle."""
    height, width = radius.shape
    side = jnp.arange(-far, far + 1)
    rows, columns = (x.reshape(-1) for x in jnp.meshgrid(side, side))

    def pad(x, fill):
        margins = [(far, far)] * 2 + [(0, 0)] * (x.ndim - 2)
        return jnp.pad(x, margins, constant_values=fill)

    value, radius, depth = pad(value, 0), pad(radius, 1), pad(depth, jnp.inf)

    def seen(x, row, column):
        start = (far - row, far - column) + (0,) * (x.ndim - 2)
        return jax.lax.dynamic_slice(x, start, (height, width, *x.shape[2:]))

    def tap(offset):
        row, column = offset
        half_width = row_half_width(seen(radius, row, column), row)
        cover = coverage(half_width, column)
        return cover[..., None] * seen(value, row, column), seen(depth, row, column)

    taps, depths = jax.lax.map(tap, (rows, columns))
    opacity = taps[..., -1]

    def add_tap(sums, one):
        added, place = one
        nearer = jnp.sum(jnp.where(depths < place[None], opacity, 0), axis=0)
        beside = jnp.sum(jnp.where(depths == place[None], opacity, 0), axis=0)
        visible = clip01((1 - nearer) / jnp.maximum(beside, _LEAST))
        return sums + visible[..., None] * added, None

    start = jnp.zeros_like(taps[0])
    return scan(jax.checkpoint(add_tap), start, (taps, depths))[0]
