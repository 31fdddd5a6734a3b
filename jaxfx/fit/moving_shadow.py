"""Shadows that move with their light: what a shadow map says about lights beside its own."""

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, Num

from jaxfx._arguments import check_camera, check_gbuffer, check_light
from jaxfx._checks import WholeNumber, check, check_map, parameter, whole_number
from jaxfx._numerics import clip01
from jaxfx._sampling import pixel_centers
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.light import DirectionalLight, PointLight, SpotLight


_Camera = PinholeCamera | OrthographicCamera
_Moving = DirectionalLight | PointLight | SpotLight


@final
class MovingShadow(eqx.Module):
    """The soft shadow of a light near to the one that a shadow map was made for.

    Percentage-closer filtering compares receivers with texels. Here each texel is a point of an
    occluder in the world, which a light throws onto the picture's surfaces; when the light
    moves, its shadow moves by as much as the occluder is high. The share of a receiver's
    surroundings that is covered is the sum of a kernel over the texels, as the light sees them
    beside the receiver; visibility is one minus its smoothstep. A texel covers as far as it
    lies above the receiver's tangent plane and nearer to the light, so that no plane shadows
    itself, however wide the kernel.

    Texels that no ray of the map's own light met are not known: the shadow holds about as far
    from its light as the kernel is wide. Render the map again from there.

    **Arguments:**

    - `shadow_map`: rows columns, depth from the light in scene units, inf where there is
      nothing; what is 0, negative or NaN is missing, and shadows nothing.
    - `light_camera`: what it was made with: orthographic for a directional light, a pinhole at
      the light's position for others.
    - `gbuffer`, `camera`: the picture's; `normal` and `depth` are read.
    - `softness`: scene units above a surface over which an occluder begins to count.
    - `size`: static; odd, the kernel's width in texels.

    **Raises:** `ValueError` for a wrong shape, a softness that is not positive or an even size.

    **Gradient:** of what it gives: exact with respect to the light.

    Source: our own; the filter is Reeves, Salesin & Cook 1987, the kernel a cubic B-spline.
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
        """Visibility of a light.

        **Arguments:** `light`: the one of the map, moved a little.

        **Returns:** height width, in [0, 1]; 1 where nothing is shown.

        **Raises:** `ValueError` for a light of another kind than the map's.

        **Gradient:** exact with respect to the light's direction, of a directional light, or
        position, of the others.
        """
        straight = isinstance(self.light_camera, OrthographicCamera)
        if not isinstance(light, DirectionalLight if straight else PointLight | SpotLight):
            raise ValueError(
                "`MovingShadow(light)` must be directional for an orthographic shadow map and "
                f"a point or spot light for a pinhole's, got {type(light).__name__}."
            )
        check_light("MovingShadow(light)", light)
        return _visibility(self, light)


@eqx.filter_jit
def _visibility(shadow, light):
    size, receivers = shadow.size, shadow.receivers
    home, depth = shadow.light_camera.project(receivers)
    first = jnp.floor(home).astype(jnp.int32) - size // 2
    throw = lambda points: _thrown(shadow.light_camera, light, points)
    here = throw(receivers)

    def add(covered, tap):
        point, known = _read(shadow, first[..., 0] + tap % size, first[..., 1] + tap // size)
        above = jnp.sum((point - receivers) * shadow.normals, axis=-1)
        nearer = depth - shadow.light_camera.project(point)[1]
        height = jnp.where(known, jnp.minimum(above, nearer), 0)
        # The spline is 4 wide and of sum 1; stretched to `size`, of a sum larger by as much.
        weight = jnp.prod(_spline((throw(point) - here) / (size / 4)) / (size / 4), axis=-1)
        return covered + weight * _smoothstep(height / shadow.softness), None

    taps = jnp.arange(size**2, dtype=jnp.int32)
    covered, _ = jax.lax.scan(add, jnp.zeros_like(depth), taps)
    return jnp.where(shadow.shown, 1 - _smoothstep(covered), 1)


def _read(
    shadow: MovingShadow, x: Int[Array, "height width"], y: Int[Array, "height width"]
) -> tuple[Float[Array, "height width 3"], Bool[Array, "height width"]]:
    """The points of texels, and whether there are any; beyond the map there are none."""
    rows, columns = shadow.known.shape
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    x, y = jnp.clip(x, 0, columns - 1), jnp.clip(y, 0, rows - 1)
    return shadow.occluders[y, x], shadow.known[y, x] & inside


def _points(
    camera: _Camera, depth: Float[Array, "rows columns"]
) -> tuple[Float[Array, "rows columns 3"], Bool[Array, "rows columns"]]:
    """What each pixel shows, and whether it shows anything; a harmless point if not."""
    known = (depth > 0) & jnp.isfinite(depth)
    pixels = pixel_centers(depth.shape[0], depth.shape[1], depth.dtype)
    return camera.unproject(pixels, jnp.where(known, depth, 1)), known


def _thrown(
    camera: _Camera, light: _Moving, points: Float[Array, "height width 3"]
) -> Float[Array, "height width 2"]:
    """Where points are in the shadow map as seen by a light beside the map's own.

    A directional light throws them along its rays onto the map's plane.
    """
    pose = camera.world_from_camera
    if isinstance(light, DirectionalLight) and isinstance(camera, OrthographicCamera):
        x, y, ahead = light.direction.astype(points.dtype) @ pose[:3, :3].astype(points.dtype)
        sideways = camera.pixels_per_unit.astype(points.dtype) * jnp.stack([x, y]) / ahead
        pixels, depth = camera.project(points)
        return pixels - depth[..., None] * sideways[None, None]
    assert isinstance(camera, PinholeCamera) and not isinstance(light, DirectionalLight)
    moved = pose.at[:3, 3].set(light.position.astype(pose.dtype))
    return PinholeCamera(camera.intrinsics, moved).project(points)[0]


def _spline(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The cubic B-spline: 4 wide, of sum 1 over the integers, twice differentiable."""
    outer, inner = (jnp.maximum(each - jnp.abs(x), 0) ** 3 for each in (2, 1))
    return (outer - 4 * inner) / 6


def _smoothstep(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    x = clip01(x)
    return x * x * (3 - 2 * x)
