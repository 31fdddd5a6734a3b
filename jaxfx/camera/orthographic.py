"""The orthographic camera."""

from typing import Any, ClassVar, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._checks import WholeNumber, check, check_fields, parameter, whole_number
from jaxfx._numerics import normalize, one_program, working_dtype
from jaxfx._sampling import pixel_centers
from jaxfx.camera._records import Projection, Rays
from jaxfx.camera.rigid import (
    DepthMap,
    Depths,
    Pixels,
    Points,
    broadcast_like,
    read_map,
    read_pixels,
    read_points,
    rigid_pose,
    to_camera,
    to_world,
)


@final
class OrthographicCamera(eqx.Module):
    """A camera with parallel rays: the camera of a directional light's shadow map, say.

    `shadow.light_cameras` makes one for a light.

    **Arguments:**

    - `pixels_per_unit`: scale, in pixels per scene unit.
    - `center`: 2, the pixel (x, y) of the optical axis.
    - `world_from_camera`: 4x4 rigid pose.

    **Raises:** `ValueError` for a wrong shape, a number that is not finite, a scale that is not
    positive, or a pose that is not rigid.

    **Gradient:** exact with respect to every field.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import OrthographicCamera
    >>> camera = OrthographicCamera(4.0, (4.0, 3.0), jnp.eye(4))
    >>> print(camera.project((0.5, 0.0, 2.0)).pixels)
    [6. 3.]
    """

    SHAPES: ClassVar = {"pixels_per_unit": (), "center": (2,), "world_from_camera": (4, 4)}

    pixels_per_unit: Float[Array, ""]
    center: Float[Array, "2"]
    world_from_camera: Float[Array, "4 4"]

    def __init__(self, pixels_per_unit: Any, center: Any, world_from_camera: Any):
        name = "OrthographicCamera(pixels_per_unit)"
        self.pixels_per_unit = parameter(name, pixels_per_unit)
        check(name, self.pixels_per_unit, lambda v: (v > 0) & (v < np.inf), "positive")
        self.center = parameter("OrthographicCamera(center)", center, (2,))
        check("OrthographicCamera(center)", self.center, np.isfinite, "finite")
        self.world_from_camera = rigid_pose(
            "OrthographicCamera(world_from_camera)", world_from_camera
        )

    def rays(self, *, height: WholeNumber, width: WholeNumber) -> Rays:
        """The ray through each pixel's centre.

        **Arguments:** `height`, `width`: static; the image's size in pixels.

        **Returns:** `Rays(origins, directions)`: origins at depth 0, in scene units, and unit
        directions, all along the optical axis; height width 3 each, in world axes, in the type
        of `center`.

        **Raises:** `ValueError` for a size that is no positive integer, or a batch of cameras.

        **Gradient:** exact.

        **Example:**

        >>> import jax.numpy as jnp
        >>> from jaxfx import OrthographicCamera
        >>> camera = OrthographicCamera(4.0, (4.0, 3.0), jnp.eye(4))
        >>> print(camera.rays(height=6, width=8).directions[0, 0])
        [0. 0. 1.]
        """
        check_fields("OrthographicCamera.rays", self)
        size = (
            whole_number("rays(height=...)", height),
            whole_number("rays(width=...)", width),
        )
        dtype = self.center.dtype
        pixels = pixel_centers(*size, working_dtype(dtype))
        origins = self.unproject(pixels, jnp.zeros_like(pixels[..., 0]))
        axis = normalize(self.world_from_camera[:3, 2].astype(origins.dtype))
        directions = jnp.broadcast_to(axis, origins.shape)
        return Rays(origins.astype(dtype), directions.astype(dtype))

    def points(self, depth: DepthMap) -> Float[Array, "height width 3"]:
        """The world point that each pixel of a depth image shows, at the pixel's centre.

        **Arguments:** `depth`: height width, scene units along the optical axis.

        **Returns:** world positions, height width 3, in the type of `depth`, for integers in
        JAX's default float type. Where the depth is inf they are not finite.

        **Raises:** `ValueError` for a wrong shape, or a batch of cameras.

        **Gradient:** exact.

        **Example:**

        >>> import jax.numpy as jnp
        >>> from jaxfx import OrthographicCamera
        >>> camera = OrthographicCamera(4.0, (4.0, 3.0), jnp.eye(4))
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
        integers in JAX's default float type.

        **Raises:** `ValueError` for a wrong shape, what is no array of numbers, or a batch of
        cameras.

        **Gradient:** exact.

        **Example:**

        >>> import jax.numpy as jnp
        >>> from jaxfx import OrthographicCamera
        >>> camera = OrthographicCamera(4.0, (4.0, 3.0), jnp.eye(4))
        >>> pixels, depth = camera.project((0.5, 0.0, 2.0))
        >>> print(pixels, depth)
        [6. 3.] 2.0
        """
        return self._project(read_points(self, "project", points, 3))

    @one_program
    def _project(self, points: Float[Array, "... 3"]) -> Projection:
        dtype = points.dtype
        local = to_camera(self.world_from_camera, points.astype(working_dtype(dtype)))
        pixels = local[..., :2] * self.pixels_per_unit.astype(local.dtype)
        pixels = pixels + broadcast_like(self.center, pixels)
        return Projection(pixels.astype(dtype), local[..., 2].astype(dtype))

    def unproject(self, pixels: Pixels, depth: Depths) -> Float[Array, "... 3"]:
        """World points of pixels at given depths: the inverse of `project`.

        **Arguments:** `pixels`: `... 2`, (x, y); `depth`: `...`, scene units along the axis;
        floats or integers, which broadcast.

        **Returns:** world positions, `... 3`, in the wider type of the two, for integers in
        JAX's default float type.

        **Raises:** `ValueError` as `project`, and for a depth that does not fit the pixels.

        **Gradient:** exact.

        **Example:**

        >>> import jax.numpy as jnp
        >>> from jaxfx import OrthographicCamera
        >>> camera = OrthographicCamera(4.0, (4.0, 3.0), jnp.eye(4))
        >>> print(camera.unproject((6.0, 3.0), 2.0))
        [0.5 0.  2. ]
        """
        pixels, depth, dtype = read_pixels(self, pixels, depth)
        return self._unproject(pixels, depth).astype(dtype)

    @one_program
    def _unproject(
        self, pixels: Float[Array, "*shape 2"], depth: Float[Array, "*shape"]
    ) -> Float[Array, "*shape 3"]:
        plane = pixels - broadcast_like(self.center, pixels)
        plane = plane / self.pixels_per_unit.astype(pixels.dtype)
        local = jnp.concatenate([plane, depth[..., None]], axis=-1)
        return to_world(self.world_from_camera, local)
