"""Cameras: x right, y down, z forward; poses are `world_from_camera`."""

from collections.abc import Sequence
from typing import Any, ClassVar, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Num

from jaxfx._checks import WholeNumber, check, check_fields, parameter, whole_number
from jaxfx._numerics import common_dtype, normalize, working_dtype


__all__ = ["Camera", "OrthographicCamera", "PinholeCamera"]

# Points, pixels and depths as people have them: arrays, numbers and lists, integers too.
_Points = Num[ArrayLike, "... 3"] | Sequence[Any]
_Pixels = Num[ArrayLike, "... 2"] | Sequence[Any]
_Depths = Num[ArrayLike, "..."] | Sequence[Any]

# How far a rotation's columns may be from orthonormal: files hold four digits.
_ORTHONORMAL = 1e-3


def _each(vector: Float[Array, " n"], like: Float[Array, "... n"]) -> Float[Array, "... n"]:
    """`vector` for every one of `like`'s."""
    return jnp.broadcast_to(vector.astype(like.dtype), like.shape)


def _transformed(
    matrix: Float[Array, "3 3"], points: Float[Array, "... 3"]
) -> Float[Array, "... 3"]:
    """`matrix` times each of `points`, written out: a matrix product would not be fused."""
    columns = matrix.astype(points.dtype).T
    x, y, z = (points[..., i : i + 1] * _each(columns[i], points) for i in range(3))
    return x + y + z


def _to_world(
    world_from_camera: Float[Array, "4 4"], points: Float[Array, "... 3"]
) -> Float[Array, "... 3"]:
    pose = world_from_camera.astype(points.dtype)
    return _transformed(pose[:3, :3], points) + _each(pose[:3, 3], points)


def _to_camera(
    world_from_camera: Float[Array, "4 4"], points: Float[Array, "... 3"]
) -> Float[Array, "... 3"]:
    pose = world_from_camera.astype(points.dtype)
    return _transformed(pose[:3, :3].T, points - _each(pose[:3, 3], points))


def _pose(name: str, value: Any) -> Float[Array, "4 4"]:
    """A rigid motion."""
    pose = parameter(name, value, (4, 4))
    room = max(_ORTHONORMAL, 8 * float(jnp.finfo(pose.dtype).eps))

    def is_rigid(numbers):
        turn, last = numbers[:3, :3].astype(np.float64), numbers[3]
        is_turn = np.abs(turn.T @ turn - np.eye(3)).max() < room and np.linalg.det(turn) > 0
        return is_turn and np.isfinite(numbers).all() and (last == [0, 0, 0, 1]).all()

    check(name, pose, is_rigid, "a rotation and a finite position over the row 0 0 0 1")
    return pose


def _read_points(camera: Any, method: str, points: Any, size: int) -> Array:
    """World points or pixels, in a float type; `ValueError` names what is none."""
    name = f"{method}({'points' if size == 3 else 'pixels'})"
    check_fields(f"{type(camera).__name__}.{method}", camera)
    points = parameter(name, points, None)
    if points.shape[-1:] != (size,):
        raise ValueError(f"`{name}` must have shape (..., {size}), got {points.shape}.")
    return points


def _read_pixels(camera: Any, pixels: Any, depth: Any) -> tuple[Array, Array, Any]:
    """Pixels and depths that fit, in the type to compute in; and the type of the result."""
    pixels = _read_points(camera, "unproject", pixels, 2)
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


def _look_at_pose(eye: Any, target: Any, up: Any) -> Float[Array, "4 4"]:
    eye = parameter("look_at(eye)", eye, (3,))
    target = parameter("look_at(target)", target, (3,))
    up = parameter("look_at(up=...)", up, (3,))
    forward = normalize(target - eye)
    right = normalize(jnp.cross(forward, up))
    check("look_at(target)", forward, lambda v: v.any(), "away from `eye`")
    check("look_at(up=...)", right, lambda v: v.any(), "off the direction of view")
    down = jnp.cross(forward, right)
    columns = jnp.stack([right, down, forward, eye], axis=1)
    return jnp.concatenate([columns, jnp.array([[0, 0, 0, 1]], columns.dtype)])


@final
class PinholeCamera(eqx.Module):
    """A perspective camera with square or oblong pixels, skew allowed.

    **Arguments:**

    - `intrinsics`: 3x3, from camera axes to pixels (focal lengths, positive, and principal
      point in pixels, last row 0 0 1).
    - `world_from_camera`: 4x4 rigid pose: an orthonormal rotation and a position.

    **Raises:** `ValueError` for a wrong shape, for intrinsics that are not finite or of another
    form, and for a pose with a scale, a shear or a mirror in it. Traced values can't be looked
    at: what such a pose shows is not what `unproject` gives.

    **Gradient:** exact with respect to both fields. The pose is not projected back onto the
    rigid motions: parametrize it, by a twist say, to stay on them.
    """

    SHAPES: ClassVar = {"intrinsics": (3, 3), "world_from_camera": (4, 4)}

    intrinsics: Float[Array, "3 3"]
    world_from_camera: Float[Array, "4 4"]

    def __init__(self, intrinsics: Any, world_from_camera: Any):
        name = "PinholeCamera(intrinsics)"
        self.intrinsics = parameter(name, intrinsics, (3, 3))
        check(
            name,
            self.intrinsics,
            lambda v: np.isfinite(v).all() & (np.diag(v) > 0).all() & (v[2] == [0, 0, 1]).all(),
            "finite, with positive focal lengths and the last row 0 0 1",
        )
        self.world_from_camera = _pose("PinholeCamera(world_from_camera)", world_from_camera)

    @classmethod
    def from_fov(
        cls,
        fov_y: Any,
        *,
        height: WholeNumber,
        width: WholeNumber,
        world_from_camera: Any | None = None,
    ) -> "PinholeCamera":
        """Square pixels and a centred principal point.

        **Arguments:**

        - `fov_y`: vertical field of view, in radians, between 0 and pi.
        - `height`, `width`: static; image size in pixels.
        - `world_from_camera`: the 4x4 pose; the identity by default.

        **Returns:** the camera.

        **Raises:** `ValueError` for a field of view out of range, a size that is no positive
        integer or a pose that is not rigid.

        **Gradient:** exact in `fov_y`.
        """
        fov_y = parameter("from_fov(fov_y)", fov_y)
        check("from_fov(fov_y)", fov_y, lambda v: (v > 0) & (v < jnp.pi), "in (0, pi) radians")
        height = whole_number("from_fov(height=...)", height)
        width = whole_number("from_fov(width=...)", width)
        focal = height / (2 * jnp.tan(fov_y / 2))
        zero, one = jnp.zeros_like(focal), jnp.ones_like(focal)
        rows = [
            [focal, zero, one * (width / 2)],
            [zero, focal, one * (height / 2)],
            [zero, zero, one],
        ]
        intrinsics = jnp.stack([jnp.stack(row) for row in rows])
        pose = jnp.eye(4, dtype=focal.dtype) if world_from_camera is None else world_from_camera
        return cls(intrinsics, pose)

    @classmethod
    def look_at(
        cls,
        eye: Any,
        target: Any,
        *,
        up: Any,
        fov_y: Any,
        height: WholeNumber,
        width: WholeNumber,
    ) -> "PinholeCamera":
        """The camera at `eye` that has `target` at the middle of its picture.

        **Arguments:**

        - `eye`, `target`: world positions, 3.
        - `up`: a world direction, 3, that points to the top of the picture.
        - `fov_y`, `height`, `width`: as in `from_fov`.

        **Returns:** the camera.

        **Raises:** `ValueError` where `eye` is `target` or `up` lies along the view.

        **Gradient:** exact; zero where the pose is degenerate.
        """
        pose = _look_at_pose(eye, target, up)
        return cls.from_fov(fov_y, height=height, width=width, world_from_camera=pose)

    def project(self, points: _Points) -> tuple[Float[Array, "... 2"], Float[Array, "..."]]:
        """Pixels and depth of world points.

        **Arguments:** `points`: world positions, `... 3`, in scene units, floats or integers.

        **Returns:** `pixels`, `... 2`, as (x, y) with centres at +0.5; and `depth`, `...`,
        along the optical axis, both in the type of `points`, of integers in JAX's default float
        type. A point behind the camera has a negative depth, and its pixels are those of the
        line through the eye.

        **Raises:** `ValueError` for a wrong shape, what is no array of numbers, or a batch of
        cameras.

        **Gradient:** exact; infinite where the depth is 0.
        """
        points = _read_points(self, "project", points, 3)
        dtype = points.dtype
        local = _to_camera(self.world_from_camera, points.astype(working_dtype(dtype)))
        depth = local[..., 2]
        scaled = _transformed(self.intrinsics, local)
        return (scaled[..., :2] / depth[..., None]).astype(dtype), depth.astype(dtype)

    def unproject(self, pixels: _Pixels, depth: _Depths) -> Float[Array, "... 3"]:
        """World points of pixels at a depth: the inverse of `project`.

        **Arguments:** `pixels`: `... 2`, (x, y); `depth`: `...`, scene units along the axis;
        floats or integers, one depth for several pixels or the other way round.

        **Returns:** world positions, `... 3`, in the wider type of the two, of integers in
        JAX's default float type. Infinite depth gives non-finite points.

        **Raises:** `ValueError` as `project`, and for a depth that does not fit the pixels.

        **Gradient:** exact.
        """
        pixels, depth, dtype = _read_pixels(self, pixels, depth)
        homogeneous = jnp.concatenate([pixels, jnp.ones_like(pixels[..., :1])], axis=-1)
        rays = _transformed(jnp.linalg.inv(self.intrinsics), homogeneous)
        return _to_world(self.world_from_camera, rays * depth[..., None]).astype(dtype)

    def through_lens(self, offset: Any, *, focus_distance: Any) -> "PinholeCamera":
        """The off-axis camera at a point of the lens whose focus plane stays where it is.

        A point at depth `focus_distance` keeps its pixel; one at depth Z moves by
        `offset * focal * (1 / focus_distance - 1 / Z)` pixels.

        **Arguments:**

        - `offset`: 2, from the lens' centre along the camera's x and y, in scene units.
        - `focus_distance`: depth of the plane that stays fixed, in scene units.

        **Returns:** the camera: the eye moved, the principal point sheared.

        **Raises:** `ValueError` for a focus distance that is not positive.

        **Gradient:** exact.

        Source: Haeberli & Akeley 1990, the accumulation buffer's depth of field.
        """
        dtype = self.intrinsics.dtype
        offset = parameter("through_lens(offset)", offset, (2,)).astype(dtype)
        distance = parameter("through_lens(focus_distance=...)", focus_distance).astype(dtype)
        check("through_lens(focus_distance=...)", distance, lambda v: v > 0, "positive")
        shear = self.intrinsics[:2, :2] @ offset / distance
        intrinsics = self.intrinsics.at[:2, 2].add(shear)
        axes = self.world_from_camera[:3, :2]
        pose = self.world_from_camera.at[:3, 3].add(
            axes @ offset.astype(self.world_from_camera.dtype)
        )
        return PinholeCamera(intrinsics, pose)


@final
class OrthographicCamera(eqx.Module):
    """A camera whose rays are parallel: a directional light's, say.

    **Arguments:**

    - `pixels_per_unit`: scale, in pixels per scene unit.
    - `centre`: 2, the pixel (x, y) of the optical axis.
    - `world_from_camera`: 4x4 rigid pose.

    **Raises:** `ValueError` for a wrong shape, a number that is not finite, a scale that is not
    positive, or a pose that is not rigid.

    **Gradient:** exact with respect to every field.
    """

    SHAPES: ClassVar = {"pixels_per_unit": (), "centre": (2,), "world_from_camera": (4, 4)}

    pixels_per_unit: Float[Array, ""]
    centre: Float[Array, "2"]
    world_from_camera: Float[Array, "4 4"]

    def __init__(self, pixels_per_unit: Any, centre: Any, world_from_camera: Any):
        name = "OrthographicCamera(pixels_per_unit)"
        self.pixels_per_unit = parameter(name, pixels_per_unit)
        check(name, self.pixels_per_unit, lambda v: (v > 0) & (v < np.inf), "positive")
        self.centre = parameter("OrthographicCamera(centre)", centre, (2,))
        check("OrthographicCamera(centre)", self.centre, np.isfinite, "finite")
        self.world_from_camera = _pose(
            "OrthographicCamera(world_from_camera)", world_from_camera
        )

    def project(self, points: _Points) -> tuple[Float[Array, "... 2"], Float[Array, "..."]]:
        """Pixels and depth of world points.

        **Arguments:** `points`: world positions, `... 3`, in scene units, floats or integers.

        **Returns:** `pixels`, `... 2`, (x, y); `depth`, `...`, along the optical axis; both in
        the type of `points`, of integers in JAX's default float type.

        **Raises:** `ValueError` for a wrong shape, what is no array of numbers, or a batch of
        cameras.

        **Gradient:** exact.
        """
        points = _read_points(self, "project", points, 3)
        dtype = points.dtype
        local = _to_camera(self.world_from_camera, points.astype(working_dtype(dtype)))
        pixels = local[..., :2] * self.pixels_per_unit.astype(local.dtype)
        pixels = pixels + _each(self.centre, pixels)
        return pixels.astype(dtype), local[..., 2].astype(dtype)

    def unproject(self, pixels: _Pixels, depth: _Depths) -> Float[Array, "... 3"]:
        """World points of pixels at a depth: the inverse of `project`.

        **Arguments:** `pixels`: `... 2`, (x, y); `depth`: `...`, scene units along the axis;
        floats or integers, one depth for several pixels or the other way round.

        **Returns:** world positions, `... 3`, in the wider type of the two, of integers in
        JAX's default float type.

        **Raises:** `ValueError` as `project`, and for a depth that does not fit the pixels.

        **Gradient:** exact.
        """
        pixels, depth, dtype = _read_pixels(self, pixels, depth)
        plane = pixels - _each(self.centre, pixels)
        plane = plane / self.pixels_per_unit.astype(pixels.dtype)
        local = jnp.concatenate([plane, depth[..., None]], axis=-1)
        return _to_world(self.world_from_camera, local).astype(dtype)


Camera = PinholeCamera | OrthographicCamera
