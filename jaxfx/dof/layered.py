"""Depth of field by scatter that knows what hides what, from one layer of depth or two."""

import functools as ft

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxfx._numerics import check, check_depth, check_image, clip01, parameter
from jaxfx.dof._inputs import check_arguments, defocused
from jaxfx.dof._sheets import Sheet, Sums, sums
from jaxfx.dof._shift import shift
from jaxfx.dof._sprites import POINT_RADIUS, Sprites, reach
from jaxfx.lens import FocusPlanes, ThinLens


# Two defocuses nearer than this, in pixels, are the same whatever the threshold.
_SMALLEST_THRESHOLD = 1e-3
_SMALLEST_GAP = 1e-3
# A hidden point that this share of the lens sees counts in full.
_SEEN = 0.25
# Where less than this has arrived from behind, what lies behind is not known.
_KNOWN = 1e-3


def layered(
    image: Float[ArrayLike, "height width channel"],
    depth: Float[ArrayLike, "height width"],
    lens: ThinLens | FocusPlanes,
    *,
    max_coc: int | float | None = None,
    behind: tuple[Float[ArrayLike, "height width channel"], Float[ArrayLike, "height width"]]
    | None = None,
    threshold: Float[ArrayLike, ""] | float = 2.0,
) -> Float[Array, "height width channel"]:
    """Depth of field by point sprites that are composited at every pixel, without a gamma.

    At each pixel q the sprites that arrive are sorted into those in front of the surface of q,
    on it, and behind it. Each is weighted by the share of q's lens that sees it: its coverage
    over its area, times `1 - (p - q) . grad log(defocus)`, for a surface whose defocus changes
    turns towards one side of the lens. With F, S and B the three sums of weighted light and f,
    s and b those of the weights, the result is

    `F over (S over B)`, of opacities `min(f, 1)` and `min(s / open, 1)`,

    with `open` the part of q's own disc that no surface in front of it hides, so that a surface
    goes on behind what stands before it; B is normalized, for it does so too.

    A sprite p is on the surface of q where the slopes of both explain the difference of their
    defocus: `defocus_p - defocus_q` is clamped to what the trapezoid rule makes of them, and
    what is left is another surface in full from `threshold` on. A slanted floor is thereby one
    surface, however much its defocus changes.

    With a second layer the same sums hold its sprites too. A point of it counts where the lens
    sees past the first layer: in 8 directions the first layer is followed from the pixel as
    long as it lies in front of the point, which gives the part of the lens that it covers.

    What it does badly: what no layer shows is guessed from its surroundings, as is what lies
    beyond the frame, where the last pixels are repeated. Of several surfaces in front of q, or
    behind it, the mean is taken. A surface narrower than two pixels has no slope. The time
    grows with the square of the radius, as that of `scatter(kernel="tiles")` does.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background.
    - `lens`: gives each depth its signed defocus, in pixels.
    - `max_coc`: static; the largest diameter, in pixels. Larger sprites are clamped to it.
      Outside `jit`, `grad` and `vmap` it may be left out and is then taken from `depth`.
    - `behind`: the image and depth of the next surface that faces the camera behind the first,
      shaped as `image` and `depth`; its depth is inf where there is none.
    - `threshold`: pixels; how much two defocuses must differ, beyond what slopes explain, to be
      of two surfaces. The default serves all scenes that we know.

    **Returns:** height width channel, in the type of `image`. A pixel whose colour or depth is
    not a number spoils what its sprite can reach, `max_coc` where that is unknown.

    **Raises:** `ValueError` for a wrong shape, an integer image, a depth that is not positive,
    a negative `threshold`, or no `max_coc` under a transform.

    **Gradient:** exact with respect to `image`, `depth`, both of `behind`, `threshold` and
    every field of `lens`, forward and reverse; zero where a sprite is clamped. At a kink (an
    equal depth of neighbours, the ends of every clamp) one of the one-sided values; where
    several meet, as at neighbours that all have one depth, it can lie beyond all of them.

    Source: our own. Kin: Lee, Kim & Choi 2008 and Franke et al. 2018 composite layers per
    pixel or per tile; the over of premultiplied colours is that of Porter & Duff 1984.
    """
    image, depth, max_coc = check_arguments("layered", image, depth, lens, max_coc)
    threshold = parameter("layered(threshold=...)", threshold)
    check("layered(threshold=...)", threshold, lambda v: v >= 0, "0 or positive")
    if behind is not None:
        second = check_image("layered(behind=...)", behind[0])
        if second.shape != image.shape:
            raise ValueError(
                f"`layered(behind=...)` must hold an image of shape {image.shape}, "
                f"got {second.shape}."
            )
        name = "layered(behind=...)"
        behind = second.astype(image.dtype), check_depth(name, behind[1], depth.shape)
    return _layered(image, depth, lens, max_coc, behind, threshold)


@ft.partial(jax.jit, static_argnames=("max_coc",))
def _layered(image, depth, lens, max_coc, behind, threshold):
    view = defocused(image, depth, lens, max_coc)
    threshold = jnp.maximum(threshold.astype(view.image.dtype), _SMALLEST_THRESHOLD)
    defocus = view.defocus / threshold
    everywhere = jnp.ones_like(defocus)
    sheets = [_sheet(view.image, defocus, threshold, everywhere)]
    spoiled = _spoiled(view.bad, depth, view.defocus, max_coc)
    if behind is not None:
        second = defocused(behind[0], behind[1], lens, max_coc)
        there = jnp.isfinite(behind[1]) & ~second.bad
        farther = jnp.where(there, second.defocus / threshold, defocus)
        seen = _seen(defocus * threshold, farther * threshold, max_coc)
        through = jnp.where(there, clip01(seen / _SEEN), 0)
        sheets.append(_sheet(second.image, farther, threshold, through))
        spoiled |= _spoiled(second.bad, behind[1], second.defocus, max_coc)
    result = _composite(sums(reach(max_coc), sheets))
    return jnp.where(spoiled[..., None], jnp.nan, result).astype(image.dtype)


def _sheet(
    image: Float[Array, "height width channel"],
    defocus: Float[Array, "height width"],
    threshold: Float[Array, ""],
    through: Float[Array, "height width"],
) -> Sheet:
    """The sprites of a layer whose defocus is given in thresholds."""
    half = jnp.abs(defocus) * threshold / 2
    radius = jnp.where(half < POINT_RADIUS, POINT_RADIUS, half)
    slope = jnp.stack([_slope(defocus, 1), _slope(defocus, 0)])
    signed = jnp.where(defocus < 0, -2, 2) * radius / threshold
    value = jnp.concatenate([image, jnp.ones_like(image[..., :1])], axis=-1)
    value = value * (through / (jnp.pi * radius * radius))[..., None]
    return Sheet(
        jnp.moveaxis(value, -1, 0), radius, through, defocus, slope, slope / signed[None]
    )


def _slope(x: Float[Array, "height width"], axis: int) -> Float[Array, "height width"]:
    """The smaller of the differences to the neighbours on both sides, 0 where they disagree."""
    if x.shape[axis] == 1:
        return jnp.zeros_like(x)
    step = jnp.diff(x, axis=axis)
    first, last = (
        jax.lax.slice_in_dim(step, *ends, axis=axis) for ends in ((0, 1), (-1, None))
    )
    before = jnp.concatenate([first, step], axis=axis)
    after = jnp.concatenate([step, last], axis=axis)
    smaller = jnp.where(jnp.abs(before) < jnp.abs(after), before, after)
    return jnp.where((before > 0) == (after > 0), smaller, 0)


def _seen(
    defocus: Float[Array, "height width"],
    farther: Float[Array, "height width"],
    max_coc: float,
) -> Float[Array, "height width"]:
    """The share of the lens that sees a hidden point, its defocus and the first layer's given.

    From the point's own pixel the first layer is followed while it lies in front of the point.
    A pixel of it that lies so many pixels away and so much in front hides the point from the
    place on the lens, in its radii, that is the quotient of the two. Where it has come much
    nearer to the point's defocus than where it started, it has ended.
    """
    height, width = defocus.shape
    steps = int(max_coc) + 1
    padded = jnp.pad(defocus, steps, mode="edge")
    ways = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x]

    @jax.checkpoint
    def visible(way):
        length = jnp.sqrt(jnp.sum(way * way).astype(defocus.dtype))

        def ahead(gap):
            return jnp.maximum(gap, _SMALLEST_GAP) / 2

        def step(carry, count):
            covered, hidden = carry
            start = steps + count * way
            gap = farther - jax.lax.dynamic_slice(padded, start, (height, width))
            covered = covered * clip01(gap / ahead(farther - defocus))
            return (covered, hidden + length * covered / ahead(gap)), None

        # The pixel itself hides the point, by half its width to each side.
        start = jnp.ones_like(defocus), length / 2 / ahead(farther - defocus)
        hidden = jax.lax.scan(jax.checkpoint(step), start, jnp.arange(1, steps))[0][1]
        return 1 - clip01(hidden) ** 2

    return jnp.mean(jax.lax.map(visible, jnp.asarray(ways)), axis=0)


def _composite(sums: Sums) -> Float[Array, "height width channel"]:
    """In front over (the same surface over what lies behind)."""
    front, same, behind = (jnp.moveaxis(light, 0, -1) for light in sums.light)
    f, s, b = front[..., -1:], same[..., -1:], behind[..., -1:]
    share = s / sums.open[..., None]
    share = jnp.where(share < 1, share, 1)
    # What lies behind is taken to fill all that is left, unless next to nothing of it came.
    rest = share * same / s + (1 - share) * behind / (b + _KNOWN)
    rest = rest[..., :-1] / rest[..., -1:]
    opaque = jnp.where(f > 1, f, 1)
    return front[..., :-1] / opaque + (1 - f / opaque) * rest


def _spoiled(
    bad: Bool[Array, "height width"],
    depth: Float[Array, "height width"],
    defocus: Float[Array, "height width"],
    max_coc: float,
) -> Bool[Array, "height width"]:
    """Where the sprites of the `bad` pixels reach; nothing is computed if there are none."""
    radius = jnp.where(depth > 0, jnp.maximum(jnp.abs(defocus) / 2, POINT_RADIUS), max_coc / 2)
    radius = jax.lax.stop_gradient(radius)

    def cover():
        zero, one = jnp.zeros_like(radius), jnp.ones((), radius.dtype)
        value = bad[..., None].astype(radius.dtype)
        return shift(Sprites(value, radius, zero - 1, zero, one), reach(max_coc))[..., 0] > 0

    return jax.lax.cond(bad.any(), cover, lambda: bad)
