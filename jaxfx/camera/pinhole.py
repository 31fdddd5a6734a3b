"""The perspective camera, and the forms in which others write it."""

from typing import Any, ClassVar, Literal, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._checks import WholeNumber, check, check_fields, parameter, whole_number
from jaxfx._numerics import inverse, normalize, one_program, working_dtype
from jaxfx._sampling import pixel_centers
from jaxfx.camera import _conventions
from jaxfx.camera._records import Projection, Rays
from jaxfx.camera.rigid import (
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


# The identity: OpenCV's rotation if none is given.
_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _size(function: str, height: Any, width: Any) -> tuple[int, int]:
    """An image's height and width; `ValueError` names one that is no positive integer."""
    return (
        whole_number(f"{function}(height=...)", height),
        whole_number(f"{function}(width=...)", width),
    )


@final
class PinholeCamera(eqx.Module):
    """A perspective camera, given by its intrinsics and its pose.

    `from_fov` and `look_at` make one; others convert the cameras of other programs.

    **Arguments:**

    - `intrinsics`: 3x3, from camera axes to pixels: positive focal lengths, a skew, and the
      principal point, in pixels; the last row is 0 0 1.
    - `world_from_camera`: 4x4 rigid pose: an orthonormal rotation and a position.

    **Raises:** `ValueError` for a wrong shape, for intrinsics that are not finite or of another
    form, and for a pose with a scale, shear or reflection. Traced values are not checked: with
    such a pose `project` is not the inverse of `unproject`.

    **Gradient:** exact with respect to both fields. A step along it leaves the rigid motions:
    parametrize the pose, by a twist say, to stay on them.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import PinholeCamera
    >>> intrinsics = jnp.array([[10.0, 0, 4], [0, 10, 3], [0, 0, 1]])
    >>> camera = PinholeCamera(intrinsics, jnp.eye(4))
    >>> print(camera.project((0.0, 0.0, 2.0)).pixels)
    [4. 3.]
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
        """A camera with square pixels and the principal point in the middle of the image.

        **Arguments:**

        - `fov_y`: vertical field of view, in radians, between 0 and pi.
        - `height`, `width`: static; image size in pixels.
        - `world_from_camera`: the 4x4 pose; None for the identity.

        **Returns:** the camera.

        **Raises:** `ValueError` for a field of view out of range, a size that is no positive
        integer or a pose that is not rigid.

        **Gradient:** exact in `fov_y`.

        **Example:**

        >>> from jaxfx import PinholeCamera
        >>> print(PinholeCamera.from_fov(0.8, height=6, width=8).intrinsics[:2, 2])
        [4. 3.]
        """
        fov_y = parameter("from_fov(fov_y)", fov_y)
        check("from_fov(fov_y)", fov_y, lambda v: (v > 0) & (v < jnp.pi), "in (0, pi) radians")
        height, width = _size("from_fov", height, width)
        intrinsics = _conventions.matrix_of_fov(fov_y, height, width)
        if world_from_camera is None:
            world_from_camera = np.eye(4, dtype=intrinsics.dtype)
        return cls(intrinsics, world_from_camera)

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
        """A camera at the position `eye` that looks at the point `at`.

        **Arguments:**

        - `eye`, `at`: world positions, 3. `at` is shown in the middle of the image.
        - `up`: a world direction, 3, that points to the top of the image.
        - `fov_y`, `height`, `width`: as in `from_fov`.

        **Returns:** the camera.

        **Raises:** `ValueError` where `eye` is `at` or `up` lies along the view.

        **Gradient:** exact; zero where the pose is degenerate.

        **Example:**

        >>> from jaxfx import PinholeCamera
        >>> camera = PinholeCamera.look_at(
        ...     (0.0, 0, 4), (0.0, 0, 0), up=(0.0, 1, 0), fov_y=0.8, height=6, width=8
        ... )
        >>> print(camera.project((0.0, 0.0, 0.0)).depth)
        4.0
        """
        pose = look_at_pose(eye, at, up)
        height, width = _size("look_at", height, width)
        return cls.from_fov(fov_y, height=height, width=width, world_from_camera=pose)

    @classmethod
    def from_opencv(
        cls, intrinsics: Any, *, rotation: Any = _UPRIGHT, translation: Any = (0.0, 0.0, 0.0)
    ) -> "PinholeCamera":
        """A camera from OpenCV's camera matrix and pose.

        **Arguments:**

        - `intrinsics`: 3x3, the camera matrix of `calibrateCamera`, in pixels. Undistort
          images first.
        - `rotation`, `translation`: 3x3 and 3, camera from world, in scene units: `rotation @ X
          + translation` is X in camera axes. `cv2.Rodrigues` converts `rvec`.

        **Returns:** the camera. Its principal point is half a pixel larger along both axes,
        since OpenCV's pixel centres are whole numbers.

        **Raises:** `ValueError` as `PinholeCamera`.

        **Gradient:** exact.

        **Example:**

        >>> import jax.numpy as jnp
        >>> from jaxfx import PinholeCamera
        >>> matrix = jnp.array([[10.0, 0, 3.5], [0, 10, 2.5], [0, 0, 1]])
        >>> print(PinholeCamera.from_opencv(matrix).intrinsics[:2, 2])
        [4. 3.]
        """
        return cls(*_conventions.opencv(intrinsics, rotation, translation))

    @classmethod
    def from_colmap(cls, model: str, params: Any, *, qvec: Any, tvec: Any) -> "PinholeCamera":
        """A camera from a line of COLMAP's `cameras.txt` and one of its `images.txt`.

        **Arguments:**

        - `model`: "SIMPLE_PINHOLE" or "PINHOLE". Images with distortion must be undistorted
          first, by COLMAP's `image_undistorter`.
        - `params`: f, cx, cy or fx, fy, cx, cy, in pixels.
        - `qvec`, `tvec`: 4 and 3, camera from world: a quaternion (w, x, y, z) of any length,
          and a translation in scene units.

        **Returns:** the camera.

        **Raises:** `ValueError` for another model or a wrong number of parameters.

        **Gradient:** exact.

        **Example:**

        >>> from jaxfx import PinholeCamera
        >>> camera = PinholeCamera.from_colmap(
        ...     "SIMPLE_PINHOLE", (10.0, 4.0, 3.0), qvec=(1.0, 0, 0, 0), tvec=(0.0, 0, 2)
        ... )
        >>> print(camera.world_from_camera[:3, 3])
        [ 0.  0. -2.]
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
        """A camera from a Blender camera object; arguments have the names of its properties.

        **Arguments:**

        - `matrix_world`: 4x4, world from camera, which looks along -z with y up; a scale in it
          is ignored, as in Blender.
        - `lens`: focal length, in the unit of the sensor: millimetres.
        - `height`, `width`: static; the render's size in square pixels, after its percentage.
        - `sensor_width`, `sensor_height`: the sensor's size, in the unit of `lens`.
        - `sensor_fit`: which length the field of view fits: "AUTO" the sensor's width, along
          the image's longer side; "HORIZONTAL" the width, along rows; "VERTICAL" the height,
          along columns.
        - `shift_x`, `shift_y`: ratios to the side in pixels that the sensor fits.

        **Returns:** the camera.

        **Raises:** `ValueError` for a length that is not positive or an unknown fit.

        **Gradient:** exact in every float.

        **Example:**

        >>> import jax.numpy as jnp
        >>> from jaxfx import PinholeCamera
        >>> camera = PinholeCamera.from_blender(jnp.eye(4), lens=36.0, height=6, width=8)
        >>> print(camera.intrinsics[0, 0])
        8.0
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
        """A camera from a frame of a `transforms.json`, the format of NeRF and its successors.

        **Arguments:**

        - `transform_matrix`: 4x4, world from camera, which looks along -z with y up.
        - `height`, `width`: static; the image's size in pixels.
        - `camera_angle_x`: the horizontal field of view, in radians; give it or `fl_x`.
        - `fl_x`, `fl_y`: focal lengths in pixels; None for `fl_y` is `fl_x`.
        - `cx`, `cy`: the principal point in pixels; None is the middle of the image.

        **Returns:** the camera.

        **Raises:** `ValueError` for both or neither of `camera_angle_x` and `fl_x`, or one out
        of range.

        **Gradient:** exact.

        **Example:**

        >>> import jax.numpy as jnp
        >>> from jaxfx import PinholeCamera
        >>> camera = PinholeCamera.from_nerf(jnp.eye(4), height=6, width=8, fl_x=10.0)
        >>> print(camera.intrinsics[:2, 2])
        [4. 3.]

        The images are Blender's, whose middle lies between the middle pixels. (The code of the
        first NeRF is off by half a pixel.)
        """
        size, focal = _size("from_nerf", height, width), (camera_angle_x, fl_x, fl_y)
        return cls(*_conventions.nerf(transform_matrix, focal, (cx, cy), size))

    @classmethod
    def from_opengl(
        cls, view: Any, projection: Any, *, height: WholeNumber, width: WholeNumber
    ) -> "PinholeCamera":
        """A camera from OpenGL's view and projection matrices; clip planes are dropped.

        **Arguments:**

        - `view`: 4x4, camera from world, looking along -z with y up, without a model matrix.
        - `projection`: 4x4, a perspective. Both matrices multiply column vectors: transpose
          OpenGL's memory, which is column by column.
        - `height`, `width`: static; the viewport's size in pixels.

        **Returns:** the camera. Its row 0 is the top of the image, which is OpenGL's last row.

        **Raises:** `ValueError` for a projection that is no perspective.

        **Gradient:** exact.

        **Example:**

        >>> import jax.numpy as jnp
        >>> from jaxfx import PinholeCamera
        >>> rows = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, -2], [0, 0, -1, 0]]
        >>> projection = jnp.array(rows)
        >>> camera = PinholeCamera.from_opengl(jnp.eye(4), projection, height=6, width=8)
        >>> print(camera.intrinsics[:2, 2])
        [4. 3.]
        """
        return cls(*_conventions.opengl(view, projection, _size("from_opengl", height, width)))

    def rays(self, *, height: WholeNumber, width: WholeNumber) -> Rays:
        """The ray through each pixel's centre.

        **Arguments:** `height`, `width`: static; the image's size in pixels.

        **Returns:** `Rays(origins, directions)`: origins, all at the eye, in scene units, and
        unit directions; height width 3 each, in world axes, in the type of `intrinsics`.

        **Raises:** `ValueError` for a size that is no positive integer, or a batch of cameras.

        **Gradient:** exact.

        **Example:**

        >>> from jaxfx import PinholeCamera
        >>> rays = PinholeCamera.from_fov(0.8, height=6, width=8).rays(height=6, width=8)
        >>> rays.directions.shape
        (6, 8, 3)
        """
        check_fields("PinholeCamera.rays", self)
        dtype = self.intrinsics.dtype
        pixels = pixel_centers(*_size("rays", height, width), working_dtype(dtype))
        local = transformed(inverse(self.intrinsics), homogeneous(pixels))
        directions = normalize(transformed(self.world_from_camera[:3, :3], local)).astype(dtype)
        eye = self.world_from_camera[:3, 3].astype(dtype)
        return Rays(jnp.broadcast_to(eye, directions.shape), directions)

    def points(self, depth: DepthMap) -> Float[Array, "height width 3"]:
        """The world point that each pixel of a depth image shows, at the pixel's centre.

        **Arguments:** `depth`: height width, scene units along the optical axis.

        **Returns:** world positions, height width 3, in the type of `depth`, for integers in
        JAX's default float type. Where the depth is inf they are not finite.

        **Raises:** `ValueError` for a wrong shape, or a batch of cameras.

        **Gradient:** exact.

        **Example:**

        >>> import jax.numpy as jnp
        >>> from jaxfx import PinholeCamera
        >>> camera = PinholeCamera.from_fov(0.8, height=6, width=8)
        >>> camera.points(jnp.full((6, 8), 2.0)).shape
        (6, 8, 3)
        """
        pixels, depth, dtype = read_map(depth)
        return self.unproject(pixels, depth).astype(dtype)

    def project(self, points: Points) -> Projection:
        """The pixels and depths of world points.

        **Arguments:** `points`: world positions, `... 3`, in scene units, floats or integers.

        **Returns:** `Projection(pixels, depth)`: `pixels`, `... 2`, are (x, y) with centres at
        +0.5; `depth`, `...`, is along the optical axis; both in the type of `points`, for
        integers in JAX's default float type. A point behind the camera has a negative depth;
        its pixel is that of the line through the point and the eye.

        **Raises:** `ValueError` for a wrong shape, what is no array of numbers, or a batch of
        cameras.

        **Gradient:** exact; infinite where the depth is 0.

        **Example:**

        >>> from jaxfx import PinholeCamera
        >>> camera = PinholeCamera.from_fov(0.8, height=6, width=8)
        >>> pixels, depth = camera.project((0.0, 0.0, 2.0))
        >>> print(pixels, depth)
        [4. 3.] 2.0
        """
        return self._project(read_points(self, "project", points, 3))

    @one_program
    def _project(self, points: Float[Array, "... 3"]) -> Projection:
        dtype = points.dtype
        local = to_camera(self.world_from_camera, points.astype(working_dtype(dtype)))
        depth = local[..., 2]
        scaled = transformed(self.intrinsics, local)
        pixels = scaled[..., :2] / depth[..., None]
        return Projection(pixels.astype(dtype), depth.astype(dtype))

    def unproject(self, pixels: Pixels, depth: Depths) -> Float[Array, "... 3"]:
        """World points of pixels at given depths: the inverse of `project`.

        **Arguments:** `pixels`: `... 2`, (x, y); `depth`: `...`, scene units along the axis;
        floats or integers, which broadcast.

        **Returns:** world positions, `... 3`, in the wider type of the two, for integers in
        JAX's default float type. Infinite depth gives non-finite points.

        **Raises:** `ValueError` as `project`, and for a depth that does not fit the pixels.

        **Gradient:** exact.

        **Example:**

        >>> import jax.numpy as jnp
        >>> from jaxfx import PinholeCamera
        >>> camera = PinholeCamera.from_fov(0.8, height=6, width=8)
        >>> camera.unproject(jnp.ones((5, 2)), 2.0).shape
        (5, 3)
        """
        pixels, depth, dtype = read_pixels(self, pixels, depth)
        return self._unproject(pixels, depth).astype(dtype)

    @one_program
    def _unproject(
        self, pixels: Float[Array, "*shape 2"], depth: Float[Array, "*shape"]
    ) -> Float[Array, "*shape 3"]:
        rays = transformed(inverse(self.intrinsics), homogeneous(pixels))
        return to_world(self.world_from_camera, rays * depth[..., None])

    def through_lens(self, offset: Any, *, focus_distance: Any) -> "PinholeCamera":
        """The camera at another point of the lens, with the same plane in focus.

        The mean of images through many points of a lens is the image through the lens:
        `dof.accumulate` does that.

        **Arguments:**

        - `offset`: 2, from the lens' centre along the camera's x and y, in scene units.
        - `focus_distance`: depth of the plane in focus, in scene units.

        **Returns:** the camera: the eye is moved, and the principal point shifted so that
        points at depth `focus_distance` keep their pixels.

        **Raises:** `ValueError` for a focus distance that is not positive.

        **Gradient:** exact.

        **Example:**

        >>> from jaxfx import PinholeCamera
        >>> camera = PinholeCamera.from_fov(0.8, height=6, width=8)
        >>> aside = camera.through_lens((0.1, 0.0), focus_distance=2.0)
        >>> print(aside.project((0.0, 0.0, 2.0)).pixels.round(4))
        [4. 3.]

        A point at depth Z moves by `offset * focal * (1 / focus_distance - 1 / Z)` pixels.

        Source: Haeberli & Akeley 1990, the accumulation buffer's depth of field.
        """
        dtype = self.intrinsics.dtype
        offset = parameter("through_lens(offset)", offset, (2,)).astype(dtype)
        distance = parameter("through_lens(focus_distance=...)", focus_distance).astype(dtype)
        check("through_lens(focus_distance=...)", distance, lambda v: v > 0, "positive")
        return PinholeCamera(
            *_moved_aside(self.intrinsics, self.world_from_camera, offset, distance)
        )


@one_program
def _moved_aside(
    intrinsics: Float[Array, "3 3"],
    pose: Float[Array, "4 4"],
    offset: Float[Array, "2"],
    focus_distance: Float[Array, ""],
) -> tuple[Float[Array, "3 3"], Float[Array, "4 4"]]:
    """The fields of a camera moved along its x and y; what is in focus keeps its pixels."""
    shear = intrinsics[:2, :2] @ offset / focus_distance
    aside = pose[:3, :2] @ offset.astype(pose.dtype)
    return intrinsics.at[:2, 2].add(shear), pose.at[:3, 3].add(aside)
