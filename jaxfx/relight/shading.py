"""Shading a deep frame buffer under given lights.

At a pixel, a light is described by the direction towards it and its irradiance; a shader by the
two unit vectors whose cosine, raised to a power, is its highlight, or by the lobe of `_ggx`.
Everything is elementwise over pixels. `jaxfx.budget` uses `Surface`, `to_surface`, `reflected`,
`ggx_kinds` and `check_shader`.

Cosines near 1 are computed as `1 - cosine`, half the squared distance between unit vectors, so
that sharp highlights and narrow cones lose no digits and no cosine exceeds 1.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfx import _environment
from jaxfx._arguments import (
    alike,
    check_camera,
    check_gbuffer,
    check_light,
    check_lights,
    check_visibilities,
    check_visibility,
)
from jaxfx._arrays import ArrayLike
from jaxfx._checks import check, is_concrete, parameter
from jaxfx._harmonics import FACTORS, irradiance as harmonic_irradiance, turned
from jaxfx._loops import scan
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import clip01, normalize, safe_divide, working_dtype
from jaxfx._platform import by_platform
from jaxfx._sampling import pixel_centers
from jaxfx.camera import Camera, OrthographicCamera, PinholeCamera, Rays
from jaxfx.gbuffer import GBuffer
from jaxfx.light import (
    AmbientLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
    SphericalHarmonicsLight,
    SpotLight,
)
from jaxfx.relight._ggx import (
    MeanLobe,
    lobe_and_fresnel,
    mean_grazing,
    mean_lobe,
    roughness_squared,
)


_Vectors = Float[Array, "height width 3"]
_Scalars = Float[Array, "height width"]
_Part = Float[Array, "height width #3"]
# Diffuse, specular and grazing light. One channel stands for three that are the same.
Parts = tuple[_Part, _Part | None, _Part | None]
# Numbers of shaders in a G-buffer; 0, Lambert, has no highlight; 2 is Blinn.
_NOTHING, _PHONG, _GGX, _CONSERVING = -1, 1, 3, 4
# Length of a vector: scene units, of those to lights. A shorter vector is divided by this in
# place of its length, and so fades to zero. Smaller values let float32's second derivatives
# overflow next to a light.
_SHORTEST = 1e-5
# Lights shaded together on an accelerator. More means fewer launches, and the memory of some
# images for each.
_TOGETHER = 8
# Roughness. A smaller one counts as this, whose highlight is far narrower than a pixel; without
# it the exponent of a roughness of 0 is infinite.
_LEAST_ROUGHNESS = 1e-4


@on_any_mesh
def shade(
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera | Rays,
    light: Light,
    visibility: Float[ArrayLike, "height width"]
    | Bool[ArrayLike, "height width"]
    | Float[ArrayLike, "height width coefficient"]
    | None = None,
) -> Float[Array, "height width 3"]:
    """The image under one light.

    For a single light; `render` sums over several.

    **Arguments:**

    - `gbuffer`, `camera`: the cache, height width, and the camera that it was made with; or the
      rays, of a cache from `scene.gbuffer_along`.
    - `light`: of any kind.
    - `visibility`: height width, in [0, 1] or booleans: the share of the light that arrives,
      from a filter of `jaxfx.shadow` for instance. Left out, all of it arrives. Of a
      `SphericalHarmonicsLight` or `EnvironmentLight` also that of `scene.occlusion`, height
      width coefficient, which tells directions apart.

    **Returns:** height width 3, linear RGB, in the type of `gbuffer.color`. Exactly 0 where the
    shader is -1, the depth inf or missing (0, negative, NaN). A NaN elsewhere stays in its
    pixel. A roughness below 1e-4 counts as 1e-4, of GGX one below 0.01 as 0.01, and a light
    nearer to the surface than 1e-5 scene units fades out.

    **Raises:** `ValueError` for a wrong shape, an unknown light or shader, or a visibility
    outside [0, 1]. Traced values are not checked: any shader but 0 to 4 is black, and any
    visibility multiplies.

    **Gradient:** exact, forward and reverse, with respect to the light, the camera,
    `visibility` and every float image of the cache but `color`, which is not read. At N.L = 0,
    R.V = 0 and N.H = 0 it is the one from the dark side, 0. Phong's or Blinn's highlight that
    N.L = 0 cuts off jumps there: that derivative is missing.

    **Example:** a Lambert wall that faces camera and light:

    >>> import jax.numpy as jnp
    >>> from jaxfx import DirectionalLight, GBuffer, OrthographicCamera, relight
    >>> white, shader = jnp.ones((8, 8, 3)), jnp.zeros((8, 8), int)
    >>> normal, depth = white * jnp.array([0, 0, -1]), jnp.full((8, 8), 3.0)
    >>> wall = GBuffer(white, shader, white, white / 2, white, normal, depth, depth / 6)
    >>> camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> image = relight.shade(wall, camera, DirectionalLight([0, 0, 1], [1, 1, 1]))
    >>> print(image.shape, image[4, 4])
    (8, 8, 3) [0.5 0.5 0.5]

    With N, L and V the unit vectors along the normal and towards light and camera, R the mirror
    image of L about N, H halfway between L and V, and n = 2 / roughness**2 - 2, a pixel is

    - `color * ambient` under ambient light, `color` being the light's;
    - what `SphericalHarmonicsLight` and `EnvironmentLight` state under one;
    - `E * diffuse * max(N.L, 0)` under any other, to which, where N.L > 0, Phong adds
      `E * specular * max(R.V, 0)**n` and Blinn `E * specular * max(N.H, 0)**n`.

    GGX, glTF's metallic-roughness material, reflects `E * (1 - F) * diffuse * N.L` and a lobe
    times `E * F`, with F = specular + (1 - specular) * (1 - V.H)**5: `relight/_ggx.py` has the
    lobe. Its `diffuse` is `color * (1 - metallic)`, its `specular` the reflectance straight on:
    `GBuffer.metallic_roughness` makes both. What it reflects of a light from everywhere is at
    most that light for a metal. glTF's mix of the two parts gives a dielectric more where it is
    seen at a grazing angle: a white one 1.03 at 30 degrees, 1.5 at 6 degrees, if it is smooth.
    Shader 4 never does: it has the same lobe, and its diffuse part is `E * (1 - R) * diffuse *
    N.L`, where R is what the lobe returns, times F, of white light from everywhere.

    E is the light's colour, over the squared distance for point and spot lights. A spot light's
    is also multiplied by `s * s * (3 - 2 * s)`, where s rises linearly in the cosine of the
    angle off its axis, from 0 at `outer_angle` to 1 at `inner_angle`.

    Source: Pellacini et al. 2005 (Lpics); Kim, Lee & Kyung, deep-frame-buffer relighting;
    the models are those of Phong 1975, Blinn 1977 and glTF 2.0 (Khronos 2017), appendix B.3.
    That shader 4 gives the diffuse part what the highlight leaves is Kulla & Conty 2017's.
    """
    gbuffer = check_cache("shade", gbuffer, camera)
    check_light("shade(light)", light)
    if visibility is not None:
        shape = gbuffer.depth.shape
        visibility = check_visibility("shade(visibility)", visibility, light, shape)
    return _shade(gbuffer, camera, light, visibility, ggx_kinds(gbuffer))


@on_any_mesh
def render(
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera | Rays,
    lights: Sequence[Light],
    *,
    visibilities: Sequence[Any] | None = None,
) -> Float[Array, "height width 3"]:
    """The image under several lights and their shadows: the sum of `shade` over them.

    For one image. To edit lights one after another, keep a state (`start`).

    **Arguments:**

    - `gbuffer`, `camera`: as in `shade`.
    - `lights`: a sequence of lights of any kinds. None give a black image.
    - `visibilities`: one per light: as in `shade`, or None where it has no shadows. None alone
      stands for no shadows at all.

    **Returns:** height width 3, linear RGB, in the type of `gbuffer.color`.

    **Raises:** `ValueError` as `shade` does, and for `visibilities` that do not fit.

    **Gradient:** as `shade`'s. A reverse pass shades each light again, so that its memory does
    not grow with their number.

    **Example:** the second light is in shadow:

    >>> import jax.numpy as jnp
    >>> from jaxfx import DirectionalLight, GBuffer, OrthographicCamera, relight
    >>> white, shader = jnp.ones((8, 8, 3)), jnp.zeros((8, 8), int)
    >>> normal, depth = white * jnp.array([0, 0, -1]), jnp.full((8, 8), 3.0)
    >>> wall = GBuffer(white, shader, white, white / 2, white, normal, depth, depth / 6)
    >>> camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> lights = [DirectionalLight([0, 0, 1], [n, n, n]) for n in (1, 2)]
    >>> image = relight.render(wall, camera, lights, visibilities=[None, jnp.zeros((8, 8))])
    >>> print(image[4, 4])
    [0.5 0.5 0.5]

    Source: as `shade`'s.
    """
    lights = check_lights("render(lights)", lights)
    gbuffer = check_cache("render", gbuffer, camera)
    name, shape = "render(visibilities=...)", gbuffer.depth.shape
    visible = tuple(check_visibilities(name, visibilities, lights, shape))
    return _render(gbuffer, camera, lights, visible, ggx_kinds(gbuffer))


class Surface(NamedTuple):
    """The visible surface, per pixel: the part of shading that depends on no light.

    `normal` and `to_camera` are unit vectors in world space; the three reflectances are linear
    RGB; `exponent` is that of the highlight. `facing` is N.V and `lobe` the highlight of light
    from everywhere, which GGX reads, or None where no pixel can have that shader: a program
    then has nothing of them. Likewise `conserves`, which is true of GGX that conserves energy.
    """

    shader: Int[Array, "height width"]
    position: _Vectors
    normal: _Vectors
    to_camera: _Vectors
    ambient: _Vectors
    diffuse: _Vectors
    specular: _Vectors
    exponent: _Scalars
    facing: _Scalars | None
    lobe: MeanLobe | None
    conserves: Bool[Array, "height width"] | None


def ggx_kinds(gbuffer: GBuffer) -> int:
    """The GGX shaders of a cache: 0 none, 1 that of glTF, 2 the one that conserves energy too.

    A traced cache may hold all.
    """
    if not is_concrete(gbuffer.shader):
        return 2
    shader = np.asarray(gbuffer.shader)
    return 2 if (shader == _CONSERVING).any() else int((shader == _GGX).any())


def lobe_of(facing: _Scalars, exponents: _Scalars) -> MeanLobe:
    """The highlight of light from everywhere, by N.V."""
    return mean_lobe(facing, jnp.sqrt(roughness_squared(exponents)))


def to_surface(gbuffer: GBuffer, camera: Camera | Rays, kinds: int) -> Surface:
    """The surface of a cache; where there is none, shader -1 and finite stand-ins.

    `kinds` is static: `ggx_kinds` of the cache.
    """
    dtype = working_dtype(gbuffer.color.dtype)
    shader = gbuffer.shader.astype(jnp.int32)
    has_depth = (gbuffer.depth > 0) & (gbuffer.depth != jnp.inf)
    is_surface = (shader > _NOTHING) & (shader <= _CONSERVING) & has_depth
    is_shiny = is_surface & (shader >= _PHONG)

    def masked(field: Array, stand_in: int, mask: Array = is_surface) -> Array:
        mask = mask if field.ndim == 2 else mask[..., None]
        return jnp.where(mask, field.astype(dtype), stand_in)

    depth = masked(gbuffer.depth, 1)
    if isinstance(camera, Rays):
        origins, directions = (masked(field, 0) for field in camera)
        position, to_camera = origins + depth[..., None] * directions, -directions
    else:
        pixels = pixel_centers(depth.shape[0], depth.shape[1], dtype)
        position = camera.unproject(pixels, depth)
        # At depth 0 lies the eye, or the start of an orthographic ray.
        to_camera = camera.unproject(pixels, jnp.zeros_like(depth)) - position
    normal, to_camera = _unit(masked(gbuffer.normal, 0)), _unit(to_camera)
    facing = _dot(normal, to_camera) if kinds else None
    exponents = exponent(masked(gbuffer.roughness, 1, is_shiny))
    return Surface(
        shader=jnp.where(is_surface, shader, _NOTHING),
        position=position,
        normal=normal,
        to_camera=to_camera,
        ambient=masked(gbuffer.ambient, 0),
        diffuse=masked(gbuffer.diffuse, 0),
        specular=masked(gbuffer.specular, 0, is_shiny),
        exponent=exponents,
        facing=facing,
        lobe=None if facing is None else lobe_of(facing, exponents),
        conserves=is_surface & (shader == _CONSERVING) if kinds == 2 else None,
    )


def exponent(roughness: Float[Array, "..."]) -> Float[Array, "..."]:
    """The power to which a highlight's cosine is raised, from a roughness in [0, 1]."""
    roughness = jnp.where(roughness > 1, 1, roughness)
    return 2 / jnp.maximum(roughness**2, _LEAST_ROUGHNESS**2) - 2


def reflected(surface: Surface, light: Light) -> _Vectors:
    """The light that `surface` reflects to the camera under one light, without shadows."""
    if isinstance(light, AmbientLight):
        color = light.color.astype(surface.position.dtype)
        image = color[None, None] * surface.ambient
    else:
        image = with_reflectances(surface, *colored(light, received(surface, light)))
    return jnp.where((surface.shader == _NOTHING)[..., None], 0, image)


def with_reflectances(
    surface: Surface, diffuse: _Vectors, specular: _Vectors | None, grazing: _Vectors | None
) -> _Vectors:
    """The radiance that the surface reflects, from the three parts of the light it receives."""
    matte = surface.diffuse
    if surface.facing is not None:
        is_gltf = (surface.shader == _GGX)[..., None]
        kept = jnp.where(is_gltf, 1 - surface.specular, 1)
        if surface.conserves is not None and surface.lobe is not None:
            share, besides = surface.lobe.specular[..., None], surface.lobe.grazing[..., None]
            left = 1 - surface.specular * share - besides
            kept = jnp.where(surface.conserves[..., None], left, kept)
        matte = matte * kept
    image = matte * diffuse
    if specular is not None:
        image = image + surface.specular * specular
    return image if grazing is None else image + grazing


def received(
    surface: Surface,
    light: DirectionalLight
    | PointLight
    | SpotLight
    | SphericalHarmonicsLight
    | EnvironmentLight,
) -> Parts:
    """One light's diffuse, specular and grazing light, before color and reflectances.

    `colored` multiplies the light's color, `with_reflectances` those of the surface. The
    diffuse light is the irradiance, the specular one irradiance times highlight. Of GGX the two
    are less a share, which the grazing one has whatever the reflectance. None stands for no
    highlights, and for no pixel of GGX.
    """
    light = jax.tree.map(lambda leaf: leaf.astype(surface.position.dtype), light)
    if isinstance(light, SphericalHarmonicsLight):
        irradiance = harmonic_irradiance(surface.normal, light.coefficients)
        return _on_matt(surface, irradiance), None, None
    if isinstance(light, EnvironmentLight):
        return _from_surroundings(surface, light)
    to_light, irradiance = _direction_and_irradiance(light, surface.position)
    cosine = _dot(surface.normal, to_light)
    halfway = _unit(to_light + surface.to_camera)
    diffuse = irradiance * jnp.where(cosine <= 0, 0, cosine)
    highlight = _highlight(surface, to_light, halfway, cosine)
    if surface.facing is None:
        return diffuse[..., None], (irradiance * highlight)[..., None], None
    is_ggx = surface.shader >= _GGX
    is_dark = (cosine <= 0) | (_dot(surface.normal, halfway) <= 0)
    lobe, grazing = lobe_and_fresnel(
        is_ggx & ~is_dark,
        surface.exponent,
        cosine,
        surface.facing,
        _one_minus_cosine(surface.normal, halfway),
        _one_minus_cosine(surface.to_camera, halfway),
    )
    specular = irradiance * jnp.where(is_ggx, lobe, highlight)
    # Of GGX that conserves energy, `with_reflectances` takes the highlight's share instead.
    mixed = jnp.where(surface.shader == _CONSERVING, 0, grazing)
    diffuse = (1 - mixed) * diffuse
    specular, grazing = (1 - grazing) * specular, grazing * specular
    return diffuse[..., None], specular[..., None], grazing[..., None]


def colored(light: Light, parts: Parts) -> Parts:
    """The parts of `received` times the light's color; its coefficients are one already."""
    if isinstance(light, SphericalHarmonicsLight):
        return parts
    color = light.color[None, None]
    times_color = lambda part: None if part is None else color.astype(part.dtype) * part
    diffuse, specular, grazing = parts
    return color.astype(diffuse.dtype) * diffuse, times_color(specular), times_color(grazing)


def _on_matt(surface: Surface, irradiance: _Vectors) -> _Vectors:
    """The diffuse light, of an irradiance from all around; none where a normal is zero."""
    has_normal = _dot(surface.normal, surface.normal) != 0
    if surface.facing is not None:
        is_gltf = surface.shader == _GGX
        irradiance *= jnp.where(is_gltf, 1 - mean_grazing(surface.facing), 1)[..., None]
    return jnp.where(has_normal[..., None], irradiance, 0)


def _from_surroundings(surface: Surface, light: EnvironmentLight) -> Parts:
    """The three parts of the light of an image of all directions."""
    column = lambda k: jnp.broadcast_to(light.world_from_image[:, k], surface.normal.shape)
    turned = lambda way: jnp.stack([_dot(way, column(k)) for k in range(3)], axis=-1)
    blurs = light.pyramid, light.heights
    irradiance = _environment.irradiance(*blurs, turned(surface.normal))
    diffuse = _on_matt(surface, irradiance)
    if surface.facing is None or surface.lobe is None:
        return diffuse, None, None
    mirrored = 2 * surface.facing[..., None] * surface.normal - surface.to_camera
    lobe = surface.lobe
    toward = surface.normal + lobe.mirrored[..., None] * (mirrored - surface.normal)
    rest = _environment.look_up(*blurs, turned(toward), lobe.roughness)
    matt = lobe.matt[..., None]
    reflected = matt * irradiance + (1 - matt) * rest
    is_ggx = (surface.shader >= _GGX) & (_dot(surface.normal, surface.normal) != 0)
    specular, grazing = (
        reflected * jnp.where(is_ggx, mean, 0)[..., None]
        for mean in (lobe.specular, lobe.grazing)
    )
    return diffuse, specular, grazing


def _direction_and_irradiance(
    light: DirectionalLight | PointLight | SpotLight, position: _Vectors
) -> tuple[_Vectors, _Scalars]:
    """The unit vectors to `light`, and its irradiance on a surface that faces it, as a share of
    its color."""
    if isinstance(light, DirectionalLight):
        to_light = jnp.broadcast_to(-normalize(light.direction), position.shape)
        return to_light, jnp.ones_like(position[..., 0])
    offset = light.position[None, None] - position
    to_light, irradiance = _unit(offset), 1 / _squared_length(offset)[..., 0]
    if isinstance(light, SpotLight):
        irradiance = irradiance * _cone(light, to_light)
    return to_light, irradiance


def _cone(light: SpotLight, to_light: _Vectors) -> _Scalars:
    """The share of a spot light's intensity in the directions opposite to `to_light`."""
    inner = 2 * jnp.sin(light.inner_angle / 2) ** 2
    outer = 2 * jnp.sin(light.outer_angle / 2) ** 2
    angle = _one_minus_cosine(-normalize(light.direction)[None, None], to_light)
    # No light where the angles are out of order.
    step = clip01(safe_divide(outer - angle, jnp.maximum(outer - inner, 0)))
    return step * step * (3 - 2 * step)


def _highlight(
    surface: Surface, to_light: _Vectors, halfway: _Vectors, cosine: _Scalars
) -> _Scalars:
    """Phong's max(R.V, 0)**n or else Blinn's max(N.H, 0)**n; 0 where N.L <= 0."""
    is_phong = (surface.shader == _PHONG)[..., None]
    mirrored = 2 * cosine[..., None] * surface.normal - to_light
    a = jnp.where(is_phong, mirrored, surface.normal)
    b = jnp.where(is_phong, surface.to_camera, halfway)
    one_minus_cosine = _one_minus_cosine(a, b)
    # The last two differ by rounding, and for vectors of length 0.
    is_dark = (cosine <= 0) | (_dot(a, b) <= 0) | (one_minus_cosine >= 1)
    log_cosine = jnp.log1p(-jnp.where(is_dark, 0, one_minus_cosine))
    return jnp.where(is_dark, 0, jnp.exp(surface.exponent * log_cosine))


def _dot(a: _Vectors, b: _Vectors) -> _Scalars:
    # Written out, because XLA does not fuse across a reduction over three numbers.
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _one_minus_cosine(a: Float[Array, "#height #width 3"], b: _Vectors) -> _Scalars:
    """1 - a . b of unit vectors, without cancellation where they are close."""
    return _dot(a - b, a - b) / 2


def _squared_length(vector: _Vectors) -> Float[Array, "height width 1"]:
    return jnp.maximum(_dot(vector, vector), _SHORTEST**2)[..., None]


def _unit(vector: _Vectors) -> _Vectors:
    return vector / jnp.sqrt(_squared_length(vector))


def check_cache(function: str, gbuffer: Any, camera: Any) -> GBuffer:
    """The cache of a camera, or of rays; `ValueError` where one of the two is wrong.

    It is constructed again, which checks its shapes: it may have been edited as a pytree.
    """
    if not isinstance(camera, Rays):
        check_camera(f"{function}(camera)", camera)
    gbuffer = check_shader(check_gbuffer(f"{function}(gbuffer)", gbuffer))
    if isinstance(camera, Rays):
        for name, field in zip(Rays._fields, camera, strict=True):
            parameter(f"{function}(camera.{name})", field, (*gbuffer.depth.shape, 3))
    return gbuffer


def check_shader(gbuffer: GBuffer) -> GBuffer:
    """The cache; `ValueError` where a concrete shader is none of -1, 0, 1, 2, 3 and 4."""
    is_known = lambda v: (v >= _NOTHING) & (v <= _CONSERVING)
    check("GBuffer(shader)", gbuffer.shader, is_known, "-1, 0, 1, 2, 3 or 4")
    return gbuffer


def stack_visibilities(
    visibilities: Sequence[Float[Array, "height width ..."] | None], surface: Surface
) -> Float[Array, "light height width ..."] | None:
    """The lights' visibilities as one array, 1 for a light without; None if all are without."""
    if all(visible is None for visible in visibilities):
        return None
    dtype, all_lit = surface.position.dtype, jnp.ones_like(surface.exponent)
    return jnp.stack(
        [all_lit if image is None else image.astype(dtype) for image in visibilities]
    )


def shadowed(
    surface: Surface,
    image: Float[Array, "height width #3"],
    visibility: _Scalars | None,
) -> Float[Array, "height width #3"]:
    """A light's image times its visibility, which is not read where there is no surface."""
    if visibility is None:
        return image
    visibility = jnp.where(surface.shader == _NOTHING, 0, visibility.astype(image.dtype))
    return visibility[..., None] * image


def in_shadow(
    surface: Surface,
    light: Any,
    parts: Parts,
    visibility: Float[Array, "height width ..."] | None,
) -> Parts:
    """The parts of `received` in the light's shadow.

    Where the visibility has coefficients, the diffuse light is their sum with the light's, and
    highlights are as bright as that is under a white sky.
    """
    diffuse, *highlights = parts
    if visibility is not None and visibility.ndim == 3:
        visibility = visibility.astype(surface.position.dtype)
        diffuse = _on_matt(surface, _by_coefficient(light, visibility))
        visibility = visibility[..., 0] / float(FACTORS[0])
        diffuse = jnp.where((surface.shader == _NOTHING)[..., None], 0, diffuse)
    else:
        diffuse = shadowed(surface, diffuse, visibility)
    specular, grazing = (
        None if part is None else shadowed(surface, part, visibility) for part in highlights
    )
    return diffuse, specular, grazing


def _by_coefficient(
    light: SphericalHarmonicsLight | EnvironmentLight,
    visibility: Float[Array, "height width coefficient"],
) -> _Vectors:
    """Radiance of a white Lambert surface under light from all around, by `scene.occlusion`,
    before the light's color."""
    coefficients = light.coefficients.astype(visibility.dtype)
    if isinstance(light, EnvironmentLight):
        coefficients = turned(coefficients, light.world_from_image.astype(visibility.dtype))
    count = min(visibility.shape[-1], len(coefficients))
    product = jnp.matmul(
        visibility[..., :count].reshape(-1, count), coefficients[:count], precision="highest"
    )
    return product.reshape(*visibility.shape[:2], 3)


def lit(
    surface: Surface,
    light: Light,
    visibility: Float[Array, "height width ..."] | None,
) -> _Vectors:
    """The image under one light in its shadow."""
    if visibility is None or visibility.ndim == 2 or isinstance(light, AmbientLight):
        return shadowed(surface, reflected(surface, light), visibility)
    parts = in_shadow(surface, light, received(surface, light), visibility)
    image = with_reflectances(surface, *colored(light, parts))
    return jnp.where((surface.shader == _NOTHING)[..., None], 0, image)


@partial(jax.jit, static_argnames="kinds")
def _shade(gbuffer, camera, light, visibility, kinds):
    surface = to_surface(gbuffer, camera, kinds)
    return lit(surface, light, visibility).astype(gbuffer.color.dtype)


@partial(jax.jit, static_argnames="kinds")
def _render(gbuffer, camera, lights, visibilities, kinds):
    surface = to_surface(gbuffer, camera, kinds)
    image = jnp.zeros_like(surface.position)
    stack = lambda *leaves: jnp.stack([leaf.astype(image.dtype) for leaf in leaves])
    for which in alike(lights, visibilities):
        group = jax.tree.map(stack, *(lights[i] for i in which))
        shadows = stack_visibilities([visibilities[i] for i in which], surface)
        terms = surface, image, (group, shadows)
        image = by_platform(*terms, cpu=_one_by_one, accelerator=_together)
    return image.astype(gbuffer.color.dtype)


_lit_again = jax.checkpoint(lit, prevent_cse=False)


def _one_by_one(surface: Surface, image: _Vectors, terms: Any) -> _Vectors:
    """`image` with lights of one kind added, one after another.

    `terms` are the lights and their visibilities, as one pytree with a leading axis.
    """

    def add(image, term):
        light, visibility = term
        return image + _lit_again(surface, light, visibility), None

    return scan(add, image, terms)[0]


def _together(surface: Surface, image: _Vectors, terms: Any) -> _Vectors:
    """As `_one_by_one`, but `_TOGETHER` lights at a time, to save launches."""

    @partial(jax.checkpoint, prevent_cse=False)
    def add(image, group):
        one = lambda term: lit(surface, *term)
        return image + jnp.sum(jax.vmap(one)(group), axis=0), None

    count = len(jax.tree.leaves(terms)[0])
    in_groups = count - count % _TOGETHER
    if in_groups:
        groups = lambda x: x[:in_groups].reshape(-1, _TOGETHER, *x.shape[1:])
        image, _ = scan(add, image, jax.tree.map(groups, terms))
    if in_groups < count:
        image, _ = add(image, jax.tree.map(lambda x: x[in_groups:], terms))
    return image
