"""Depth of field by a few taps per pixel, mixed from the image and a low-resolution one."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, check, parameter, whole_number
from jaxfx._loops import scan
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import absolute, clip01
from jaxfx._platform import by_platform
from jaxfx._sampling import bilinear, pixel_centers
from jaxfx.dof._discs import POISSON, vogel
from jaxfx.dof.arguments import check_arguments, defocused, with_own
from jaxfx.lens import Lens


# The side of a low-resolution pixel, and the disc's radius in those pixels (Scheuermann 2004).
_SIDE = 4
_LOW_RADIUS = 0.4


@on_any_mesh
def gather(
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    lens: Lens,
    *,
    max_coc: Number | None = None,
    taps: WholeNumber | None = None,
    ramp: Float[ArrayLike, ""] | float = 1.0,
) -> Float[Array, "height width channel"]:
    """Depth of field by a few taps on each pixel's circle of confusion. Kept for comparison.

    A pixel gathers over its own circle of confusion, not over those that reach it: a blurred
    foreground keeps a hard rim before a background in focus. Eight taps are too few for circles
    of confusion beyond some 10 pixels.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background; 0, negative
      or NaN where it is missing.
    - `lens`: gives each depth its signed defocus, in pixels.
    - `max_coc`: static; the largest diameter, in pixels, to which larger ones are clamped, and
      that of a pixel whose b is 1. Outside `jit`, `grad` and `vmap` it may be left out.
    - `taps`: how many, on a Vogel spiral; None for the paper's eight Poisson points.
    - `ramp`: pixels; the difference in defocus over which a tap goes from behind to in front. 0
      is the paper's own step, `D_tap >= D_q`.

    **Returns:** height width channel, in the type of `image`. A pixel that is not a number
    spoils what reads it: 0.8 `max_coc` + 10 pixels away along each axis, at the most. One whose
    depth is missing is read by no other, and keeps its own colour.

    **Raises:** `ValueError` for a wrong shape, an integer image, no lens, a negative
    `ramp`, a bad `taps`, or no `max_coc` under a transform.

    **Gradient:** exact with respect to `image`, `depth`, `ramp` and every field of `lens`;
    zero where a circle is clamped. On the focus plane, where taps leave the pixel's centre, the
    slopes between pixels are those to the right and below. With a `ramp` of 0 the
    derivative of the leak test is missing.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import ThinLens, dof
    >>> image, depth = jnp.ones((8, 8, 3)), jnp.full((8, 8), 4.0)
    >>> lens = ThinLens(aperture=0.1, focus_distance=2.0, focal_pixels=100.0)
    >>> dof.gather(image, depth, lens).shape
    (8, 8, 3)

    With the signed defocus D, the circle of confusion C and the blurriness b = C / `max_coc`,
    the result at q is the mean of the taps `q + disc[i] * C_q / 2`, each

    - mixed from the image and a low-resolution one (a quarter of the width and the height,
      blurred by a 3x3 Gaussian, read at 0.4 of the radius in its own pixels) by the tap's b;
    - weighted by 1 if the tap lies behind q, and by its own b if it lies in front: so that a
      surface in focus does not leak onto what is behind it.

    Source: Scheuermann 2004, advanced depth of field: the low-resolution image, the taps, the
    scales and the leak test. Reconstructed: the border of an image whose sides are no multiples
    of 4 (its last row and column are repeated). Our own: the Vogel spiral, `ramp`, and that
    the leak test reads the tap at full resolution, so that the centre always counts.
    """
    image, depth, lens, max_coc = check_arguments("gather", image, depth, lens, max_coc)
    ramp = parameter("gather(ramp=...)", ramp)
    check("gather(ramp=...)", ramp, lambda v: v >= 0, "0 or positive")
    disc = POISSON if taps is None else vogel(whole_number("gather(taps=...)", taps))
    disc = tuple(map(tuple, np.asarray(disc).tolist()))
    return _gather(image, depth, lens, ramp, max_coc, disc)


@ft.partial(jax.jit, static_argnames=("max_coc", "disc"))
def _gather(image, depth, lens, ramp, max_coc, disc):
    return _gathered(image, depth, lens, ramp, max_coc, disc)


@ft.partial(jax.custom_jvp, nondiff_argnums=(4, 5))
def _gathered(image, depth, lens, ramp, max_coc, disc):
    """The result; on an accelerator, where a turn costs a launch, by two taps per turn.

    Derivatives take one tap per turn everywhere: with two they need more than 40 images of
    memory.
    """
    single = ft.partial(_drawn, max_coc=max_coc, disc=disc)
    pairs = ft.partial(single, at_once=2)
    return by_platform(image, depth, lens, ramp, cpu=single, accelerator=pairs)


@_gathered.defjvp
def _gathered_jvp(max_coc, disc, primals, tangents):
    return jax.jvp(ft.partial(_drawn, max_coc=max_coc, disc=disc), primals, tangents)


def _drawn(image, depth, lens, ramp, max_coc, disc, at_once=1):
    dtype = image.dtype
    view = defocused(image, depth, lens, max_coc)
    ramp = ramp.astype(view.image.dtype)
    # A bad pixel is NaN, so that whatever reads it is, in the low-resolution image too.
    image = jnp.where(view.bad[..., None], jnp.nan, view.image)
    # One read gives a tap's colour, its defocus and the share of it whose depth is known.
    planes = [image, view.defocus[..., None], jnp.ones_like(image[..., :1])]
    full = jnp.where(view.missing[..., None], 0, jnp.concatenate(planes, axis=-1))
    low = low_resolution(jnp.concatenate([full[..., :-2], full[..., -1:]], axis=-1))
    centre = view.defocus
    radius = absolute(centre)[..., None] / 2
    points = pixel_centers(image.shape[0], image.shape[1], image.dtype)
    # On a surface of one depth a tap, which is interpolated, may round to in front.
    rounding = 8 * jnp.finfo(image.dtype).eps * max_coc

    def add_tap(sums, offset):
        offset = offset[None, None] * radius
        high = bilinear(full, points + offset)
        known = high[..., -1]
        mean = _mean(high)
        tap, defocus = mean[..., :-1], mean[..., -1]
        blur = absolute(defocus) / max_coc
        soft = bilinear(low, points / _SIDE + _LOW_RADIUS * offset)
        # Where the low-resolution image has no pixel of known depth, the tap alone counts.
        share = jnp.where(soft[..., -1] > 0, blur, 0)
        tap = mix(tap, _mean(soft), share[..., None])
        ahead = centre - rounding - defocus
        soft_test = clip01(1 - ahead / jnp.where(ramp > 0, ramp, 1))
        behind = jnp.where(ramp > 0, soft_test, (ahead <= 0).astype(image.dtype))
        weight = (known * (behind + (1 - behind) * blur))[..., None]
        return (sums[0] + weight * tap, sums[1] + weight), None

    zero = jnp.zeros_like(image)
    offsets = jnp.asarray(disc, image.dtype)
    sums, _ = scan(jax.checkpoint(add_tap), (zero, zero[..., :1]), offsets, unroll=at_once)
    sums = with_own(jnp.concatenate(sums, axis=-1), view.image, view.missing)
    result = sums[..., :-1] / sums[..., -1:]
    return jnp.where(view.lost[..., None], jnp.nan, result).astype(dtype)


def _mean(sums: Float[Array, "height width value"]) -> Float[Array, "height width _"]:
    """The sums over the last of them; 0 where that is 0."""
    return sums[..., :-1] / jnp.where(sums[..., -1:] > 0, sums[..., -1:], 1)


def mix(
    one: Float[Array, "height width channel"],
    other: Float[Array, "height width channel"],
    share: Float[Array, "height width 1"],
) -> Float[Array, "height width channel"]:
    """`one` blended with a share of `other`; a NaN whose share is 0 has no effect."""
    outside = (share == 0) & ~jnp.isfinite(other)
    return (1 - share) * one + share * jnp.where(outside, 0, other)


def low_resolution(
    image: Float[Array, "height width channel"],
) -> Float[Array, "low_height low_width channel"]:
    """The means of 4x4 pixels, four bilinear taps in the source, under a 3x3 Gaussian."""
    height, width, channels = image.shape
    image = jnp.pad(image, ((0, -height % _SIDE), (0, -width % _SIDE), (0, 0)), mode="edge")
    blocks = image.reshape(-(-height // _SIDE), _SIDE, -(-width // _SIDE), _SIDE, channels)
    low = jnp.pad(blocks.mean(axis=(1, 3)), ((1, 1), (1, 1), (0, 0)), mode="edge")
    low = (low[:-2] + 2 * low[1:-1] + low[2:]) / 4
    return (low[:, :-2] + 2 * low[:, 1:-1] + low[:, 2:]) / 4
