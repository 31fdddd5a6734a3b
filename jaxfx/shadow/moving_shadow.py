"""A soft shadow that follows its light: from one shadow map, for lights near the map's own."""

from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from jaxfx._arguments import check_camera, check_gbuffer, check_light
from jaxfx._arrays import ArrayLike
from jaxfx._checks import WholeNumber, check, check_map, parameter, whole_number
from jaxfx._loops import scan
from jaxfx._numerics import absolute, clip01, safe_divide
from jaxfx._sampling import pixel_centers
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.light import DirectionalLight, PointLight, SpotLight
from jaxfx.shadow.pcss import penumbra


_Camera = PinholeCamera | OrthographicCamera
_Moving = DirectionalLight | PointLight | SpotLight


@final
class MovingShadow(eqx.Module):
    """The soft shadow of a light near to the one that a shadow map was made for.

    Called with a light, it gives the visibility of each pixel, with a derivative in the light's
    direction, position and size: `fit.lights` finds a sun by it. The other shadows have none in
    where the light is.

    **Arguments:**

    - `shadow_map`: rows columns, depth from the light in scene units, inf where there is
      nothing; what is 0, negative or NaN is missing, and shadows nothing.
    - `light_camera`: the camera of the map: orthographic for a directional light, a pinhole at
      the light's position for others.
    - `gbuffer`, `camera`: the cache of the image to shadow; `normal` and `depth` are read.
    - `softness`: scene units above a surface over which an occluder begins to count.
    - `size`: static; odd, the kernel's width in texels. That of a light with a `light_size` is
      as wide as its penumbra, and cut to this.

    **Raises:** `ValueError` for a wrong shape, a softness that is not positive or an even size.

    **Gradient:** of the visibility: exact with respect to the light.

    **Example:** a plane with nothing above it.

    >>> import numpy as np
    >>> from jaxfx import DirectionalLight, GBuffer, OrthographicCamera, shadow
    >>> camera = OrthographicCamera(4.0, [4.0, 4.0], np.eye(4))
    >>> depth, normal = np.full((8, 8), 2.0), np.broadcast_to([0.0, 0, -1], (8, 8, 3))
    >>> white, shader = np.ones((8, 8, 3)), np.zeros((8, 8), int)
    >>> gbuffer = GBuffer(white, shader, white, white, white, normal, depth, depth / 4)
    >>> moving = shadow.MovingShadow(depth, camera, gbuffer, camera, softness=0.3, size=3)
    >>> float(moving(DirectionalLight([0.1, 0, 1], [1, 1, 1])).min())
    1.0

    Percentage-closer filtering compares receivers with texels. Here each texel is a point of an
    occluder in the world, which the light projects onto the surfaces of the image; when the
    light moves, its shadow moves by as much as the occluder is high. The part of a receiver's
    surroundings that is covered is the sum of a kernel over the texels, at their distances from
    the receiver as the light sees them; visibility is one minus its smoothstep. A texel covers
    as far as it lies above the receiver's tangent plane and nearer to the light, so that no
    plane shadows itself, however wide the kernel.

    A light with a `light_size` is taken for a square of that side, along the map's rows and
    columns. What a texel covers of it is the overlap of two squares: the texel, and the light
    as it is seen through the texel's plane, so that each occluder has its own penumbra. Covered
    is their sum, which counts twice where one occluder lies behind another. A round light's
    penumbra is about that of a square of 0.85 of its diameter.

    Surfaces that no ray of the map's light met are not in the map: the shadow holds for lights
    within about the width of the kernel. Farther away, render the map again.

    Source: our own; the filter is Reeves, Salesin & Cook 1987, the kernel a cubic B-spline;
    that texels are projected back onto an area light is Guennebaud, Barthe & Paulin 2006's.
    """

    occluders: Float[Array, "rows columns 3"]
    known: Bool[Array, "rows columns"]
    receivers: Float[Array, "height width 3"]
    normals: Float[Array, "height width 3"]
    shown: Bool[Array, "height width"]
    light_camera: _Camera
    softness: Float[Array, ""]
    size: int = eqx.field(static=True)

    def __init__(
        self,
        shadow_map: Num[ArrayLike, "rows columns"],
        light_camera: PinholeCamera | OrthographicCamera,
        gbuffer: GBuffer,
        camera: PinholeCamera | OrthographicCamera,
        *,
        softness: Any,
        size: WholeNumber = 9,
    ):
        shadow_map = check_map("MovingShadow(shadow_map)", shadow_map)
        check_camera("MovingShadow(light_camera)", light_camera)
        gbuffer = check_gbuffer("MovingShadow(gbuffer)", gbuffer)
        check_camera("MovingShadow(camera)", camera)
        is_odd = lambda n: n >= 3 and n % 2 == 1
        name = "MovingShadow(size=...)"
        size = whole_number(name, size, is_odd, "an odd number of texels from 3")
        softness = parameter("MovingShadow(softness=...)", softness)
        check("MovingShadow(softness=...)", softness, lambda v: v > 0, "positive")
        self.occluders, self.known = _points(light_camera, shadow_map.astype(float))
        self.receivers, self.shown = _points(camera, gbuffer.depth.astype(float))
        self.normals = jnp.where(self.shown[..., None], gbuffer.normal.astype(float), 0)
        self.light_camera, self.softness, self.size = light_camera, softness, size

    def __call__(self, light: _Moving) -> Float[Array, "height width"]:
        """The visibility of a light.

        **Arguments:** `light`: the map's light, moved a little.

        **Returns:** height width, in [0, 1]; 1 where nothing is shown.

        **Raises:** `ValueError` for a light of another kind than the map's.

        **Gradient:** exact with respect to the light's direction, of a directional light, or
        position, of the others, and to its size. The size has none where the penumbra is
        narrower than a texel or wider than the kernel may be.
        """
        is_parallel = isinstance(self.light_camera, OrthographicCamera)
        if not isinstance(light, DirectionalLight if is_parallel else PointLight | SpotLight):
            raise ValueError(
                "`MovingShadow(light)` must be directional for an orthographic shadow map and "
                f"a point or spot light for a pinhole's, got {type(light).__name__}."
            )
        check_light("MovingShadow(light)", light)
        return _visibility(self, light)


@eqx.filter_jit
def _visibility(shadow, light):
    """Visibility, height width: a scan over `size` x `size` texels about each receiver."""
    size, receivers = shadow.size, shadow.receivers
    place, depth = shadow.light_camera.project(receivers)
    first = jnp.floor(place).astype(jnp.int32) - size // 2
    projected = lambda points: _projected(shadow.light_camera, light, points)
    here, moved_depth = projected(receivers)

    def weight_at(point):
        """The share of the light, or of the kernel, that a texel's point stands for."""
        place, occluder_depth = projected(point)
        if light.light_size is None:
            # The spline is 4 wide and of sum 1. Stretched to `size` its sum grows by as much.
            return jnp.prod(_spline((place - here) / (size / 4)) / (size / 4), axis=-1)
        light_size = light.light_size.astype(depth.dtype)
        width = penumbra(shadow.light_camera, light_size, moved_depth, occluder_depth)
        # Of a light that is nearer to an occluder than the map's, texels lie farther apart.
        is_straight = isinstance(shadow.light_camera, OrthographicCamera)
        old_depth = shadow.light_camera.project(point)[1]
        texel = 1.0 if is_straight else safe_divide(old_depth, occluder_depth)[..., None]
        half_width = jnp.clip(width[..., None] / 2, texel / 2, size // 2)
        overlap = clip01((half_width - absolute(place - here)) / texel + 0.5) * texel
        return jnp.prod(overlap / (2 * half_width), axis=-1)

    def add(covered, tap):
        point, known = _read(shadow, first[..., 0] + tap % size, first[..., 1] + tap // size)
        above = jnp.sum((point - receivers) * shadow.normals, axis=-1)
        nearer = depth - shadow.light_camera.project(point)[1]
        height = jnp.where(known, jnp.minimum(above, nearer), 0)
        return covered + weight_at(point) * _smoothstep(height / shadow.softness), None

    taps = jnp.arange(size**2, dtype=jnp.int32)
    covered, _ = scan(add, jnp.zeros_like(depth), taps)
    dark = _smoothstep(covered) if light.light_size is None else clip01(covered)
    return jnp.where(shadow.shown, 1 - dark, 1)


def _read(
    shadow: MovingShadow, x: Int[Array, "height width"], y: Int[Array, "height width"]
) -> tuple[Float[Array, "height width 3"], Bool[Array, "height width"]]:
    """The occluders at texels, and whether there are any; beyond the map there are none."""
    rows, columns = shadow.known.shape
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    x, y = jnp.clip(x, 0, columns - 1), jnp.clip(y, 0, rows - 1)
    return shadow.occluders[y, x], shadow.known[y, x] & inside


def _points(
    camera: _Camera, depth: Float[Array, "rows columns"]
) -> tuple[Float[Array, "rows columns 3"], Bool[Array, "rows columns"]]:
    """The point that each pixel shows, and whether it shows one; a finite point if not."""
    known = (depth > 0) & jnp.isfinite(depth)
    pixels = pixel_centers(depth.shape[0], depth.shape[1], depth.dtype)
    return camera.unproject(pixels, jnp.where(known, depth, 1)), known


def _projected(
    camera: _Camera, light: _Moving, points: Float[Array, "height width 3"]
) -> tuple[Float[Array, "height width 2"], Float[Array, "height width"]]:
    """Pixels of the shadow map where a light that has moved would see points; their depth.

    A directional light projects them along its rays onto the plane of the map's camera.
    """
    pose = camera.world_from_camera
    if isinstance(light, DirectionalLight) and isinstance(camera, OrthographicCamera):
        x, y, ahead = light.direction.astype(points.dtype) @ pose[:3, :3].astype(points.dtype)
        sideways = camera.pixels_per_unit.astype(points.dtype) * jnp.stack([x, y]) / ahead
        pixels, depth = camera.project(points)
        return pixels - depth[..., None] * sideways[None, None], depth
    assert isinstance(camera, PinholeCamera) and not isinstance(light, DirectionalLight)
    moved = pose.at[:3, 3].set(light.position.astype(pose.dtype))
    return PinholeCamera(camera.intrinsics, moved).project(points)


def _spline(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The cubic B-spline: 4 wide, of sum 1 over the integers, twice differentiable."""
    outer, inner = (jnp.maximum(half_width - jnp.abs(x), 0) ** 3 for half_width in (2, 1))
    return (outer - 4 * inner) / 6


def _smoothstep(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """From 0 at 0 to 1 at 1, with derivatives of 0 at both."""
    x = clip01(x)
    return x * x * (3 - 2 * x)
