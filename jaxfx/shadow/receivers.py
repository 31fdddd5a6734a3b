"""Where the visible points of a picture lie in a light's view."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Num

from jaxfx._arguments import check_camera
from jaxfx._checks import check, check_map, items, parameter
from jaxfx._numerics import absolute, normalize, safe_divide, safe_sqrt, working_dtype
from jaxfx._sampling import pixel_centers
from jaxfx.camera import Camera, OrthographicCamera, PinholeCamera
from jaxfx.camera._rigid import at_origin, per_depth


_Image = Float[Array, "height width"]
_Vectors = Float[Array, "height width 3"]

# The slope of a surface that a ray of light meets at a flatter angle (sine) is that of this.
_FLATTEST = 0.01


class Receivers(NamedTuple):
    """The visible points of a picture in a light's space, one a pixel.

    - `u`, `v`: height width; the shadow-map pixel (x, y), centres at +0.5.
    - `z`: height width; depth from the light, in scene units.
    - `slope`: height width; how much that depth changes along the surface from one shadow-map
      pixel to the next, the sum over both axes, in scene units.
    """

    u: Float[Array, "height width"]
    v: Float[Array, "height width"]
    z: Float[Array, "height width"]
    slope: Float[Array, "height width"]


def receivers(
    depth: Num[ArrayLike, "height width"],
    camera: PinholeCamera | OrthographicCamera,
    light_camera: PinholeCamera
    | OrthographicCamera
    | Sequence[PinholeCamera | OrthographicCamera],
    *,
    normal: Float[ArrayLike, "height width 3"] | None = None,
    normal_offset: Float[ArrayLike, ""] | float = 0.0,
) -> Receivers:
    """Each visible point in the light's space: what a shadow map is compared with.

    **Arguments:**

    - `depth`: height width, scene units along the optical axis, inf for background.
    - `camera`: the camera that sees `depth`.
    - `light_camera`: the camera at the light that the shadow map is made with, also in a
      sequence of one; or several pinholes, of which each point takes the one that it lies
      deepest before, as on a cube about a point light. Their maps then stand side by side, each
      as wide as twice its principal point's x. What `light_cameras` gives will do.
    - `normal`: height width 3, unit, world space; without it, that of the surface through the
      neighbouring pixels, on the nearer side in depth.
    - `normal_offset`: scene units; points are moved so far along their normals first, which
      keeps a surface out of its own shadow.

    **Returns:** `Receivers`, in the type of `depth`. A pixel that shows nothing, or that does
    not lie before the light, has -1 for `u`, `v` and `z`: it is lit.

    **Raises:** `ValueError` for a wrong shape, no camera, or an orthographic one of several.

    **Gradient:** exact with respect to `depth`, `normal`, `normal_offset` and every field of
    the cameras. Which neighbour tells the normal and which camera is taken do not move.

    Source: Williams 1978, section 3; the offset is Holbert 2011's, the slope what is now known
    as slope-scaled bias.
    """
    depth = check_map("receivers(depth)", depth)
    check_camera("receivers(camera)", camera)
    name, cameras = "receivers(light_camera)", (light_camera,)
    if not isinstance(light_camera, Camera):
        cameras = tuple(items(name, light_camera, "a camera or a sequence of them"))
    for each in cameras:
        check_camera(name, each)
    if not cameras:
        raise ValueError("`receivers(light_camera)` must be at least one camera, got none.")
    if len(cameras) > 1 and not all(isinstance(each, PinholeCamera) for each in cameras):
        kinds = ", ".join(type(each).__name__ for each in cameras)
        raise ValueError(
            f"`receivers(light_camera)` must be one camera or several pinholes, got {kinds}."
        )
    if normal is not None:
        normal = parameter("receivers(normal=...)", normal, (*depth.shape, 3))
    offset = parameter("receivers(normal_offset=...)", normal_offset)
    check("receivers(normal_offset=...)", offset, np.isfinite, "finite")
    return _receivers(depth, camera, cameras, normal, offset)


@jax.jit
def _receivers(depth, camera, cameras, normal, offset) -> Receivers:
    dtype = working_dtype(depth.dtype)
    height, width = depth.shape
    shown = (depth > 0) & jnp.isfinite(depth)
    safe = jnp.where(shown, depth, 1).astype(dtype)
    points = camera.unproject(pixel_centers(height, width, dtype), safe)
    if normal is None:
        normal = _normal(points, safe, shown)
    else:
        # Where nothing is shown it may be no number, and a derivative multiplies it by 0.
        normal = jnp.where(shown[..., None], normal, 0).astype(dtype)
    points = points + offset.astype(dtype) * normal

    first, *others = (_seen(points, normal, shown, each) for each in cameras)
    nearest, start = first, jnp.zeros((), dtype)
    for last, other in zip(cameras, others, strict=False):
        start = start + 2 * last.intrinsics[0, 2].astype(dtype)
        face = other._replace(u=jnp.where(other.z > 0, other.u + start, -1))
        pairs = zip(face, nearest, strict=True)
        nearest = Receivers(*(jnp.where(face.z > nearest.z, a, b) for a, b in pairs))
    return Receivers(*(field.astype(depth.dtype) for field in nearest))


def _seen(
    points: _Vectors, normal: _Vectors, shown: Bool[Array, "height width"], camera: Camera
) -> Receivers:
    """The points in one camera's space; -1 for those that are not before it."""
    before = shown & (camera.project(points)[1] > 0)
    one = jnp.ones((1,), points.dtype)
    stand_in = camera.unproject(jnp.zeros((1, 2), points.dtype), one)
    points = jnp.where(before[..., None], points, jnp.broadcast_to(stand_in, points.shape))
    pixels, z = camera.project(points)

    # Along the surface normal . (u_axis du + v_axis dv + z_axis dz) = 0.
    u_axis, v_axis, z_axis = _axes(camera, pixels, z)
    across = absolute(_dot(normal, u_axis)) + absolute(_dot(normal, v_axis))
    along = absolute(_dot(normal, z_axis))
    least = _FLATTEST * safe_sqrt(_dot(z_axis, z_axis) * _dot(normal, normal))
    slope = safe_divide(across, jnp.maximum(along, least))
    u, v, z = (jnp.where(before, each, -1) for each in (pixels[..., 0], pixels[..., 1], z))
    return Receivers(u, v, z, jnp.where(before, slope, 0))


def _axes(camera: Camera, pixels: Float[Array, "height width 2"], z: _Image):
    """How a world point moves with its u, v and z: exact, for it is linear in each."""
    camera, zero = at_origin(camera), jnp.zeros_like(pixels)
    right, down = (zero.at[..., axis].set(1) for axis in (0, 1))
    start = camera.unproject(zero, z)
    sides = camera.unproject(right, z) - start, camera.unproject(down, z) - start
    return *sides, per_depth(camera, pixels)


def _dot(one: _Vectors, other: _Vectors) -> _Image:
    return jnp.sum(one * other, axis=-1)


def _normal(points: _Vectors, depth: _Image, shown: Bool[Array, "height width"]) -> _Vectors:
    """Unit normals, towards the camera, of the surface through neighbouring pixels."""
    # As unit vectors, for a product of small steps, or of large ones, leaves float32's range.
    along_x = normalize(_step(points, depth, shown, axis=1))
    along_y = normalize(_step(points, depth, shown, axis=0))
    # Rows go down and columns right, so that this points at the camera.
    return normalize(jnp.cross(along_y, along_x))


def _step(points: _Vectors, depth: _Image, shown: Bool[Array, "height width"], axis: int):
    """The step to the next pixel, or from the last one: whichever jumps less in depth."""
    count = depth.shape[axis]
    step = jnp.diff(points, axis=axis)
    pair = jax.lax.slice_in_dim(shown, 1, count, axis=axis)
    pair &= jax.lax.slice_in_dim(shown, 0, count - 1, axis=axis)
    jump = jnp.where(pair, jnp.abs(jnp.diff(depth, axis=axis)), jnp.inf)
    step = jnp.where(pair[..., None], step, 0)

    def sides(x, fill):
        edge = [(0, 0, 0)] * x.ndim
        value = jnp.asarray(fill, x.dtype)
        after, before = edge.copy(), edge.copy()
        after[axis], before[axis] = (0, 1, 0), (1, 0, 0)
        return jax.lax.pad(x, value, after), jax.lax.pad(x, value, before)

    (next_jump, last_jump), (next_step, last_step) = sides(jump, jnp.inf), sides(step, 0)
    return jnp.where((next_jump <= last_jump)[..., None], next_step, last_step)
