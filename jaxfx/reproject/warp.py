"""The picture of one camera as another would take it."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float, Num

from jaxfx._arguments import check_camera
from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, check_image, number, parameter, whole_number
from jaxfx._numerics import working_dtype
from jaxfx._sampling import pixel_centers
from jaxfx.camera import PinholeCamera
from jaxfx.reproject._rays import Camera
from jaxfx.reproject._view import look
from jaxfx.reproject._walk import LARGEST
from jaxfx.reproject.intersect import Search, check_search


def warp(
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    camera: PinholeCamera,
    target: Camera,
    *,
    height: WholeNumber | None = None,
    width: WholeNumber | None = None,
    search: Search = "pyramid",
    hole_threshold: Number = 0.1,
) -> tuple[Float[Array, "rows columns channel"], Float[Array, "rows columns"]]:
    """A picture with depth, from another camera: what it shows, and where it shows something.

    The ray of every target pixel is taken to (x, y, -1 / z) of the source, where lines stay
    lines, and clipped to the source's frustum; where it meets the depth, through the patch of
    the texels' centres, the picture is read, bilinearly and inside one surface. Its cost does
    not depend on how complex the scene is. With the source's own camera the picture returns
    unchanged. Depth inf is a surface at infinity: a sky turns with the camera.

    It knows one layer: what the source did not see stays empty. It has the source's sharpness,
    its aliasing and its highlights, and does not antialias where it draws smaller. A thin thing
    seen from its side is as thick as the source saw it wide.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the source's axis, inf for background. What is 0,
      negative or NaN is missing: a hole, at whose border a surface ends. Rays pass through it
      to what is known beyond, and nothing is read from it.
    - `camera`: the camera that took the picture, a pinhole.
    - `target`: the camera to see it from, a pinhole or an orthographic one.
    - `height`, `width`: static; size of the result in pixels, both or neither; the image's own
      by default.
    - `search`: as in `intersect`.
    - `hole_threshold`: static; the step in depth between neighbours, as a ratio to the nearer
      one's depth, above which they are two surfaces with a gap between them. Smaller makes
      holes in slanted surfaces, larger draws skins between things.

    **Returns:** `image`, rows columns channel, in the type of `image`, 0 where nothing is
    known; and `alpha`, rows columns: 1, or 0 where the ray leaves the frustum, goes through a
    gap or ends in a hole.

    **Raises:** `ValueError` for a wrong shape or size, a camera of another kind, an unknown
    search or a threshold that is not positive.

    **Gradient:** exact with respect to `image`, and to `depth` and both cameras through the
    point that each pixel shows; second derivatives are not. Missing: visibility. What comes
    into sight at a silhouette, or leaves it, has no derivative, nor has `alpha`.

    Source: Kim, Ki, Lee & Oh, image reprojection on the GPU; the walls as holes, the exact
    identity and the derivative are our own.
    """
    image = check_image("warp(image)", image)
    depth = check_source("warp", depth, image.shape[:2])
    check_cameras("warp", camera, target)
    shape = check_options("warp", (height, width), image.shape[:2], search, hole_threshold)
    return _drawn(image, depth, camera, target, shape, search, float(hole_threshold))


@eqx.filter_jit
def _drawn(
    image: Array,
    depth: Array,
    camera: PinholeCamera,
    target: Camera,
    shape: tuple[int, int],
    search: str,
    hole_threshold: int | float,
) -> tuple[Float[Array, "rows columns channel"], Float[Array, "rows columns"]]:
    dtype = working_dtype(depth.dtype)
    pixels = pixel_centers(*shape, dtype).reshape(-1, 2)
    options = {"search": search, "hole_threshold": hole_threshold}
    view = look(depth.astype(dtype), camera, target, pixels, **options)
    drawn = view.patch.read_colors(image)
    return drawn.reshape(*shape, -1), view.mask.astype(image.dtype).reshape(shape)


def check_source(caller: str, depth: Any, shape: tuple[int, ...]) -> Array:
    """`depth` as a float array of `shape`, whatever it holds; `ValueError` otherwise."""
    array = parameter(f"{caller}(depth)", depth, None)
    if array.shape != shape or max(shape) > LARGEST:
        raise ValueError(
            f"`{caller}(depth)` must have the image's height and width {shape}, each at most "
            f"{LARGEST}, got {array.shape}."
        )
    return array


def check_cameras(caller: str, camera: Any, target: Any) -> None:
    """Raise `ValueError` for cameras of a kind that is not served."""
    check_camera(f"{caller}(camera)", camera, PinholeCamera)
    check_camera(f"{caller}(target)", target)


def check_options(
    caller: str,
    size: tuple[Any, Any],
    default: tuple[int, ...],
    search: str,
    hole_threshold: Any,
) -> tuple[int, int]:
    """The height and width of the result; `ValueError` for an option out of range."""
    check_search(caller, search)
    number(f"{caller}(hole_threshold=...)", hole_threshold, expected="a positive number")
    if size == (None, None):
        size = default[0], default[1]
    for name, side, other in zip(("height", "width"), size, size[::-1], strict=True):
        if side is None:
            raise ValueError(
                f"`{caller}({name}=...)` must be given with the other one, {other}, got None."
            )
        whole_number(f"{caller}({name}=...)", side, expected="a positive integer, in pixels")
    return int(size[0]), int(size[1])
