"""Cameras as others write them, in our intrinsics and poses.

Ours: x right, y down, z forward; pixel centres at +0.5; poses `world_from_camera`.

| | axes | pose | centre of the first pixel |
|---|---|---|---|
| OpenCV | as ours | camera from world | 0 |
| COLMAP | as ours | camera from world, a quaternion | 0.5 |
| Blender | x right, y up, z backward | world from camera | 0.5 |
| NeRF | as Blender | world from camera | 0.5 |
| OpenGL | as Blender | camera from world | 0.5, rows from below |
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._checks import check, option, parameter
from jaxfx._numerics import common_dtype, normalize


Form = tuple[Float[Array, "3 3"], Float[Array, "4 4"]]
# Of COLMAP's models those without distortion, and their parameters.
_MODELS = {"SIMPLE_PINHOLE": "f, cx, cy", "PINHOLE": "fx, fy, cx, cy"}


def opencv(intrinsics: Any, rotation: Any, translation: Any) -> Form:
    """From a camera matrix and the motion of the world into the camera."""
    matrix = parameter("from_opencv(intrinsics)", intrinsics, (3, 3))
    turn = parameter("from_opencv(rotation=...)", rotation, (3, 3))
    move = parameter("from_opencv(translation=...)", translation, (3,))
    return matrix.at[:2, 2].add(0.5), _inverse(turn, move)


def colmap(model: Any, params: Any, qvec: Any, tvec: Any) -> Form:
    """From a line of `cameras.txt` and one of `images.txt`."""
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
    turn = jnp.stack([jnp.stack(row) for row in rows])
    move = parameter("from_colmap(tvec=...)", tvec, (3,))
    return matrix(focal[0], focal[-1], cx, cy), _inverse(turn, move)


def _quaternion(qvec: Any) -> Float[Array, "4"]:
    quaternion = parameter("from_colmap(qvec=...)", qvec, (4,))
    name, is_turn = "from_colmap(qvec=...)", lambda v: np.isfinite(v).all() and v.any()
    check(name, quaternion, is_turn, "a rotation's quaternion (w, x, y, z)")
    return quaternion


def blender(
    matrix_world: Any,
    lens: Any,
    sensor: tuple[Any, Any, Any],
    shift: tuple[Any, Any],
    size: tuple[int, int],
) -> Form:
    """From an object's matrix and its data: lens, sensor's width, height and fit, shifts."""
    lens = _positive("from_blender(lens=...)", lens)
    width_mm = _positive("from_blender(sensor_width=...)", sensor[0])
    height_mm = _positive("from_blender(sensor_height=...)", sensor[1])
    fit = option("from_blender(sensor_fit=...)", sensor[2], ("AUTO", "HORIZONTAL", "VERTICAL"))
    shift_x, shift_y = (
        parameter(f"from_blender(shift_{axis}=...)", each)
        for axis, each in zip("xy", shift, strict=True)
    )
    height, width = size
    is_wide = fit == "HORIZONTAL" or (fit == "AUTO" and width >= height)
    side = width if is_wide else height
    # The sensor's width is along the longer side, unless it is said to fit the height.
    focal = lens / (height_mm if fit == "VERTICAL" else width_mm) * side
    pose = parameter("from_blender(matrix_world)", matrix_world, (4, 4))
    # The scale of an object does not change what its camera takes.
    axes = normalize(pose[:3, :3].T).T
    pose = pose.at[:3, :3].set(axes)
    middle = width / 2 - shift_x * side, height / 2 + shift_y * side
    return matrix(focal, focal, *middle), _backward(pose)


def nerf(transform_matrix: Any, focal: Any, centre: Any, size: tuple[int, int]) -> Form:
    """From a frame of `transforms.json` and what is said there of all of them."""
    pose = parameter("from_nerf(transform_matrix)", transform_matrix, (4, 4))
    angle, *lengths = focal
    height, width = size
    if (angle is None) == (lengths[0] is None):
        given = "neither" if angle is None else "both"
        raise ValueError(
            "`from_nerf(camera_angle_x=..., fl_x=...)` must be given one of the two, "
            f"got {given}."
        )
    if angle is None:
        fl_x = _positive("from_nerf(fl_x=...)", lengths[0])
        fl_y = fl_x if lengths[1] is None else _positive("from_nerf(fl_y=...)", lengths[1])
    else:
        name = "from_nerf(camera_angle_x=...)"
        angle = parameter(name, angle)
        check(name, angle, lambda v: (v > 0) & (v < np.pi), "in (0, pi) radians")
        fl_x = fl_y = width / (2 * jnp.tan(angle / 2))
    middle = (
        parameter(f"from_nerf({name}=...)", side / 2 if each is None else each)
        for name, side, each in zip(("cx", "cy"), (width, height), centre, strict=True)
    )
    return matrix(fl_x, fl_y, *middle), _backward(pose)


def opengl(view: Any, projection: Any, size: tuple[int, int]) -> Form:
    """From the matrices of the pipeline, as they multiply a column."""
    view = parameter("from_opengl(view)", view, (4, 4))
    clip = parameter("from_opengl(projection)", projection, (4, 4))

    def is_perspective(p):
        return (p[3] == [0, 0, -1, 0]).all() and (p[:2, 3] == 0).all() and np.isfinite(p).all()

    expected = "a perspective projection, whose last row is 0 0 -1 0"
    check("from_opengl(projection)", clip, is_perspective, expected)
    height, width = size
    zero, one = jnp.zeros_like(clip[0, 0]), jnp.ones_like(clip[0, 0])
    # A pixel is half the size times 1 + x / w or 1 - y / w, where y and z turn round.
    rows = [
        [clip[0, 0], -clip[0, 1], 1 - clip[0, 2]],
        [-clip[1, 0], clip[1, 1], 1 + clip[1, 2]],
    ]
    scaled = [
        jnp.stack(row) * (side / 2) for row, side in zip(rows, (width, height), strict=True)
    ]
    intrinsics = jnp.stack([*scaled, jnp.stack([zero, zero, one])])
    return intrinsics, _backward(_inverse(view[:3, :3], view[:3, 3]))


def matrix(fx: Any, fy: Any, cx: Any, cy: Any) -> Float[Array, "3 3"]:
    """Focal lengths and principal point as intrinsics."""
    numbers = [jnp.asarray(each) for each in (fx, fy, cx, cy)]
    dtype = common_dtype(*(each.dtype for each in numbers))
    fx, fy, cx, cy = (each.astype(dtype) for each in numbers)
    zero, one = jnp.zeros_like(fx), jnp.ones_like(fx)
    rows = [[fx, zero, cx], [zero, fy, cy], [zero, zero, one]]
    return jnp.stack([jnp.stack(row) for row in rows])


def _positive(name: str, value: Any) -> Float[Array, ""]:
    number = parameter(name, value)
    check(name, number, lambda v: (v > 0) & (v < np.inf), "positive")
    return number


def _inverse(turn: Float[Array, "3 3"], move: Float[Array, "3"]) -> Float[Array, "4 4"]:
    """The pose of a camera whose axes are given from the world's: `turn @ x + move`."""
    dtype = common_dtype(turn.dtype, move.dtype)
    turn, move = turn.astype(dtype), move.astype(dtype)
    eye = -turn.T @ move
    last = jnp.asarray([[0, 0, 0, 1]], dtype)
    return jnp.concatenate([jnp.concatenate([turn.T, eye[:, None]], axis=1), last])


def _backward(pose: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """The pose with y and z, which ran up and backward, turned round."""
    return pose * jnp.asarray([1, -1, -1, 1], pose.dtype)[None]
