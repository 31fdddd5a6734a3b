"""Depth from cameras, files and networks: units, disparity, distance, holes.

| I have | call |
|---|---|
| depth in other units, or with a sky at some number | `clean(depth, unit=..., sky=...)` |
| inverse depth of a network, up to scale and shift | `from_disparity(disparity, scale=...)` |
| the disparity of a stereo pair | `from_stereo(disparity, focal_pixels=..., baseline=...)` |
| the distance along each pixel's ray | `from_ray_distance(distance, camera)` |
| missing pixels to fill | `fill(depth, image)` |

One convention everywhere: 0, negative numbers and NaN are *missing*, inf is *background*. The
results have NaN where the depth is missing, inf for background, and are positive elsewhere:
height width, scene units along the optical axis. `fill(method="rows")` is a baseline, kept for
comparison.
"""

import functools
from typing import Any, Literal, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from jaxfx._arguments import check_camera
from jaxfx._arrays import ArrayLike
from jaxfx._checks import as_array, as_numpy, check, check_image, is_concrete, parameter
from jaxfx._holes import cheapest_sources, farther_ends
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import inverse, one_program, working_dtype
from jaxfx._sampling import pixel_centers
from jaxfx.camera import OrthographicCamera, PinholeCamera


__all__ = ["Filled", "clean", "fill", "from_disparity", "from_ray_distance", "from_stereo"]

# Depths that renderers write for background: Blender's 1e10, and the largest half float, to
# which that is rounded. Without them a background is a surface, far away.
SKY = (1e10, 65504.0)


@on_any_mesh
def clean(
    depth: Num[ArrayLike, "height width"],
    *,
    unit: Num[ArrayLike, ""] | float | int = 1.0,
    sky: tuple[float | int, ...] | None = None,
) -> Float[Array, "height width"]:
    """Depth in scene units and in this module's convention, from numbers as a file stores them.

    The first step for depth of a file or a sensor.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import depth
    >>> depth.clean(np.array([[0, 6]], np.uint16), unit=1 / 4)  # steps of a quarter metre
    Array([[nan, 1.5]], dtype=float32)

    **Arguments:**

    - `depth`: height width, floats or integers; 0, negative and NaN (and what a NumPy mask
      hides) are missing, inf is background.
    - `unit`: scene units of one step of `depth`, positive.
    - `sky`: static; further numbers, in steps of `depth`, that stand for background, as does
      all beyond the largest of them. By default 1e10 and 65504, which renderers write, where
      `depth` holds floats; none where it holds integers.

    **Returns:** height width: NaN where missing, inf for background, positive elsewhere. In the
    type of `depth`, at least float32; for integers JAX's default float type.

    **Raises:** `ValueError` for a wrong shape or type, or a unit that is not positive.

    **Gradient:** exact in `depth` and `unit`; zero where the depth is missing or inf.
    """
    unit = parameter("clean(unit=...)", unit)
    check("clean(unit=...)", unit, lambda v: (v > 0) & np.isfinite(v), "positive and finite")
    values, is_background = _numbers_and_sky("clean(depth)", depth, sky)
    return _scaled(values, is_background, unit)


@on_any_mesh
def from_disparity(
    disparity: Num[ArrayLike, "height width"],
    *,
    scale: Num[ArrayLike, ""] | float | int,
    shift: Num[ArrayLike, ""] | float | int = 0.0,
) -> Float[Array, "height width"]:
    """Depth from inverse depth up to scale and shift, as networks for one image predict it.

    `depth = 1 / (scale * disparity + shift)`. The disparity of a stereo pair has another
    convention for holes: see `from_stereo`.

    **Arguments:**

    - `disparity`: height width, larger where nearer.
    - `scale`, `shift`: inverse scene units of one step, and of a disparity of 0. Find them by
      least squares from points of known depth, or from the nearest and the farthest depth.

    **Returns:** height width, scene units: inf where the denominator is 0; NaN, missing, where
    it is negative or infinite and where the disparity is NaN.

    **Raises:** `ValueError` for a wrong shape or type.

    **Gradient:** exact in all three; zero where the depth is missing or inf.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import depth
    >>> disparity = np.array([[2, 0, np.nan]], np.float32)
    >>> print(depth.from_disparity(disparity, scale=0.25))
    [[ 2. inf nan]]

    Source: Ranftl et al. 2020, disparity up to scale and shift.
    """
    values, _ = _numbers("from_disparity(disparity)", disparity)
    scale = parameter("from_disparity(scale=...)", scale)
    shift = parameter("from_disparity(shift=...)", shift)
    return _from_disparity(values, scale, shift)


@one_program
def _from_disparity(values, scale, shift):
    is_number = jnp.isfinite(values)
    scale, shift = scale.astype(values.dtype), shift.astype(values.dtype)
    inverse_depth = jnp.where(is_number, values, 1) * scale + shift
    is_known = is_number & (inverse_depth > 0) & jnp.isfinite(inverse_depth)
    safe_depth = 1 / jnp.where(is_known, inverse_depth, 1)
    return _with_holes(safe_depth, is_known, is_number & (inverse_depth == 0))


@on_any_mesh
def from_stereo(
    disparity: Num[ArrayLike, "height width"],
    *,
    focal_pixels: Num[ArrayLike, ""] | float | int,
    baseline: Num[ArrayLike, ""] | float | int,
    disparity_offset: Num[ArrayLike, ""] | float | int = 0.0,
) -> Float[Array, "height width"]:
    """Depth from the disparity of a rectified pair of cameras.

    `depth = focal_pixels * baseline / (disparity + disparity_offset)`. The depth is missing
    where no match was found: where the disparity is 0, negative, NaN or inf.

    **Arguments:**

    - `disparity`: height width, pixels between the two images of a point. (OpenCV's integers
      count 16 steps per pixel, those of KITTI's files 256: divide first.)
    - `focal_pixels`: the focal length, in pixels.
    - `baseline`: the distance of the two cameras, scene units.
    - `disparity_offset`: the x of the second camera's principal point less that of the first,
      in pixels; the `doffs` of Middlebury's files.

    **Returns:** height width, scene units, NaN where missing.

    **Raises:** `ValueError` for a wrong shape or type, or a focal length or baseline that is
    not positive.

    **Gradient:** exact in all four; zero where the depth is missing.

    **Example:**

    >>> import numpy as np
    >>> from jaxfx import depth
    >>> disparity = np.array([[8, 0]], np.float32)
    >>> print(depth.from_stereo(disparity, focal_pixels=64.0, baseline=0.25))
    [[ 2. nan]]

    Source: Scharstein et al. 2014, the depth of a rectified pair with its offset.
    """
    values, _ = _numbers("from_stereo(disparity)", disparity)
    focal = parameter("from_stereo(focal_pixels=...)", focal_pixels)
    base = parameter("from_stereo(baseline=...)", baseline)
    check("from_stereo(focal_pixels=...)", focal, lambda v: v > 0, "positive")
    check("from_stereo(baseline=...)", base, lambda v: v > 0, "positive")
    offset = parameter("from_stereo(disparity_offset=...)", disparity_offset)
    return _from_stereo(values, focal, base, offset)


@one_program
def _from_stereo(values, focal, base, offset):
    is_match = jnp.isfinite(values) & (values > 0)
    shifted = jnp.where(is_match, values, 1) + offset.astype(values.dtype)
    is_known = is_match & (shifted > 0)
    product = focal.astype(values.dtype) * base.astype(values.dtype)
    safe_depth = product / jnp.where(is_known, shifted, 1)
    return _with_holes(safe_depth, is_known, jnp.zeros_like(is_known))


@on_any_mesh
def from_ray_distance(
    distance: Num[ArrayLike, "height width"], camera: PinholeCamera | OrthographicCamera
) -> Float[Array, "height width"]:
    """Depth along the optical axis from the distance along each pixel's ray.

    For path tracers and laser scanners. In the corner of a wide image the distance is half as
    long again as the depth.

    **Arguments:**

    - `distance`: height width, scene units from the eye, with holes as in `clean`.
    - `camera`: the camera, whose rays go through the pixels' centres. Those of an orthographic
      camera start on the plane of depth 0 and run along the axis: there the two are the same.

    **Returns:** height width, scene units: NaN where missing, inf for background.

    **Raises:** `ValueError` for a wrong shape or type.

    **Gradient:** exact in `distance` and the camera's intrinsics; zero where the depth is
    missing or inf, and in the pose.

    **Example:** 90 degrees wide, so that a corner's ray is longer than the axis by sqrt(3):

    >>> import jax.numpy as jnp
    >>> from jaxfx import PinholeCamera, depth
    >>> camera = PinholeCamera.from_fov(jnp.pi / 2, height=8, width=8)
    >>> distance = depth.from_ray_distance(jnp.ones((8, 8)), camera)
    >>> print(distance.shape, round(float(distance[0, 0]), 2))
    (8, 8) 0.63
    """
    check_camera("from_ray_distance(camera)", camera)
    values, is_background = _numbers_and_sky("from_ray_distance(distance)", distance, None)
    is_pinhole = isinstance(camera, PinholeCamera)
    factor = _axis_per_ray(camera, values) if is_pinhole else jnp.ones((), values.dtype)
    return _scaled(values, is_background, factor)


@one_program
def _axis_per_ray(
    camera: PinholeCamera, like: Float[Array, "height width"]
) -> Float[Array, "height width"]:
    """Depth per unit of distance along each pixel's ray, a ratio; `like` has shape and type."""
    height, width = like.shape
    pixels = pixel_centers(height, width, like.dtype)
    columns = inverse(camera.intrinsics).astype(like.dtype).T[:, None, None, :]
    rays = pixels[..., :1] * columns[0] + pixels[..., 1:] * columns[1] + columns[2]
    return rays[..., 2] / jnp.linalg.norm(rays, axis=-1)


@final
class Filled(eqx.Module):
    """A depth without holes, and where it was filled.

    - `depth`: height width, scene units.
    - `filled`: height width, true where the depth was missing and is now another pixel's.
    """

    depth: Float[Array, "height width"]
    filled: Bool[Array, "height width"]


@on_any_mesh
def fill(
    depth: Num[ArrayLike, "height width"],
    image: Float[ArrayLike, "height width channel"] | None = None,
    *,
    method: Literal["guided", "rows"] = "guided",
) -> Filled:
    """Fill each pixel whose depth is missing with the depth of a known pixel.

    Depths are copied, never averaged: between two surfaces there is none. With `image`, a hole
    is filled up to the edges that the image shows.

    **Arguments:**

    - `depth`: height width, with holes as in `clean`; inf is known and stays.
    - `image`: height width channel, linear, black 0 to white 1, whose edges guide.
    - `method`: `"guided"`, or the baseline `"rows"`; see below.

    **Returns:** `Filled`, of the depth and the pixels that were filled. A depth that is missing
    everywhere is an error, but under a transform, where values can't be checked, it is
    returned as it is.

    **Raises:** `ValueError` for a wrong shape or type, or where no depth is known.

    **Gradient:** exact in `depth`: each filled pixel's goes to the one that it copies. Zero in
    `image`; missing is that a change of it changes which pixel is copied.

    **Example:** a hole between a near and a far surface takes the depth of the far one:

    >>> import jax.numpy as jnp
    >>> from jaxfx import depth
    >>> holed = jnp.full((8, 8), 5.0).at[:, :3].set(2.0).at[4, 3:5].set(jnp.nan)
    >>> print(depth.fill(holed).depth[4])
    [2. 2. 2. 5. 5. 5. 5. 5.]

    Depth cameras and stereo pairs miss mostly what lies beside a near object, where it hides
    the background from the second eye. So the farther of a gap's two ends is the better guess.

    - `"rows"` takes the farther of the nearest known depths on either side in the row; in a
      row without any, in the column.
    - `"guided"` takes the depth at the end of the cheapest path through the hole. A path costs
      its length and, above all, the edges of `image` that it crosses, so that a depth fills
      the surface that the image shows. It costs more where it leaves the known pixels with a
      depth that is nearer than that of `"rows"`. Finally the filled pixels take the median of
      the 3 x 3 pixels around them, twice, so that none stands alone. It does not continue
      slopes: a wide hole in a floor becomes flat steps.

    Source: our own. Distances over an image: Criminisi, Sharp & Blake 2008; the farther end as
    the guess for what is hidden: Hirschmüller 2008.
    """
    values, is_background = _numbers_and_sky("fill(depth)", depth, None)
    values = _scaled(values, is_background, jnp.ones((), values.dtype))
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
    return Filled(_filled(values, guide, method), is_missing)


@functools.partial(one_program, static_argnums=2)
def _filled(
    values: Float[Array, "height width"],
    guide: Float[Array, "height width channel"],
    method: str,
) -> Float[Array, "height width"]:
    constant, guide = jax.lax.stop_gradient((values, guide.astype(values.dtype)))
    source = farther_ends(constant)
    if method == "guided":
        source = cheapest_sources(constant, guide, constant.reshape(-1)[source])
    return values.reshape(-1)[source]


def _numbers(name: str, values: Any) -> tuple[Float[Array, "height width"], bool]:
    """`values` as floats, height width, and whether they were integers.

    NaN where a NumPy mask hides them.
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
    # JAX's own type for it: to ask for float64 by name, where it is off, would warn.
    of_jax = jax.dtypes.canonicalize_dtype(float if is_integer else array.dtype)
    dtype = of_jax if is_integer else working_dtype(of_jax)
    array = as_array(name, array.astype(dtype))
    if is_masked:
        array = jnp.where(np.ma.getmaskarray(values), jnp.nan, array)
    return array, is_integer


def _numbers_and_sky(
    name: str, values: Any, sky: tuple[float | int, ...] | None
) -> tuple[Float[Array, "height width"], Bool[Array, "height width"]]:
    """`values` as floats, and where they are background, by `sky` or `SKY`."""
    numbers, is_integer = _numbers(name, values)
    if sky is None:
        sky = () if is_integer else SKY
    return numbers, _is_sky(numbers, tuple(sky))


@functools.partial(one_program, static_argnums=1)
def _is_sky(numbers, sky):
    is_background = jnp.isinf(numbers) & (numbers > 0)
    for mark in sky:
        is_background |= numbers == jnp.asarray(mark, numbers.dtype)
    if sky:
        is_background |= numbers >= jnp.asarray(max(sky), numbers.dtype)
    return is_background


@one_program
def _scaled(
    values: Float[Array, "height width"],
    is_background: Bool[Array, "height width"],
    factor: Float[Array, "..."],
) -> Float[Array, "height width"]:
    """The values that are depths, times a factor; inf for background, NaN elsewhere."""
    is_known = (values > 0) & ~is_background
    safe_depth = jnp.where(is_known, values, 1) * factor.astype(values.dtype)
    return _with_holes(safe_depth, is_known, is_background)


def _with_holes(
    depth: Float[Array, "height width"],
    is_known: Bool[Array, "height width"],
    is_background: Bool[Array, "height width"],
) -> Float[Array, "height width"]:
    """`depth` where `is_known`, inf for background, NaN elsewhere."""
    return jnp.where(is_known, depth, jnp.where(is_background, jnp.inf, jnp.nan))
