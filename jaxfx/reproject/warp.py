"""The image of one camera as another camera would see it."""

import equinox as eqx
from jaxtyping import Array, Float, Num

from jaxfx._arguments import check_camera
from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, check_image
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import working_dtype
from jaxfx._sampling import pixel_centers
from jaxfx.camera import Camera, PinholeCamera
from jaxfx.reproject.arguments import (
    Search,
    check_image_depth,
    check_search,
    check_size,
    check_threshold,
)
from jaxfx.reproject.view import trace_pixels


@on_any_mesh
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
    """An image with depth, seen from another camera, and a mask of the pixels that it shows.

    The cost does not depend on how complex the scene is. With the image's own camera the image
    returns unchanged.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the camera's axis, inf for background. What is 0,
      negative or NaN is missing: a hole, at whose border a surface ends. Rays pass through it
      to what is known beyond, and nothing is read from it.
    - `camera`: the camera of the image, a pinhole.
    - `target`: the camera to see it from, a pinhole or an orthographic one.
    - `height`, `width`: static; of the result, in pixels, both or none: the image's by default.
    - `search`: how rays find the surface, as in `intersect`; "pyramid" is exact.
    - `hole_threshold`: static; the step in depth between neighbours, as a ratio to the nearer
      one's depth, above which they are two surfaces with a gap between them. Smaller makes
      holes in slanted surfaces, larger draws skins between objects.

    **Returns:** `image`, rows columns channel, in the type of `image`, 0 where nothing is
    known; and `alpha`, rows columns: 1, or 0 where the ray leaves the frustum, goes through a
    gap or ends in a hole.

    **Raises:** `ValueError` for a wrong shape or size, a camera of another kind, an unknown
    search or a threshold that is not positive.

    **Gradient:** exact with respect to `image`, and to `depth` and both cameras through the
    point that each pixel shows; second derivatives are not. Missing: visibility. What comes
    into sight at a silhouette, or leaves it, has no derivative, nor has `alpha`.

    **Example:** the camera moves to the right, past a plane; a column comes into sight.

    >>> import numpy as np
    >>> from jaxfx import PinholeCamera, reproject
    >>> image, depth = np.ones((8, 8, 3), np.float32), np.full((8, 8), 2.0, np.float32)
    >>> camera = PinholeCamera.from_fov(1.0, height=8, width=8)
    >>> pose = np.eye(4)
    >>> pose[0, 3] = 0.3
    >>> target = PinholeCamera.from_fov(1.0, height=8, width=8, world_from_camera=pose)
    >>> moved, alpha = reproject.warp(image, depth, camera, target)
    >>> moved.shape, int(alpha.sum())
    ((8, 8, 3), 56)

    The ray of each target pixel is transformed to (x, y, -1/z) of `camera`, where lines stay
    lines, and clipped to the frustum. Where it meets the depth, on the bilinear patch of the
    texel centres, the image is read, bilinearly and within one surface. A depth of inf is a
    surface at infinity: a sky turns with the camera.

    There is one layer: what the camera did not see stays empty. The result has the image's
    sharpness, aliasing and highlights, and is not antialiased where it is drawn smaller. A thin
    object seen from its side is as thick as the camera saw it wide.

    Source: Kim, Ki, Lee & Oh, image reprojection on the GPU; gaps as holes, the exact identity
    and the derivative are our own.
    """
    image = check_image("warp(image)", image)
    depth = check_image_depth("warp", depth, image.shape[:2])
    check_camera("warp(camera)", camera, PinholeCamera)
    check_camera("warp(target)", target)
    size = check_size("warp", height, width, image.shape[:2])
    check_search("warp", search)
    hole_threshold = check_threshold("warp", hole_threshold)
    return _warped(image, depth, camera, target, size, search, hole_threshold)


@eqx.filter_jit
def _warped(
    image: Array,
    depth: Array,
    camera: PinholeCamera,
    target: Camera,
    size: tuple[int, int],
    search: str,
    hole_threshold: int | float,
) -> tuple[Float[Array, "rows columns channel"], Float[Array, "rows columns"]]:
    """`warp` of checked arguments; `size` is height and width of the result, in pixels."""
    depth = depth.astype(working_dtype(depth.dtype))
    pixels = pixel_centers(*size, depth.dtype).reshape(-1, 2)
    options = {"search": search, "hole_threshold": hole_threshold}
    view = trace_pixels(depth, camera, target, pixels, **options)
    colors = view.patch.read_colors(image)
    return colors.reshape(*size, -1), view.mask.astype(image.dtype).reshape(size)
