"""Depth as cameras, files and networks give it: holes, units, disparity, distance.

One convention everywhere: 0, negative numbers and NaN are *missing*, inf is *nothing there*, a
sky. What these functions give has NaN where the depth is missing and is positive elsewhere,
height width, along the optical axis.
"""

from typing import Any, Literal, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Num

from jaxfx._arguments import check_camera
from jaxfx._checks import as_numpy, check, check_image, is_concrete, parameter
from jaxfx._holes import cheapest_sources, farther_ends
from jaxfx._numerics import inverse, working_dtype
from jaxfx._sampling import pixel_centers
from jaxfx.camera import OrthographicCamera, PinholeCamera


__all__ = ["Filled", "clean", "fill", "from_disparity", "from_ray_distance", "from_stereo"]

# How renderers write that nothing is there: Blender's 1e10, and what a half float holds of it.
SKY = (1e10, 65504.0)


def clean(
    depth: Num[ArrayLike, "height width"],
    *,
    scale: Num[ArrayLike, ""] = 1.0,
    sky: tuple[float | int, ...] | None = None,
) -> Float[Array, "height width"]:
    """Depth in scene units with the holes of this module, from numbers as a file stores them.

    >>> import numpy as np
    >>> from jaxfx import depth
    >>> depth.clean(np.array([[0, 6]], np.uint16), scale=1 / 4)  # steps of a quarter metre
    Array([[nan, 1.5]], dtype=float32)

    **Arguments:**

    - `depth`: height width, floats or integers; 0, negative and NaN (and what a NumPy mask
      hides) are missing, inf is nothing there.
    - `scale`: scene units of one step of `depth`, positive.
    - `sky`: static; further numbers, in steps of `depth`, that say that nothing is there, as
      does all beyond the largest of them. Without it 1e10 and 65504 where `depth` is of
      floats, which is how renderers write it; none where it is of integers.

    **Returns:** height width: NaN where missing, inf where nothing is there, positive
    elsewhere; in the type of `depth`, at least float32; integers give JAX's default.

    **Raises:** `ValueError` for a wrong shape or type, or a scale that is not positive.

    **Gradient:** exact in `depth` and `scale`; zero where the depth is missing or inf.
    """
    scale = parameter("clean(scale=...)", scale)
    check("clean(scale=...)", scale, lambda v: (v > 0) & np.isfinite(v), "positive and finite")
    values, is_nothing = _numbers_and_sky("clean(depth)", depth, sky)
    is_known = (values > 0) & ~is_nothing
    known = jnp.where(is_known, values, 1) * scale.astype(values.dtype)
    return _with_holes(known, is_known, is_nothing)


def from_disparity(
    disparity: Num[ArrayLike, "height width"],
    *,
    scale: Num[ArrayLike, ""],
    shift: Num[ArrayLike, ""] = 0.0,
) -> Float[Array, "height width"]:
    """Depth from inverse depth up to scale and shift, as networks for one image give it.

    `depth = 1 / (scale * disparity + shift)`. Where the denominator is 0 nothing is there
    (inf); where it is negative or infinite the depth is missing, as it is where the disparity
    is NaN. A stereo pair's disparity has other holes: `from_stereo`.

    **Arguments:**

    - `disparity`: height width, larger where nearer.
    - `scale`, `shift`: inverse scene units for one step, and for a disparity of 0. The two are
      found by least squares from points of known depth, or one chooses the nearest and the
      farthest depth.

    **Returns:** height width, scene units, with the holes of this module.

    **Raises:** `ValueError` for a wrong shape or type.

    **Gradient:** exact in all three; zero where the depth is missing or inf.

    Source: Ranftl et al. 2020, disparity up to scale and shift.
    """
    values, _ = _numbers("from_disparity(disparity)", disparity)
    scale = parameter("from_disparity(scale=...)", scale).astype(values.dtype)
    shift = parameter("from_disparity(shift=...)", shift).astype(values.dtype)
    is_number = jnp.isfinite(values)
    inverse = jnp.where(is_number, values, 1) * scale + shift
    is_known = is_number & (inverse > 0) & jnp.isfinite(inverse)
    known = 1 / jnp.where(is_known, inverse, 1)
    return _with_holes(known, is_known, is_number & (inverse == 0))


def from_stereo(
    disparity: Num[ArrayLike, "height width"],
    *,
    focal_pixels: Num[ArrayLike, ""],
    baseline: Num[ArrayLike, ""],
    offset: Num[ArrayLike, ""] = 0.0,
) -> Float[Array, "height width"]:
    """Depth from the disparity of a rectified pair of cameras.

    `depth = focal_pixels * baseline / (disparity + offset)`. A disparity of 0 says that no
    match was found, as a negative one, NaN or inf does: the depth is missing there.

    **Arguments:**

    - `disparity`: height width, pixels between the two images of a point. (OpenCV's integers
      are 16 steps a pixel, those of KITTI's files 256: divide first.)
    - `focal_pixels`: the focal length, in pixels.
    - `baseline`: the distance of the two cameras, scene units.
    - `offset`: the x of the second camera's principal point less that of the first, in pixels;
      the `doffs` of Middlebury's files.

    **Returns:** height width, scene units, with the holes of this module.

    **Raises:** `ValueError` for a wrong shape or type, or a focal length or baseline that is
    not positive.

    **Gradient:** exact in all four; zero where the depth is missing.

    Source: Scharstein et al. 2014, the depth of a rectified pair with its offset.
    """
    values, _ = _numbers("from_stereo(disparity)", disparity)
    focal = parameter("from_stereo(focal_pixels=...)", focal_pixels)
    base = parameter("from_stereo(baseline=...)", baseline)
    check("from_stereo(focal_pixels=...)", focal, lambda v: v > 0, "positive")
    check("from_stereo(baseline=...)", base, lambda v: v > 0, "positive")
    offset = parameter("from_stereo(offset=...)", offset).astype(values.dtype)
    is_match = jnp.isfinite(values) & (values > 0)
    shifted = jnp.where(is_match, values, 1) + offset
    is_known = is_match & (shifted > 0)
    product = focal.astype(values.dtype) * base.astype(values.dtype)
    known = product / jnp.where(is_known, shifted, 1)
    return _with_holes(known, is_known, jnp.zeros_like(is_known))


def from_ray_distance(
    distance: Num[ArrayLike, "height width"], camera: PinholeCamera | OrthographicCamera
) -> Float[Array, "height width"]:
    """Depth along the optical axis from the distance along each pixel's ray.

    Path tracers and laser scanners give the latter. At the corner of a wide image it is half
    as long again.

    **Arguments:**

    - `distance`: height width, scene units from the eye, with holes as in `clean`.
    - `camera`: its rays go through the pixels' centres. Those of an orthographic camera start
      on the plane of depth 0 and run along the axis: there the two are the same.

    **Returns:** height width, scene units, with the holes of this module.

    **Raises:** `ValueError` for a wrong shape or type.

    **Gradient:** exact in `distance` and the camera's intrinsics; zero where the depth is
    missing or inf, and in the pose.
    """
    check_camera("from_ray_distance(camera)", camera)
    values, is_nothing = _numbers_and_sky("from_ray_distance(distance)", distance, None)
    is_known = (values > 0) & ~is_nothing
    known = jnp.where(is_known, values, 1)
    if isinstance(camera, PinholeCamera):
        known = known * _axis_per_ray(camera, values)
    return _with_holes(known, is_known, is_nothing)


def _axis_per_ray(
    camera: PinholeCamera, like: Float[Array, "height width"]
) -> Float[Array, "height width"]:
    """How far along the axis one goes in each pixel, for a unit along its ray."""
    height, width = like.shape
    pixels = pixel_centers(height, width, like.dtype)
    columns = inverse(camera.intrinsics).astype(like.dtype).T[:, None, None, :]
    rays = pixels[..., :1] * columns[0] + pixels[..., 1:] * columns[1] + columns[2]
    return rays[..., 2] / jnp.linalg.norm(rays, axis=-1)


@final
class Filled(eqx.Module):
    """A depth without holes, and what was changed to make it so.

    - `depth`: height width, scene units.
    - `filled`: height width, true where the depth was missing and is now another pixel's.
    """

    depth: Float[Array, "height width"]
    filled: Bool[Array, "height width"]


def fill(
    depth: Num[ArrayLike, "height width"],
    image: Float[ArrayLike, "height width channel"] | None = None,
    *,
    method: Literal["guided", "rows"] = "guided",
) -> Filled:
    """Give each pixel whose depth is missing the depth of one that is known.

    Depths are copied, never averaged: between two surfaces there is none. What a depth camera
    or a stereo pair misses lies mostly beside a near thing that hides the background from its
    second eye; so the farther of a gap's two ends is the better guess.

    - `"rows"` takes the farther of the nearest known depths on either side in the row; in a
      row that knows nothing, in the column.
    - `"guided"` takes the depth at the end of the cheapest path through the hole. A path costs
      its length and, above all, the edges of `image` that it crosses, so that a depth fills
      the surface that the image shows. It also pays where it leaves the known pixels with a
      depth that is nearer than what `"rows"` would take there. At last the filled pixels take
      the median of the 3 x 3 about them, twice, so that none stands alone. It knows nothing of
      slopes: a wide hole in a floor becomes flat steps.

    **Arguments:**

    - `depth`: height width, with holes as in `clean`; inf is known and stays.
    - `image`: height width channel, linear, black 0 to white 1; its edges guide. Without it
      all paths cost their length alone.
    - `method`: one of the two.

    **Returns:** the record: the depth, and where it was changed. A depth that is missing
    everywhere stays so under a transform, which can't look.

    **Raises:** `ValueError` for a wrong shape or type, or where no depth is known.

    **Gradient:** exact in `depth`: each filled pixel's goes to the one that it copies. Zero in
    `image`; *missing* is how a change of it would change which pixel is copied.

    Source: our own. Distances over an image: Criminisi, Sharp & Blake 2008; the farther end as
    the guess for what is hidden: Hirschmüller 2008.
    """
    values, is_nothing = _numbers_and_sky("fill(depth)", depth, None)
    values = _with_holes(values, (values > 0) & ~is_nothing, is_nothing)
    is_missing = jnp.isnan(values)
    if method not in ("guided", "rows"):
        raise ValueError(f'`fill(method=...)` must be "guided" or "rows", got {method!r}.')
    if is_concrete(values) and np.all(is_missing):
        raise ValueError("`fill(depth)` must be known somewhere, got none above 0.")
    guide = jnp.zeros((*values.shape, 1), values.dtype)
    if image is not None:
        guide = check_image("fill(image)", image)
        if guide.shape[:2] != values.shape:
            raise ValueError(
                f"`fill(image)` must have the depth's height and width {values.shape}, "
                f"got shape {guide.shape}."
            )
    held, guide = jax.lax.stop_gradient((values, guide.astype(values.dtype)))
    source = farther_ends(held)
    if method == "guided":
        source = cheapest_sources(held, guide, held.reshape(-1)[source])
    return Filled(values.reshape(-1)[source], is_missing)


def _numbers(name: str, values: Any) -> tuple[Float[Array, "height width"], bool]:
    """`values` as floats, height width, and whether they were integers.

    What a NumPy mask hides is NaN.
    """
    is_masked = isinstance(values, np.ma.MaskedArray)
    array = values
    if not isinstance(values, jax.Array):
        array = as_numpy(name, values.data if is_masked else values)
    is_integer = array.dtype.kind in "iu"
    if not is_integer and not jnp.issubdtype(array.dtype, jnp.floating):
        raise ValueError(f"`{name}` must hold real numbers, got {array.dtype}.")
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(
            f"`{name}` must be of shape (height, width), none of them 0, got {array.shape}. "
            "Batches are made with `jax.vmap`."
        )
    dtype = jnp.result_type(float) if is_integer else working_dtype(array.dtype)
    array = jnp.asarray(array.astype(dtype))
    if is_masked:
        array = jnp.where(np.ma.getmaskarray(values), jnp.nan, array)
    return array, is_integer


def _numbers_and_sky(
    name: str, values: Any, sky: tuple[float | int, ...] | None
) -> tuple[Float[Array, "height width"], Bool[Array, "height width"]]:
    """`values` as floats, and where they say that nothing is there."""
    numbers, is_integer = _numbers(name, values)
    if sky is None:
        sky = () if is_integer else SKY
    is_nothing = jnp.isinf(numbers) & (numbers > 0)
    for mark in sky:
        is_nothing |= numbers == jnp.asarray(mark, numbers.dtype)
    if sky:
        is_nothing |= numbers >= jnp.asarray(max(sky), numbers.dtype)
    return numbers, is_nothing


def _with_holes(
    known: Float[Array, "height width"],
    is_known: Bool[Array, "height width"],
    is_nothing: Bool[Array, "height width"],
) -> Float[Array, "height width"]:
    """`known` where it is, inf where nothing is, NaN elsewhere."""
    return jnp.where(is_known, known, jnp.where(is_nothing, jnp.inf, jnp.nan))
