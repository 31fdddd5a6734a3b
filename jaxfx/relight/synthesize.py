"""The deep frame buffer of a new camera, from those of other cameras.

Every pixel of the new view is a point of the world, its depth given. The point is looked up in
each cache; what the caches that see it say of it is averaged. A point that none sees is a hole.

It does badly where the caches are coarse: they are read at the nearest pixel, so that texture
finer than a cache's pixels aliases, and what two surfaces less than `tolerance` apart show is
told apart only by shader, normal and the fit to each cache's own surface.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Int, Num

from jaxfx._arguments import check_camera, check_gbuffer
from jaxfx._checks import (
    Number,
    WholeNumber,
    check_depth,
    check_map,
    items,
    number,
    option,
    whole_number,
)
from jaxfx._numerics import normalize, safe_divide
from jaxfx._sampling import pixel_centers
from jaxfx.camera import Camera, OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.relight._views import Found, Scalars, look_up, points


_AVERAGED = ("color", "ambient", "diffuse", "specular", "roughness")
_WORSE = 0.1  # tolerances; a cache that fits a point worse than the best by this shows another


def synthesize(
    gbuffers: Sequence[GBuffer],
    cameras: Sequence[PinholeCamera | OrthographicCamera],
    target: PinholeCamera | OrthographicCamera,
    *,
    depth: Num[ArrayLike, "height width"],
    tolerance: Number = 0.005,
    angle: Number = 0.5,
    weights: Literal["equal", "detail"] = "equal",
) -> tuple[GBuffer, Int[Array, "height width"]]:
    """The cache of the camera `target`, and how many caches each of its pixels comes from.

    A cache sees a pixel's point if the surface in the cache's own pixel passes through it: if
    their distance, across the surface, is at most `tolerance` of the depth, and if the surface
    faces the new camera. The cache with the least distance decides the shader; of the others,
    those count that have that shader, a normal within `angle` of its normal, and a distance not
    larger by more than a tenth of the tolerance.

    **Arguments:**

    - `gbuffers`, `cameras`: the caches, height width each, of any sizes, and their cameras.
    - `target`: the new camera.
    - `depth`: height width, of the new view, scene units along its axis, inf for background; 0,
      negative or NaN where it is missing: from the mesh, or from the caches' own depths,
      warped.
    - `tolerance`: static; of the depth. It must cover the error of the depths.
    - `angle`: static; radians.
    - `weights`: "equal" is the source's mean; "detail" favours the nearer and more frontal
      camera, by the pixels that it spends on a unit of the surface.

    **Returns:** the `GBuffer`, its normals averaged on the sphere, its depth the one given; and
    the coverage, height width, integers. A pixel of known depth with coverage 0 is a hole: see
    `fill_holes`. Holes and background have shader -1 and zeros. A NaN in a cache reaches only
    the pixels that read it.

    **Raises:** `ValueError` where there is no cache, or not one camera for each, or for an
    option out of range.

    **Gradient:** exact with respect to the caches' colours and roughness, and to `depth` as it
    is passed on. With respect to the normals and the cameras, exact for the weights; zero for
    what is visible, and zero along the image, for caches are read at the nearest pixel.

    Source: Kim, Lee & Kyung, equations 2 and 3. The tests across the surface, of normal and of
    shader, and the weights, are our own.
    """
    caches = _check("synthesize", gbuffers, cameras, target)
    tolerance = number("synthesize(tolerance=...)", tolerance)
    angle = number("synthesize(angle=...)", angle, expected="positive, in radians,")
    option("synthesize(weights=...)", weights, ("equal", "detail"))
    depth = _check_target("synthesize", depth)
    options = {"tolerance": tolerance, "angle": angle, "weights": weights}
    return _synthesize(*caches, target, depth, **options)


def best_caches(
    gbuffers: Sequence[GBuffer],
    cameras: Sequence[PinholeCamera | OrthographicCamera],
    target: PinholeCamera | OrthographicCamera,
    *,
    depth: Num[ArrayLike, "height width"],
    count: WholeNumber,
    tolerance: Number = 0.005,
    stride: WholeNumber = 8,
) -> Int[Array, " count"]:
    """Which caches serve a new view best: the one that sees most of it, and so on.

    Each next one is that which adds most to those before it, measured by what of the view they
    see and in how much detail. It is found on every `stride`-th pixel.

    **Arguments:**

    - `gbuffers`, `cameras`, `target`, `depth`, `tolerance`: as in `synthesize`.
    - `count`: static; how many, from 1.
    - `stride`: static; pixels.

    **Returns:** `count` indices, the best first.

    **Raises:** `ValueError` as `synthesize`, and for a `count` or `stride` out of range.

    **Gradient:** none: these are integers.

    Source: our own; the greedy choice is within 1 - 1/e of the best (Nemhauser, Wolsey &
    Fisher 1978).
    """
    caches = _check("best_caches", gbuffers, cameras, target)
    most = len(caches[0])
    in_range = lambda n: 1 <= n <= most
    count = whole_number("best_caches(count=...)", count, in_range, f"in [1, {most}]")
    stride = whole_number("best_caches(stride=...)", stride, expected="at least 1")
    tolerance = number("best_caches(tolerance=...)", tolerance)
    depth = _check_target("best_caches", depth)
    options = {"count": count, "tolerance": tolerance, "stride": stride}
    return _best_caches(*caches, target, depth, **options)


@partial(jax.jit, static_argnames=("count", "tolerance", "stride"))
def _best_caches(gbuffers, cameras, target, depth, *, count, tolerance, stride):
    rows, columns = (slice(min(stride, side) // 2, None, stride) for side in depth.shape)
    pixels = pixel_centers(depth.shape[0], depth.shape[1], depth.dtype)[rows, columns]
    point = points(target, pixels, depth[rows, columns])
    found = [
        look_up(gbuffer, camera, point, tolerance)
        for gbuffer, camera in zip(gbuffers, cameras, strict=True)
    ]
    detail = jnp.stack([jnp.where(one.seen & point.known, one.detail, 0) for one in found])
    most = jnp.max(detail, axis=0, keepdims=True)
    detail = safe_divide(detail, jnp.broadcast_to(most, detail.shape))
    # A cache that sees a point is worth most of it; the most detailed one, all of it.
    worth = jnp.where(detail > 0, (3 + detail) / 4, 0)
    have, taken, chosen = jnp.zeros_like(worth[0]), jnp.zeros(len(found), bool), []
    for _ in range(count):
        gain = jnp.sum(jnp.maximum(worth - have[None], 0), axis=(1, 2))
        index = jnp.argmax(jnp.where(taken, -1, gain)).astype(jnp.int32)
        have, taken = jnp.maximum(have, worth[index]), taken.at[index].set(True)
        chosen.append(index)
    return jnp.stack(chosen)


def _check(
    caller: str, gbuffers: Any, cameras: Any, target: Any
) -> tuple[tuple[GBuffer, ...], tuple[Camera, ...]]:
    gbuffers = items(f"{caller}(gbuffers)", gbuffers)
    cameras = items(f"{caller}(cameras)", cameras)
    for name, values in (("gbuffers", gbuffers), ("cameras", cameras)):
        if not values:
            raise ValueError(
                f"`{caller}({name})` must be a sequence of at least one, got none."
            )
    gbuffers = [
        check_gbuffer(f"{caller}(gbuffers[{i}])", each) for i, each in enumerate(gbuffers)
    ]
    for index, camera in enumerate(cameras):
        check_camera(f"{caller}(cameras[{index}])", camera)
    check_camera(f"{caller}(target)", target)
    if len(gbuffers) != len(cameras):
        raise ValueError(
            f"`{caller}(cameras)` must be one for each cache, got {len(cameras)} for "
            f"{len(gbuffers)}."
        )
    return tuple(gbuffers), tuple(cameras)


def _check_target(caller: str, depth: Any) -> Scalars:
    depth = check_map(f"{caller}(depth=...)", depth)
    return check_depth(f"{caller}(depth=...)", depth, depth.shape)


@partial(jax.jit, static_argnames=("tolerance", "angle", "weights"))
def _synthesize(gbuffers, cameras, target, depth, *, tolerance, angle, weights):
    like = gbuffers[0].depth.dtype
    height, width = depth.shape
    point = points(target, pixel_centers(height, width, depth.dtype), depth)
    found = [
        look_up(gbuffer, camera, point, tolerance)
        for gbuffer, camera in zip(gbuffers, cameras, strict=True)
    ]
    counted, shader = _agreement(found, tolerance, angle)
    counted = [each & point.known for each in counted]
    coverage = sum(each.astype(jnp.int32) for each in counted)
    covered = coverage > 0
    shares = [
        jnp.where(each, one.detail if weights == "detail" else jnp.ones_like(one.detail), 0)
        for each, one in zip(counted, found, strict=True)
    ]
    total = jnp.where(covered, sum(shares), 1)
    shares = [(share / total).astype(like) for share in shares]

    def mean(values):
        out = jnp.zeros_like(values[0])
        for value, part in zip(values, shares, strict=True):
            share = part.reshape(part.shape + (1,) * (out.ndim - 2))
            # What has no share may not be finite, nor be multiplied by a derivative's 0.
            out = out + share * jnp.where(share > 0, value, 0)
        return out

    def read(name):
        images = (getattr(gbuffer, name).astype(like) for gbuffer in gbuffers)
        return mean([one.read(image) for one, image in zip(found, images, strict=True)])

    gbuffer = GBuffer(
        shader=jnp.where(covered, shader, -1),
        normal=normalize(mean([one.normal.astype(like) for one in found])),
        depth=depth.astype(like),
        **{name: read(name) for name in _AVERAGED},
    )
    return gbuffer, coverage


def _agreement(
    found: Sequence[Found], tolerance: float, angle: float
) -> tuple[list[Bool[Array, "height width"]], Int[Array, "height width"]]:
    """Which caches count in each pixel, and the shader there."""
    apart = [jnp.where(one.seen, one.distance, jnp.inf) for one in found]
    best, shader, normal = apart[0], found[0].shader, found[0].normal
    for distance, one in zip(apart[1:], found[1:], strict=True):
        nearer = distance < best
        best = jnp.where(nearer, distance, best)
        shader = jnp.where(nearer, one.shader, shader)
        normal = jnp.where(nearer[..., None], one.normal, normal)
    chord = 2 * math.sin(min(angle, math.pi) / 2)
    counted = [
        one.seen
        & (one.shader == shader)
        & (jnp.sum((one.normal - normal) ** 2, axis=-1) <= chord**2)
        & (one.distance <= best + _WORSE * tolerance)
        for one in found
    ]
    return counted, shader
