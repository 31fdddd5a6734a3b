"""What a deep frame buffer looks like under given lights.

A light is known by two things at a pixel: the direction towards it and the irradiance that it
brings. A shader is known by one: the pair of unit vectors whose cosine its highlight is a power
of. Everything is elementwise over pixels.

Cosines near 1 are kept as `1 - cosine`, half the squared distance between unit vectors: sharp
highlights and narrow cones are not lost to cancellation, and no cosine exceeds 1.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from jaxfx._arguments import check_camera, check_gbuffer, check_light, check_lights
from jaxfx._checks import check, share, shares
from jaxfx._numerics import clip01, normalize, safe_divide, working_dtype
from jaxfx._platform import by_platform
from jaxfx._sampling import pixel_centers
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.light import AmbientLight, DirectionalLight, Light, PointLight, SpotLight


_Vectors = Float[Array, "height width 3"]
_Scalars = Float[Array, "height width"]
_NOTHING, _PHONG, _BLINN = -1, 1, 2
# A pixel's vector that is shorter (scene units, for the way to a light) is divided by this in
# place of its length, and so fades to zero: even float32's second derivatives stay finite.
_SHORTEST = 1e-5
# So many lights are shaded at once on an accelerator, each in the memory of some images.
_TOGETHER = 8
_SMOOTHEST = 1e-4  # A smaller roughness is this: a highlight far narrower than a pixel.


def shade(
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera,
    light: Light,
    visibility: Float[ArrayLike, "height width"]
    | Bool[ArrayLike, "height width"]
    | None = None,
) -> Float[Array, "height width 3"]:
    """The picture under one light.

    With N, L and V the unit vectors along the normal and towards light and camera, R the mirror
    image of L about N, H halfway between L and V, and n = 2 / roughness**2 - 2, a pixel is

    - `color * ambient` under ambient light;
    - `E * diffuse * max(N.L, 0)` under any other, to which, where N.L > 0, Phong adds
      `E * specular * max(R.V, 0)**n` and Blinn `E * specular * max(N.H, 0)**n`.

    E is the light's colour, over the squared distance for point and spot lights. A spot light's
    is also multiplied by `s * s * (3 - 2 * s)`, where s rises linearly in the cosine of the
    angle off its axis, from 0 at `outer_angle` to 1 at `inner_angle`.

    **Arguments:**

    - `gbuffer`, `camera`: the cache, height width, and the camera that it was made with.
    - `light`: any of the four.
    - `visibility`: height width, in [0, 1] or booleans; multiplies the result. All 1 if left
      out.

    **Returns:** height width 3, linear RGB, in the type of `gbuffer.color`. Exactly 0 where the
    shader is -1, the depth inf or missing (0, negative, NaN). A NaN elsewhere stays in its
    pixel. A roughness below 1e-4 counts as 1e-4, and a light nearer to the surface than 1e-5
    scene units fades out.

    **Raises:** `ValueError` for a wrong shape, an unknown light or shader, or a visibility
    outside [0, 1]. Traced values can't be looked at: any shader but 0, 1 and 2 is black, and a
    visibility multiplies as it is.

    **Gradient:** exact, forward and reverse, with respect to the light, the camera,
    `visibility` and every float image of the cache but `color`, which is not read. At N.L = 0,
    R.V = 0 and N.H = 0 it is the one from the dark side, 0. A highlight that N.L = 0 cuts off
    jumps there: that derivative is missing.

    Source: Pellacini et al. 2005 (Lpics); Kim, Lee & Kyung, deep-frame-buffer relighting;
    the models are those of Phong 1975 and Blinn 1977.
    """
    gbuffer = checked("shade", gbuffer, camera)
    check_light("shade(light)", light)
    if visibility is not None:
        visibility = share("shade(visibility)", visibility, gbuffer.depth.shape)
    return _shade(gbuffer, camera, light, visibility)


def render(
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera,
    lights: Sequence[Light],
    *,
    visibilities: Sequence[Any] | None = None,
) -> Float[Array, "height width 3"]:
    """The image under several lights and their shadows: the sum of `shade` over them.

    **Arguments:**

    - `gbuffer`, `camera`: as in `shade`.
    - `lights`: a sequence of lights of any kinds. None give a black image.
    - `visibilities`: for each light, height width in [0, 1], or None where it has no shadows.
      None alone stands for no shadows at all.

    **Returns:** height width 3, linear RGB, in the type of `gbuffer.color`.

    **Raises:** `ValueError` as `shade` does, and for `visibilities` that do not fit.

    **Gradient:** as `shade`'s. A reverse pass shades each light again, so that its memory does
    not grow with their number.

    Source: as `shade`'s.
    """
    lights = check_lights("render(lights)", lights)
    gbuffer = checked("render", gbuffer, camera)
    name, shape = "render(visibilities=...)", gbuffer.depth.shape
    visible = tuple(shares(name, visibilities, len(lights), shape))
    return _render(gbuffer, camera, lights, visible)


class Surface(NamedTuple):
    """What every light meets: the part of shading that no light changes."""

    shader: Int[Array, "height width"]
    position: _Vectors
    normal: _Vectors
    to_camera: _Vectors
    ambient: _Vectors
    diffuse: _Vectors
    specular: _Vectors
    exponent: _Scalars


def to_surface(gbuffer: GBuffer, camera: PinholeCamera | OrthographicCamera) -> Surface:
    """The surface in every pixel; where there is none, shader -1 and harmless numbers."""
    dtype = working_dtype(gbuffer.color.dtype)
    shader = gbuffer.shader.astype(jnp.int32)
    is_somewhere = (gbuffer.depth > 0) & (gbuffer.depth != jnp.inf)
    shown = (shader > _NOTHING) & (shader <= _BLINN) & is_somewhere
    shiny = shown & (shader >= _PHONG)

    def known(field: Array, otherwise: int, where: Array = shown) -> Array:
        where = where if field.ndim == 2 else where[..., None]
        return jnp.where(where, field.astype(dtype), otherwise)

    depth = known(gbuffer.depth, 1)
    pixels = pixel_centers(depth.shape[0], depth.shape[1], dtype)
    position = camera.unproject(pixels, depth)
    # Depth 0 is the eye, or the point of its plane that an orthographic ray comes from.
    to_camera = camera.unproject(pixels, jnp.zeros_like(depth)) - position
    return Surface(
        shader=jnp.where(shown, shader, _NOTHING),
        position=position,
        normal=_unit(known(gbuffer.normal, 0)),
        to_camera=_unit(to_camera),
        ambient=known(gbuffer.ambient, 0),
        diffuse=known(gbuffer.diffuse, 0),
        specular=known(gbuffer.specular, 0, shiny),
        exponent=exponent(known(gbuffer.roughness, 1, shiny)),
    )


def exponent(roughness: Float[Array, "..."]) -> Float[Array, "..."]:
    """The power that a highlight's cosine is raised to."""
    roughness = jnp.where(roughness > 1, 1, roughness)
    return 2 / jnp.maximum(roughness**2, _SMOOTHEST**2) - 2


def reflected(surface: Surface, light: Light) -> _Vectors:
    """What `surface` sends to the camera under one light."""
    if isinstance(light, AmbientLight):
        color = light.color.astype(surface.position.dtype)
        image = color[None, None] * surface.ambient
    else:
        diffuse, specular = received(surface, light)
        image = surface.diffuse * diffuse + surface.specular * specular
    return jnp.where((surface.shader == _NOTHING)[..., None], 0, image)


def received(
    surface: Surface, light: DirectionalLight | PointLight | SpotLight
) -> tuple[_Vectors, _Vectors]:
    """What one light brings for the diffuse and for the specular reflectance to multiply."""
    light = jax.tree.map(lambda leaf: leaf.astype(surface.position.dtype), light)
    to_light, irradiance = _arriving(light, surface.position)
    cosine = _dot(surface.normal, to_light)
    diffuse = irradiance * jnp.where(cosine <= 0, 0, cosine)[..., None]
    return diffuse, irradiance * _highlight(surface, to_light, cosine)[..., None]


def _arriving(
    light: DirectionalLight | PointLight | SpotLight, position: _Vectors
) -> tuple[_Vectors, Float[Array, "#height #width 3"]]:
    """The direction towards `light` and its irradiance on a surface that faces it."""
    color = light.color[None, None]
    if isinstance(light, DirectionalLight):
        return jnp.broadcast_to(-normalize(light.direction), position.shape), color
    offset = light.position[None, None] - position
    to_light, irradiance = _unit(offset), color / _squared_length(offset)
    if isinstance(light, SpotLight):
        irradiance = irradiance * _cone(light, to_light)[..., None]
    return to_light, irradiance


def _cone(light: SpotLight, to_light: _Vectors) -> _Scalars:
    inner = 2 * jnp.sin(light.inner_angle / 2) ** 2
    outer = 2 * jnp.sin(light.outer_angle / 2) ** 2
    angle = _one_minus_cosine(-normalize(light.direction)[None, None], to_light)
    # No light where the angles are out of order.
    step = clip01(safe_divide(outer - angle, jnp.maximum(outer - inner, 0)))
    return step * step * (3 - 2 * step)


def _highlight(surface: Surface, to_light: _Vectors, cosine: _Scalars) -> _Scalars:
    """Phong's max(R.V, 0)**n or else Blinn's max(N.H, 0)**n; 0 where N.L <= 0."""
    phong = (surface.shader == _PHONG)[..., None]
    mirrored = 2 * cosine[..., None] * surface.normal - to_light
    halfway = _unit(to_light + surface.to_camera)
    one = jnp.where(phong, mirrored, surface.normal)
    other = jnp.where(phong, surface.to_camera, halfway)
    miss = _one_minus_cosine(one, other)
    # The last two say the same but for rounding and for vectors of length 0.
    dark = (cosine <= 0) | (_dot(one, other) <= 0) | (miss >= 1)
    power = jnp.exp(surface.exponent * jnp.log1p(-jnp.where(dark, 0, miss)))
    return jnp.where(dark, 0, power)


def _dot(a: _Vectors, b: _Vectors) -> _Scalars:
    # Written out, for a reduction over three numbers would end every fusion here.
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _one_minus_cosine(a: Float[Array, "#height #width 3"], b: _Vectors) -> _Scalars:
    return _dot(a - b, a - b) / 2


def _squared_length(vector: _Vectors) -> Float[Array, "height width 1"]:
    return jnp.maximum(_dot(vector, vector), _SHORTEST**2)[..., None]


def _unit(vector: _Vectors) -> _Vectors:
    return vector / jnp.sqrt(_squared_length(vector))


def checked(function: str, gbuffer: Any, camera: Any) -> GBuffer:
    """The cache of a camera, built again to check its shapes: both may have been edited."""
    check_camera(f"{function}(camera)", camera)
    return check_shader(check_gbuffer(f"{function}(gbuffer)", gbuffer))


def check_shader(gbuffer: GBuffer) -> GBuffer:
    """The cache; `ValueError` where a shader is known and none of ours."""
    check("GBuffer(shader)", gbuffer.shader, lambda v: (v >= -1) & (v <= 2), "-1, 0, 1 or 2")
    return gbuffer


def stacked(
    visibilities: Sequence[_Scalars | None], surface: Surface
) -> Float[Array, "light height width"] | None:
    """Those of some lights, all 1 where one has no shadows; None where none has any."""
    if all(visible is None for visible in visibilities):
        return None
    dtype, lit = surface.position.dtype, jnp.ones_like(surface.exponent)
    return jnp.stack([lit if each is None else each.astype(dtype) for each in visibilities])


def seen(surface: Surface, image: _Vectors, visibility: _Scalars | None) -> _Vectors:
    """What a light brings, where it is visible; a hole's visibility is not read."""
    if visibility is None:
        return image
    visibility = jnp.where(surface.shader == _NOTHING, 0, visibility.astype(image.dtype))
    return visibility[..., None] * image


@jax.jit
def _shade(gbuffer, camera, light, visibility):
    surface = to_surface(gbuffer, camera)
    image = seen(surface, reflected(surface, light), visibility)
    return image.astype(gbuffer.color.dtype)


@jax.jit
def _render(gbuffer, camera, lights, visibilities):
    surface = to_surface(gbuffer, camera)
    image = jnp.zeros_like(surface.position)
    stack = lambda *leaves: jnp.stack([leaf.astype(image.dtype) for leaf in leaves])
    for kind in get_args(Light):
        which = [i for i, light in enumerate(lights) if isinstance(light, kind)]
        if which:
            group = jax.tree.map(stack, *(lights[i] for i in which))
            shadows = stacked([visibilities[i] for i in which], surface)
            terms = surface, image, (group, shadows)
            image = by_platform(*terms, cpu=_one_by_one, accelerator=_together)
    return image.astype(gbuffer.color.dtype)


_again = jax.checkpoint(reflected, prevent_cse=False)


def _one_by_one(surface: Surface, image: _Vectors, terms: Any) -> _Vectors:
    """The image with lights of a kind added, one after another."""

    def add(image, term):
        light, visibility = term
        return image + seen(surface, _again(surface, light), visibility), None

    return jax.lax.scan(add, image, terms)[0]


def _together(surface: Surface, image: _Vectors, terms: Any) -> _Vectors:
    """The same, some lights at a time: a launch is for all of them."""

    @partial(jax.checkpoint, prevent_cse=False)
    def add(image, some):
        bring = lambda term: seen(surface, reflected(surface, term[0]), term[1])
        return image + jnp.sum(jax.vmap(bring)(some), axis=0), None

    count = len(jax.tree.leaves(terms)[0])
    whole = count - count % _TOGETHER
    if whole:
        groups = lambda x: x[:whole].reshape(-1, _TOGETHER, *x.shape[1:])
        image, _ = jax.lax.scan(add, image, jax.tree.map(groups, terms))
    if whole < count:
        image, _ = add(image, jax.tree.map(lambda x: x[whole:], terms))
    return image
