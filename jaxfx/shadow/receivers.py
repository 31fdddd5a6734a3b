"""Receivers: the visible points of an image in a light's space."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from jaxfx._arguments import check_camera
from jaxfx._arrays import ArrayLike
from jaxfx._checks import check, check_map, items, parameter
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import absolute, normalize, safe_divide, safe_sqrt, working_dtype
from jaxfx._sampling import pixel_centers
from jaxfx.camera import Camera, OrthographicCamera, PinholeCamera
from jaxfx.camera.rigid import at_origin, per_depth


_Image = Float[Array, "height width"]
_Mask = Bool[Array, "height width"]
_Vectors = Float[Array, "height width 3"]

# Sine of the angle between a ray of light and a surface, 0.6 degrees. A surface that is flatter
# to the light counts as this: `slope` tends to infinity there, and with it the bias that hides
# the shadows which the surface receives.
_LEAST_SINE = 0.01


class Receivers(NamedTuple):
    """The visible points of an image in a light's space, one per pixel.

    - `u`, `v`: height width; the shadow-map pixel (x, y), centres at +0.5.
    - `z`: height width; depth from the light, in scene units.
    - `slope`: height width, scene units; how much that depth changes along the surface from one
      shadow-map pixel to the next, the sum over both axes.
    """

    u: Float[Array, "height width"]
    v: Float[Array, "height width"]
    z: Float[Array, "height width"]
    slope: Float[Array, "height width"]


@on_any_mesh
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
    """The visible points in the light's space, to be compared with its shadow map.

    The first step of every shadow: all filters take the result.

    **Arguments:**

    - `depth`: height width, scene units along the optical axis, inf for background.
    - `camera`: the camera that sees `depth`.
    - `light_camera`: the camera of the shadow map, also in a sequence of one; or several
      pinholes around one point, as for the faces of a cube. Each point is looked up in the one
      before which it has the largest depth. Their maps stand side by side, each as wide as
      twice its principal point's x. `light_cameras` makes all of them.
    - `normal`: height width 3, unit, world space. Left out, it is that of the surface through
      the neighbouring pixels, on the side where the depth jumps less.
    - `normal_offset`: scene units by which points are moved along their normals first, which
      keeps a surface out of its own shadow.

    **Returns:** `Receivers`, in the type of `depth`. A pixel that shows nothing, or a point
    that is not before the light, has -1 for `u`, `v` and `z`: it is lit.

    **Raises:** `ValueError` for a wrong shape, no camera, or an orthographic one of several.

    **Gradient:** exact with respect to `depth`, `normal`, `normal_offset` and every field of
    the cameras. Which neighbour defines the normal and which camera is taken are held.

    **Example:** a wall at depth 4, lit by a light two units behind the camera:

    >>> import jax.numpy as jnp
    >>> from jaxfx import OrthographicCamera, shadow
    >>> camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> light_camera = OrthographicCamera(2.0, [8, 8], jnp.eye(4).at[2, 3].set(-2))
    >>> receivers = shadow.receivers(jnp.full((8, 8), 4.0), camera, light_camera)
    >>> float(receivers.u[0, 0]), float(receivers.z[0, 0])
    (1.0, 6.0)

    Source: Williams 1978, section 3; the offset is Holbert 2011's, the slope what is now known
    as slope-scaled bias.
    """
    depth = check_map("receivers(depth)", depth)
    check_camera("receivers(camera)", camera)
    name, cameras = "receivers(light_camera)", (light_camera,)
    if not isinstance(light_camera, Camera):
        cameras = tuple(items(name, light_camera, "a camera or a sequence of them"))
    for at_light in cameras:
        check_camera(name, at_light)
    if not cameras:
        raise ValueError("`receivers(light_camera)` must be at least one camera, got none.")
    if len(cameras) > 1 and not all(isinstance(item, PinholeCamera) for item in cameras):
        kinds = ", ".join(type(item).__name__ for item in cameras)
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
    is_surface = (depth > 0) & jnp.isfinite(depth)
    safe_depth = jnp.where(is_surface, depth, 1).astype(dtype)
    points = camera.unproject(pixel_centers(height, width, dtype), safe_depth)
    if normal is None:
        normal = _surface_normals(points, safe_depth, is_surface)
    else:
        # Where there is no surface it may be NaN, and a derivative multiplies it by 0.
        normal = jnp.where(is_surface[..., None], normal, 0).astype(dtype)
    points = points + offset.astype(dtype) * normal

    deepest, *others = (_in_light_space(points, normal, is_surface, item) for item in cameras)
    left_edge = jnp.zeros((), dtype)  # of a camera's map, in pixels, among those side by side
    for previous, other in zip(cameras, others, strict=False):
        left_edge = left_edge + 2 * previous.intrinsics[0, 2].astype(dtype)
        face = other._replace(u=jnp.where(other.z > 0, other.u + left_edge, -1))
        pairs = zip(face, deepest, strict=True)
        deepest = Receivers(*(jnp.where(face.z > deepest.z, a, b) for a, b in pairs))
    return Receivers(*(field.astype(depth.dtype) for field in deepest))


def _in_light_space(
    points: _Vectors, normal: _Vectors, is_surface: _Mask, camera: Camera
) -> Receivers:
    """World points as receivers of one camera; -1 for those that are not before it."""
    is_before = is_surface & (camera.project(points)[1] > 0)
    one = jnp.ones((1,), points.dtype)
    stand_in = camera.unproject(jnp.zeros((1, 2), points.dtype), one)
    points = jnp.where(is_before[..., None], points, jnp.broadcast_to(stand_in, points.shape))
    pixels, z = camera.project(points)

    # Along the surface: normal . (u_axis du + v_axis dv + z_axis dz) = 0.
    u_axis, v_axis, z_axis = _light_axes(camera, pixels, z)
    across = absolute(_dot(normal, u_axis)) + absolute(_dot(normal, v_axis))
    along = absolute(_dot(normal, z_axis))
    least = _LEAST_SINE * safe_sqrt(_dot(z_axis, z_axis) * _dot(normal, normal))
    slope = safe_divide(across, jnp.maximum(along, least))
    u, v, z = (jnp.where(is_before, x, -1) for x in (pixels[..., 0], pixels[..., 1], z))
    return Receivers(u, v, z, jnp.where(is_before, slope, 0))


def _light_axes(camera: Camera, pixels: Float[Array, "height width 2"], z: _Image):
    """The derivatives of the world point with respect to its u, v and z, three vectors each.

    They are differences of one step, which is exact: the point is linear in each of the three.
    """
    camera, zero = at_origin(camera), jnp.zeros_like(pixels)
    right, down = (zero.at[..., axis].set(1) for axis in (0, 1))
    start = camera.unproject(zero, z)
    sides = camera.unproject(right, z) - start, camera.unproject(down, z) - start
    return *sides, per_depth(camera, pixels)


def _dot(a: _Vectors, b: _Vectors) -> _Image:
    return jnp.sum(a * b, axis=-1)


def _surface_normals(points: _Vectors, depth: _Image, is_surface: _Mask) -> _Vectors:
    """Unit normals, towards the camera, of the surface through neighbouring pixels' points."""
    # Unit vectors before the product: that of very small or large steps leaves float32's range.
    along_x = normalize(_neighbor_step(points, depth, is_surface, axis=1))
    along_y = normalize(_neighbor_step(points, depth, is_surface, axis=0))
    # Rows go down and columns right, so this points at the camera.
    return normalize(jnp.cross(along_y, along_x))


def _neighbor_step(points: _Vectors, depth: _Image, is_surface: _Mask, axis: int) -> _Vectors:
    """From the previous point along an axis, or to the next: where the depth jumps less.

    0 where neither neighbour shows a surface.
    """
    count = depth.shape[axis]
    step = jnp.diff(points, axis=axis)
    is_pair = jax.lax.slice_in_dim(is_surface, 1, count, axis=axis)
    is_pair &= jax.lax.slice_in_dim(is_surface, 0, count - 1, axis=axis)
    jump = jnp.where(is_pair, jnp.abs(jnp.diff(depth, axis=axis)), jnp.inf)
    step = jnp.where(is_pair[..., None], step, 0)

    def to_next_and_previous(x, fill):
        edge = [(0, 0, 0)] * x.ndim
        value = jnp.asarray(fill, x.dtype)
        after, before = edge.copy(), edge.copy()
        after[axis], before[axis] = (0, 1, 0), (1, 0, 0)
        return jax.lax.pad(x, value, after), jax.lax.pad(x, value, before)

    next_jump, previous_jump = to_next_and_previous(jump, jnp.inf)
    next_step, previous_step = to_next_and_previous(step, 0)
    return jnp.where((next_jump <= previous_jump)[..., None], next_step, previous_step)
