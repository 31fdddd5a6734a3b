"""Intrinsics and poses of this package from those of other programs.

Here: x right, y down, z forward; pixel centres at +0.5; poses `world_from_camera`. Elsewhere:

| program | axes | pose | centre of the first pixel |
|---|---|---|---|
| OpenCV | as here | camera from world | 0 |
| COLMAP | as here | camera from world, a quaternion | 0.5 |
| Blender | x right, y up, z backward | world from camera | 0.5 |
| NeRF | as Blender | world from camera | 0.5 |
| OpenGL | as Blender | camera from world | 0.5, the first row at the bottom |
"""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._checks import check, option, parameter
from jaxfx._numerics import common_dtype, normalize, one_program


# A camera's intrinsics and pose.
CameraFields = tuple[Float[Array, "3 3"], Float[Array, "4 4"]]
# COLMAP's models without distortion, and their parameters.
_MODELS = {"SIMPLE_PINHOLE": "f, cx, cy", "PINHOLE": "fx, fy, cx, cy"}


def opencv(intrinsics: Any, rotation: Any, translation: Any) -> CameraFields:
    """The fields of `PinholeCamera.from_opencv`."""
    matrix = parameter("from_opencv(intrinsics)", intrinsics, (3, 3))
    rotation = parameter("from_opencv(rotation=...)", rotation, (3, 3))
    translation = parameter("from_opencv(translation=...)", translation, (3,))
    return matrix.at[:2, 2].add(0.5), _inverse_pose(rotation, translation)


def colmap(model: Any, params: Any, qvec: Any, tvec: Any) -> CameraFields:
    """The fields of `PinholeCamera.from_colmap`."""
    names = _MODELS[option("from_colmap(model)", model, tuple(_MODELS))]
    params = parameter("from_colmap(params)", params, None)
    if params.shape != (names.count(",") + 1,):
        raise ValueError(f"`from_colmap(params)` must be {names}, got shape {params.shape}.")
    *focal, cx, cy = params
    w, x, y, z = normalize(_quaternion(qvec))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rotation = jnp.stack([jnp.stack(row) for row in rows])
    translation = parameter("from_colmap(tvec=...)", tvec, (3,))
    return matrix(focal[0], focal[-1], cx, cy), _inverse_pose(rotation, translation)


def _quaternion(qvec: Any) -> Float[Array, "4"]:
    """COLMAP's quaternion (w, x, y, z), of any length but 0."""
    name, is_rotation = "from_colmap(qvec=...)", lambda v: np.isfinite(v).all() and v.any()
    quaternion = parameter(name, qvec, (4,))
    check(name, quaternion, is_rotation, "a rotation's quaternion (w, x, y, z)")
    return quaternion


def blender(
    matrix_world: Any,
    lens: Any,
    sensor: tuple[Any, Any, Any],
    shift: tuple[Any, Any],
    size: tuple[int, int],
) -> CameraFields:
    """The fields of `PinholeCamera.from_blender`.

    `sensor` is the sensor's width, height and fit, `shift` those along x and y, `size` the
    image's height and width.
    """
    lens = _positive("from_blender(lens=...)", lens)
    width_mm = _positive("from_blender(sensor_width=...)", sensor[0])
    height_mm = _positive("from_blender(sensor_height=...)", sensor[1])
    fit = option("from_blender(sensor_fit=...)", sensor[2], ("AUTO", "HORIZONTAL", "VERTICAL"))
    shift_x, shift_y = (
        parameter(f"from_blender(shift_{axis}=...)", value)
        for axis, value in zip("xy", shift, strict=True)
    )
    height, width = size
    is_wide = fit == "HORIZONTAL" or (fit == "AUTO" and width >= height)
    side = width if is_wide else height
    # "AUTO" takes the sensor's width, even along columns.
    focal = lens / (height_mm if fit == "VERTICAL" else width_mm) * side
    pose = parameter("from_blender(matrix_world)", matrix_world, (4, 4))
    # The scale of a camera object does not change its image.
    axes = normalize(pose[:3, :3].T).T
    pose = pose.at[:3, :3].set(axes)
    middle = width / 2 - shift_x * side, height / 2 + shift_y * side
    return matrix(focal, focal, *middle), _flipped_axes(pose)


def nerf(transform_matrix: Any, focal: Any, center: Any, size: tuple[int, int]) -> CameraFields:
    """The fields of `PinholeCamera.from_nerf`.

    `focal` is `camera_angle_x`, `fl_x` and `fl_y`, `center` the principal point (x, y), `size`
    the image's height and width; what is None has its default.
    """
    pose = parameter("from_nerf(transform_matrix)", transform_matrix, (4, 4))
    angle, *lengths = focal
    height, width = size
    if (angle is None) == (lengths[0] is None):
        count = "neither" if angle is None else "both"
        raise ValueError(
            "`from_nerf(camera_angle_x=..., fl_x=...)` must be given one of the two, "
            f"got {count}."
        )
    if angle is None:
        fl_x = _positive("from_nerf(fl_x=...)", lengths[0])
    else:
        name = "from_nerf(camera_angle_x=...)"
        angle = parameter(name, angle)
        check(name, angle, lambda v: (v > 0) & (v < np.pi), "in (0, pi) radians")
        fl_x = width / (2 * jnp.tan(angle / 2))
    fl_y = fl_x if lengths[1] is None else _positive("from_nerf(fl_y=...)", lengths[1])
    middle = (
        parameter(f"from_nerf({name}=...)", side / 2 if value is None else value)
        for name, side, value in zip(("cx", "cy"), (width, height), center, strict=True)
    )
    return matrix(fl_x, fl_y, *middle), _flipped_axes(pose)


def opengl(view: Any, projection: Any, size: tuple[int, int]) -> CameraFields:
    """The fields of `PinholeCamera.from_opengl`; the matrices multiply column vectors."""
    view = parameter("from_opengl(view)", view, (4, 4))
    clip = parameter("from_opengl(projection)", projection, (4, 4))

    def is_perspective(p):
        return (p[3] == [0, 0, -1, 0]).all() and (p[:2, 3] == 0).all() and np.isfinite(p).all()

    expected = "a perspective projection, whose last row is 0 0 -1 0"
    check("from_opengl(projection)", clip, is_perspective, expected)
    height, width = size
    zero, one = jnp.zeros_like(clip[0, 0]), jnp.ones_like(clip[0, 0])
    # A pixel is half the size times (1 + x / w) or (1 - y / w); y and z change sign.
    rows = [
        [clip[0, 0], -clip[0, 1], 1 - clip[0, 2]],
        [-clip[1, 0], clip[1, 1], 1 + clip[1, 2]],
    ]
    scaled = [
        jnp.stack(row) * (side / 2) for row, side in zip(rows, (width, height), strict=True)
    ]
    intrinsics = jnp.stack([*scaled, jnp.stack([zero, zero, one])])
    return intrinsics, _flipped_axes(_inverse_pose(view[:3, :3], view[:3, 3]))


@functools.partial(one_program, static_argnums=(1, 2))
def matrix_of_fov(fov_y: Float[Array, ""], height: int, width: int) -> Float[Array, "3 3"]:
    """Intrinsics of square pixels with the principal point in the middle of the image."""
    focal = height / (2 * jnp.tan(fov_y / 2))
    return matrix(focal, focal, width / 2, height / 2)


@one_program
def matrix(fx: Any, fy: Any, cx: Any, cy: Any) -> Float[Array, "3 3"]:
    """Intrinsics of focal lengths and a principal point, in pixels."""
    numbers = [jnp.asarray(value) for value in (fx, fy, cx, cy)]
    dtype = common_dtype(*(number.dtype for number in numbers))
    fx, fy, cx, cy = (number.astype(dtype) for number in numbers)
    zero, one = jnp.zeros_like(fx), jnp.ones_like(fx)
    rows = [[fx, zero, cx], [zero, fy, cy], [zero, zero, one]]
    return jnp.stack([jnp.stack(row) for row in rows])


def _positive(name: str, value: Any) -> Float[Array, ""]:
    """`value` as a positive, finite float array; `ValueError` otherwise."""
    number = parameter(name, value)
    check(name, number, lambda v: (v > 0) & (v < np.inf), "positive")
    return number


@one_program
def _inverse_pose(
    rotation: Float[Array, "3 3"], translation: Float[Array, "3"]
) -> Float[Array, "4 4"]:
    """The pose of a camera in whose axes a world point X is `rotation @ X + translation`."""
    dtype = common_dtype(rotation.dtype, translation.dtype)
    rotation, translation = rotation.astype(dtype), translation.astype(dtype)
    eye = -rotation.T @ translation
    last = jnp.asarray([[0, 0, 0, 1]], dtype)
    return jnp.concatenate([jnp.concatenate([rotation.T, eye[:, None]], axis=1), last])


def _flipped_axes(pose: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """A pose with y up and z backward, with y down and z forward."""
    return pose * jnp.asarray([1, -1, -1, 1], pose.dtype)[None]
