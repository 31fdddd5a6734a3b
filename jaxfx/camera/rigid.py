"""Rigid poses: points to and from camera axes, and the arguments that both cameras check.

Used by both cameras, `jaxfx.reproject` and `jaxfx.shadow`.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import check, check_fields, check_map, parameter
from jaxfx._numerics import common_dtype, inverse, normalize, one_program, working_dtype
from jaxfx._sampling import pixel_centers


# Points, pixels and depths as people have them: arrays, numbers and lists, integers too.
Points = Num[ArrayLike, "... 3"] | Sequence[Any]
Pixels = Num[ArrayLike, "... 2"] | Sequence[Any]
Depths = Num[ArrayLike, "..."] | float | int | Sequence[Any]
DepthMap = Num[ArrayLike, "height width"] | Sequence[Any]

# A number without unit: how far entries of R^T R may be from the identity's. Files hold four
# digits; with less they are refused, with more a slight scale passes for a rotation.
_ORTHONORMAL = 1e-3


def broadcast_like(
    vector: Float[Array, " n"], like: Float[Array, "... n"]
) -> Float[Array, "... n"]:
    """`vector`, broadcast to the shape of `like`."""
    return jnp.broadcast_to(vector.astype(like.dtype), like.shape)


@one_program
def transformed(
    matrix: Float[Array, "3 3"], points: Float[Array, "... 3"]
) -> Float[Array, "... 3"]:
    """`matrix` times each point, written as sums: XLA would not fuse a matrix product."""
    columns = matrix.astype(points.dtype).T
    x, y, z = (points[..., i : i + 1] * broadcast_like(columns[i], points) for i in range(3))
    return x + y + z


@one_program
def to_world(
    world_from_camera: Float[Array, "4 4"], points: Float[Array, "... 3"]
) -> Float[Array, "... 3"]:
    """World points of points in camera axes."""
    pose = world_from_camera.astype(points.dtype)
    return transformed(pose[:3, :3], points) + broadcast_like(pose[:3, 3], points)


@one_program
def to_camera(
    world_from_camera: Float[Array, "4 4"], points: Float[Array, "... 3"]
) -> Float[Array, "... 3"]:
    """Points in camera axes of world points."""
    pose = world_from_camera.astype(points.dtype)
    return transformed(pose[:3, :3].T, points - broadcast_like(pose[:3, 3], points))


def rigid_pose(name: str, value: Any) -> Float[Array, "4 4"]:
    """`value` as a rigid pose; `ValueError` for any other. Traced values are not checked."""
    pose = parameter(name, value, (4, 4))
    tolerance = max(_ORTHONORMAL, 8 * float(jnp.finfo(pose.dtype).eps))

    def is_rigid(numbers):
        rotation, last = numbers[:3, :3].astype(np.float64), numbers[3]
        deviation = np.abs(rotation.T @ rotation - np.eye(3)).max()
        is_rotation = deviation < tolerance and np.linalg.det(rotation) > 0
        return is_rotation and np.isfinite(numbers).all() and (last == [0, 0, 0, 1]).all()

    check(name, pose, is_rigid, "a rotation and a finite position over the row 0 0 0 1")
    return pose


def read_points(camera: Any, method: str, points: Any, size: int) -> Array:
    """World points (`size` 3) or pixels (2), as floats; `ValueError` for a wrong shape."""
    name = f"{method}({'points' if size == 3 else 'pixels'})"
    check_fields(f"{type(camera).__name__}.{method}", camera)
    points = parameter(name, points, None)
    if points.shape[-1:] != (size,):
        raise ValueError(f"`{name}` must have shape (..., {size}), got {points.shape}.")
    return points


def read_pixels(camera: Any, pixels: Any, depth: Any) -> tuple[Array, Array, Any]:
    """Pixels and depths of one shape in the type to compute in, and the type of the result."""
    pixels = read_points(camera, "unproject", pixels, 2)
    depth = parameter("unproject(depth)", depth, None)
    try:
        shape = jnp.broadcast_shapes(pixels.shape[:-1], depth.shape)
    except ValueError:
        raise ValueError(
            f"`unproject(depth)` must have the pixels' shape {pixels.shape[:-1]}, "
            f"got {depth.shape}."
        ) from None
    dtype = common_dtype(pixels.dtype, depth.dtype)
    working = working_dtype(dtype)
    pixels = jnp.broadcast_to(pixels.astype(working), (*shape, 2))
    return pixels, jnp.broadcast_to(depth.astype(working), shape), dtype


def read_map(depth: Any) -> tuple[Array, Array, Any]:
    """Pixel centres and depth in the type to compute in, and the type of `depth`."""
    depth = check_map("points(depth)", depth)
    working = working_dtype(depth.dtype)
    height, width = depth.shape
    return pixel_centers(height, width, working), depth.astype(working), depth.dtype


def at_origin(camera: Any) -> Any:
    """The camera with its rotation, moved to the world's origin.

    For whatever does not depend on its position: a difference of two points far away from the
    origin would have few digits left.
    """
    pose = camera.world_from_camera.at[:3, 3].set(0)
    return eqx.tree_at(lambda camera: camera.world_from_camera, camera, pose)


def per_depth(camera: Any, pixels: Float[Array, "... 2"]) -> Float[Array, "... 3"]:
    """The world vector by which the ray of each pixel advances per unit of depth.

    Not a difference of two points of the ray: for a scene at 1e6 few digits would be left.
    """
    rotation, pixels = camera.world_from_camera[:3, :3], homogeneous(pixels)
    if hasattr(camera, "intrinsics"):
        return transformed(rotation, transformed(inverse(camera.intrinsics), pixels))
    return broadcast_like(rotation[:, 2], pixels)


@one_program
def homogeneous(pixels: Float[Array, "... 2"]) -> Float[Array, "... 3"]:
    """Homogeneous pixels (x, y, 1)."""
    return jnp.concatenate([pixels, jnp.ones_like(pixels[..., :1])], axis=-1)


def look_at_pose(eye: Any, at: Any, up: Any) -> Float[Array, "4 4"]:
    """The pose at `eye` that looks at `at`, with `up` towards the top of the image."""
    eye = parameter("look_at(eye)", eye, (3,))
    at = parameter("look_at(at)", at, (3,))
    up = parameter("look_at(up=...)", up, (3,))
    pose, forward, right = _pose_towards(eye, at, up)
    check("look_at(at)", forward, lambda v: v.any(), "away from `eye`")
    check("look_at(up=...)", right, lambda v: v.any(), "off the direction of view")
    return pose


@one_program
def _pose_towards(
    eye: Float[Array, "3"], at: Float[Array, "3"], up: Float[Array, "3"]
) -> tuple[Float[Array, "4 4"], Float[Array, "3"], Float[Array, "3"]]:
    """The pose, and its axes ahead and to the right: 0 where there is no direction."""
    forward = normalize(at - eye)
    right = normalize(jnp.cross(forward, up))
    down = jnp.cross(forward, right)
    columns = jnp.stack([right, down, forward, eye], axis=1)
    pose = jnp.concatenate([columns, jnp.array([[0, 0, 0, 1]], columns.dtype)])
    return pose, forward, right
