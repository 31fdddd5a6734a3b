"""The perspective camera, and the forms in which others write it."""

from typing import Any, ClassVar, Literal, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._checks import WholeNumber, check, check_fields, parameter, whole_number
from jaxfx._numerics import inverse, normalize, working_dtype
from jaxfx._sampling import pixel_centers
from jaxfx.camera import _conventions
from jaxfx.camera._records import Projection, Rays
from jaxfx.camera._rigid import (
    DepthMap,
    Depths,
    Pixels,
    Points,
    homogeneous,
    look_at_pose,
    read_map,
    read_pixels,
    read_points,
    rigid_pose,
    to_camera,
    to_world,
    transformed,
)


_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _size(function: str, height: Any, width: Any) -> tuple[int, int]:
    """The size of a picture; `ValueError` names a side that is no positive integer."""
    return (
        whole_number(f"{function}(height=...)", height),
        whole_number(f"{function}(width=...)", width),
    )


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
        self.world_from_camera = rigid_pose(
            "PinholeCamera(world_from_camera)", world_from_camera
        )

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
        height, width = _size("from_fov", height, width)
        focal = height / (2 * jnp.tan(fov_y / 2))
        intrinsics = _conventions.matrix(focal, focal, width / 2, height / 2)
        pose = jnp.eye(4, dtype=focal.dtype) if world_from_camera is None else world_from_camera
        return cls(intrinsics, pose)

    @classmethod
    def look_at(
        cls,
        eye: Any,
        at: Any,
        *,
        up: Any,
        fov_y: Any,
        height: WholeNumber,
        width: WholeNumber,
    ) -> "PinholeCamera":
        """The camera at `eye` that has `at` in the middle of its picture.

        **Arguments:**

        - `eye`, `at`: world positions, 3.
        - `up`: a world direction, 3, that points to the top of the picture.
        - `fov_y`, `height`, `width`: as in `from_fov`.

        **Returns:** the camera.

        **Raises:** `ValueError` where `eye` is `at` or `up` lies along the view.

        **Gradient:** exact; zero where the pose is degenerate.
        """
        pose = look_at_pose(eye, at, up)
        height, width = _size("look_at", height, width)
        return cls.from_fov(fov_y, height=height, width=width, world_from_camera=pose)

    @classmethod
    def from_opencv(
        cls, intrinsics: Any, *, rotation: Any = _UPRIGHT, translation: Any = (0.0, 0.0, 0.0)
    ) -> "PinholeCamera":
        """The camera of OpenCV's camera matrix, whose pixel centres are whole numbers.

        **Arguments:**

        - `intrinsics`: 3x3, the camera matrix of `calibrateCamera`, in pixels. Undistort
          pictures first.
        - `rotation`, `translation`: 3x3 and 3, camera from world, in scene units: `rotation @ X
          + translation` is X in camera axes. `cv2.Rodrigues` makes the one of `rvec`.

        **Returns:** the camera; its principal point is half a pixel farther along both axes.

        **Raises:** `ValueError` as `PinholeCamera`.

        **Gradient:** exact.
        """
        return cls(*_conventions.opencv(intrinsics, rotation, translation))

    @classmethod
    def from_colmap(cls, model: str, params: Any, *, qvec: Any, tvec: Any) -> "PinholeCamera":
        """The camera of a line of COLMAP's `cameras.txt` and one of its `images.txt`.

        **Arguments:**

        - `model`: "SIMPLE_PINHOLE" or "PINHOLE". Pictures with distortion are to be undistorted
          first, by COLMAP's `image_undistorter`.
        - `params`: f, cx, cy or fx, fy, cx, cy, in pixels.
        - `qvec`, `tvec`: 4 and 3, camera from world: a quaternion (w, x, y, z) of any length,
          and a translation in scene units.

        **Returns:** the camera.

        **Raises:** `ValueError` for another model or a wrong number of parameters.

        **Gradient:** exact.
        """
        return cls(*_conventions.colmap(model, params, qvec, tvec))

    @classmethod
    def from_blender(
        cls,
        matrix_world: Any,
        *,
        lens: Any,
        height: WholeNumber,
        width: WholeNumber,
        sensor_width: Any = 36.0,
        sensor_height: Any = 24.0,
        sensor_fit: Literal["AUTO", "HORIZONTAL", "VERTICAL"] = "AUTO",
        shift_x: Any = 0.0,
        shift_y: Any = 0.0,
    ) -> "PinholeCamera":
        """The camera of a Blender object, by the names that its properties have there.

        **Arguments:**

        - `matrix_world`: 4x4, world from camera, which looks along -z with y up; a scale in it
          is ignored, as Blender does.
        - `lens`: focal length, in the unit of the sensor: millimetres.
        - `height`, `width`: static; the render's size in square pixels, its percentage applied.
        - `sensor_width`, `sensor_height`, `sensor_fit`: lengths, and which of them the focal
          length is a ratio to: the width, along the longer side, or with "HORIZONTAL" along
          rows; or with "VERTICAL" the height, along columns.
        - `shift_x`, `shift_y`: ratios to the side in pixels that the sensor fits.

        **Returns:** the camera.

        **Raises:** `ValueError` for a length that is not positive or an unknown fit.

        **Gradient:** exact in every float.
        """
        size = _size("from_blender", height, width)
        sensor = sensor_width, sensor_height, sensor_fit
        shift = shift_x, shift_y
        return cls(*_conventions.blender(matrix_world, lens, sensor, shift, size))

    @classmethod
    def from_nerf(
        cls,
        transform_matrix: Any,
        *,
        height: WholeNumber,
        width: WholeNumber,
        camera_angle_x: Any | None = None,
        fl_x: Any | None = None,
        fl_y: Any | None = None,
        cx: Any | None = None,
        cy: Any | None = None,
    ) -> "PinholeCamera":
        """The camera of a frame of a `transforms.json`, as NeRF and its kin have them.

        The pictures are Blender's, whose middle is between the middle pixels. (The first NeRF's
        own program looked half a pixel beside it.)

        **Arguments:**

        - `transform_matrix`: 4x4, world from camera, which looks along -z with y up.
        - `height`, `width`: static; the picture's size in pixels.
        - `camera_angle_x`: the horizontal field of view, in radians; or else `fl_x`.
        - `fl_x`, `fl_y`: focal lengths in pixels, the second the first if it is left out.
        - `cx`, `cy`: the principal point in pixels, the middle if they are left out.

        **Returns:** the camera.

        **Raises:** `ValueError` for both or neither of `camera_angle_x` and `fl_x`, or one out
        of range.

        **Gradient:** exact.
        """
        size, focal = _size("from_nerf", height, width), (camera_angle_x, fl_x, fl_y)
        return cls(*_conventions.nerf(transform_matrix, focal, (cx, cy), size))

    @classmethod
    def from_opengl(
        cls, view: Any, projection: Any, *, height: WholeNumber, width: WholeNumber
    ) -> "PinholeCamera":
        """The camera of OpenGL's two matrices; its clip planes are not kept.

        **Arguments:**

        - `view`: 4x4, camera from world, looking along -z with y up; without the model's part.
        - `projection`: 4x4, of a perspective. Both multiply columns: OpenGL's memory, which
          holds one column after another, is to be transposed.
        - `height`, `width`: static; the viewport's size in pixels.

        **Returns:** the camera. Its row 0 is the picture's top, OpenGL's last.

        **Raises:** `ValueError` for a projection that is no perspective.

        **Gradient:** exact.
        """
        return cls(*_conventions.opengl(view, projection, _size("from_opengl", height, width)))

    def rays(self, *, height: WholeNumber, width: WholeNumber) -> Rays:
        """The ray through each pixel's centre.

        **Arguments:** `height`, `width`: static; the picture's size in pixels.

        **Returns:** origins, all at the eye, in scene units, and unit directions; height width
        3 each, in the world's axes, in the type of `intrinsics`.

        **Raises:** `ValueError` for a size that is no positive integer, or a batch of cameras.

        **Gradient:** exact.
        """
        check_fields("PinholeCamera.rays", self)
        dtype = self.intrinsics.dtype
        pixels = pixel_centers(*_size("rays", height, width), working_dtype(dtype))
        local = transformed(inverse(self.intrinsics), homogeneous(pixels))
        directions = normalize(transformed(self.world_from_camera[:3, :3], local)).astype(dtype)
        eye = self.world_from_camera[:3, 3].astype(dtype)
        return Rays(jnp.broadcast_to(eye, directions.shape), directions)

    def points(self, depth: DepthMap) -> Float[Array, "height width 3"]:
        """What every pixel of a depth image shows: the world point at its centre.

        **Arguments:** `depth`: height width, scene units along the optical axis.

        **Returns:** world positions, height width 3, in the type of `depth`, of integers in
        JAX's default float type. Where the depth is inf they are not finite.

        **Raises:** `ValueError` for a wrong shape, or a batch of cameras.

        **Gradient:** exact.
        """
        pixels, depth, dtype = read_map(depth)
        return self.unproject(pixels, depth).astype(dtype)

    def project(self, points: Points) -> Projection:
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
        points = read_points(self, "project", points, 3)
        dtype = points.dtype
        local = to_camera(self.world_from_camera, points.astype(working_dtype(dtype)))
        depth = local[..., 2]
        scaled = transformed(self.intrinsics, local)
        pixels = scaled[..., :2] / depth[..., None]
        return Projection(pixels.astype(dtype), depth.astype(dtype))

    def unproject(self, pixels: Pixels, depth: Depths) -> Float[Array, "... 3"]:
        """World points of pixels at a depth: the inverse of `project`.

        **Arguments:** `pixels`: `... 2`, (x, y); `depth`: `...`, scene units along the axis;
        floats or integers, one depth for several pixels or the other way round.

        **Returns:** world positions, `... 3`, in the wider type of the two, of integers in
        JAX's default float type. Infinite depth gives non-finite points.

        **Raises:** `ValueError` as `project`, and for a depth that does not fit the pixels.

        **Gradient:** exact.
        """
        pixels, depth, dtype = read_pixels(self, pixels, depth)
        rays = transformed(inverse(self.intrinsics), homogeneous(pixels))
        return to_world(self.world_from_camera, rays * depth[..., None]).astype(dtype)

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
