"""Edits of one light among many.

The state keeps two sums over the lights, of diffuse and of specular light, before the
reflectances multiply them. An edit of a light takes out the term of the old one and adds that
of the new one; an edit of a reflectance shades no light at all.
"""

from collections.abc import Sequence
from typing import Any, Literal, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from jaxfx._arguments import (
    check_light,
    check_lights,
    check_visibilities,
    check_visibility,
)
from jaxfx._arrays import ArrayLike
from jaxfx._checks import as_array, parameter, share, whole_number
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import safe_divide
from jaxfx.camera import OrthographicCamera, PinholeCamera, Rays
from jaxfx.gbuffer import GBuffer
from jaxfx.light import AmbientLight, Light
from jaxfx.relight._sums import Sums, image_of, sums_of_none, with_lights
from jaxfx.relight.shading import (
    Surface,
    check_cache,
    exponent,
    ggx_kinds,
    lobe_of,
    to_surface,
)


_Image = Float[Array, "height width 3"]
_Visibility = Float[Array, "height width ..."]

_to_surface = jax.jit(to_surface, static_argnums=2)


@on_any_mesh
def start(
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera | Rays,
    lights: Sequence[Light],
    *,
    visibilities: Sequence[Any] | None = None,
) -> "RelightState":
    """Shade every light once, and keep what an edit of one of them needs.

    Its `image` is `render`'s; `edit`, `add`, `remove` and `paint` return a new state each.

    **Arguments:**

    - `gbuffer`, `camera`: as in `shade`.
    - `lights`: a sequence of lights of any kinds; without any, the image is black.
    - `visibilities`: one per light: as in `shade`, or None where it has no shadows. None alone
      stands for no shadows at all.

    **Returns:** the `RelightState`.

    **Raises:** `ValueError` as `render` does, and for `visibilities` that do not fit.

    **Gradient:** as `shade`'s. Memory does not grow with the number of lights.

    **Example:** a light is made twice as bright, then another added, then the wall darkened:

    >>> import jax.numpy as jnp
    >>> from jaxfx import DirectionalLight, GBuffer, OrthographicCamera, relight
    >>> white, shader = jnp.ones((8, 8, 3)), jnp.zeros((8, 8), int)
    >>> normal, depth = white * jnp.array([0, 0, -1]), jnp.full((8, 8), 3.0)
    >>> wall = GBuffer(white, shader, white, white / 2, white, normal, depth, depth / 6)
    >>> camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> state = relight.start(wall, camera, [DirectionalLight([0, 0, 1], [1, 1, 1])])
    >>> state = state.edit(0, DirectionalLight([0, 0, 1], [2, 2, 2]))
    >>> state = state.add(DirectionalLight([0, 0, 1], [4, 4, 4]))
    >>> print(state.image[4, 4], state.remove(0).image[4, 4])
    [3. 3. 3.] [2. 2. 2.]
    >>> print(state.paint(jnp.ones((8, 8), bool), diffuse=jnp.full(3, 0.25)).image[4, 4])
    [1.5 1.5 1.5]

    Source: Pellacini et al. 2005 (Lpics), who keep the sum of the lights that are not edited.
    The two sums and their compensation (Knuth 1969, 4.2.2, theorem B) are our own.
    """
    lights = check_lights("start(lights)", lights)
    gbuffer = check_cache("start", gbuffer, camera)
    name, shape = "start(visibilities=...)", gbuffer.depth.shape
    visibilities = check_visibilities(name, visibilities, lights, shape)
    surface = _to_surface(gbuffer, camera, ggx_kinds(gbuffer))
    empty = RelightState(
        color=gbuffer.color.astype(surface.position.dtype),
        surface=surface,
        lights=(),
        visibilities=(),
        sums=sums_of_none(surface),
        dtype=gbuffer.color.dtype,
    )
    return _with_all(empty, lights, visibilities)


@final
class RelightState(eqx.Module):
    """An image under many lights, any of which can be edited for the cost of one.

    Made by `start`. A pytree: it passes through `jit`, `vmap` and `scan`. Every method returns
    a new state. Static are the number and the kinds of the lights, and the index of an edit.

    - `color`: height width 3, the surface's base colour, linear RGB.
    - `surface`: the visible surface, height width; positions in scene units.
    - `lights`: the lights.
    - `visibilities`: one per light: height width in [0, 1], or height width coefficient of
      light from all around, or None.
    - `sums`: the lights' sums per pixel; private.
    - `dtype`: static; the type of `image`.
    """

    color: _Image
    surface: Surface
    lights: tuple[Light, ...]
    visibilities: tuple[_Visibility | None, ...]
    sums: Sums
    dtype: DTypeLike = eqx.field(static=True)

    @property
    def image(self) -> _Image:
        """The image: height width 3, linear RGB, in the type of the cache's `color`.

        It equals `render` of the same lights but for rounding. Where a light's term is not
        finite, the pixel is NaN until that light is edited or removed.
        """
        ambient = [
            (light, visibility)
            for light, visibility in zip(self.lights, self.visibilities, strict=True)
            if isinstance(light, AmbientLight)
        ]
        return image_of(self.surface, self.sums, ambient).astype(self.dtype)

    def edit(
        self,
        i: int,
        light: Light,
        visibility: Float[ArrayLike, "height width"]
        | Bool[ArrayLike, "height width"]
        | Float[ArrayLike, "height width coefficient"]
        | Literal["kept"]
        | None = "kept",
    ) -> "RelightState":
        """The state with another light in place of light `i`.

        It costs the shading of two lights, the old one and the new one, and the compensation
        of the sums. That pays from some ten lights on. With fewer, `render` is quicker. For
        many edits of one light, keep the state without it (`remove`) and `add` it each time:
        that costs the shading of one.

        **Arguments:**

        - `i`: static; the light's index, from 0.
        - `light`: the new light, of any kind.
        - `visibility`: of the new light, as in `shade`; None for no shadows. Left out, it is
          that of the old light: to turn an `EnvironmentLight` keeps its occlusion.

        **Returns:** the new `RelightState`.

        **Raises:** `ValueError` for an index out of range, no light or a wrong shape.

        **Gradient:** as `shade`'s with respect to `light` and `visibility`; exact with respect
        to the state: the old light's term is taken out of the derivatives too.
        """
        i = _index(self, "edit", i)
        if isinstance(visibility, str):
            if visibility != "kept":
                raise ValueError(
                    f'`edit(visibility)` must be an image, None or "kept", got {visibility!r}.'
                )
            visibility = self.visibilities[i]
        (light,), (visibility,) = _check(self, "edit", [light], [visibility])
        lights, visibilities = list(self.lights), list(self.visibilities)
        lights[i], visibilities[i] = light, visibility
        old_and_new = (self.lights[i], light), (self.visibilities[i], visibility)
        return _changed(self, old_and_new, (-1.0, 1.0), lights, visibilities)

    def add(
        self,
        light: Light,
        visibility: Float[ArrayLike, "height width"]
        | Bool[ArrayLike, "height width"]
        | Float[ArrayLike, "height width coefficient"]
        | None = None,
    ) -> "RelightState":
        """The state with one more light, at the end.

        **Arguments:**

        - `light`: of any kind.
        - `visibility`: as in `shade`; None for no shadows.

        **Returns:** the new `RelightState`.

        **Raises:** `ValueError` for no light or a wrong shape.

        **Gradient:** as `shade`'s with respect to `light` and `visibility`.
        """
        new = _check(self, "add", [light], [visibility])
        return _changed(
            self, new, (1.0,), [*self.lights, *new[0]], [*self.visibilities, *new[1]]
        )

    def remove(self, i: int) -> "RelightState":
        """The state without light `i`; those after it move up.

        **Arguments:** `i`: static; the light's index, from 0.

        **Returns:** the new `RelightState`.

        **Raises:** `ValueError` for an index out of range.

        **Gradient:** exact, with respect to the state.
        """
        i = _index(self, "remove", i)
        without = lambda values: [*values[:i], *values[i + 1 :]]
        old = (self.lights[i],), (self.visibilities[i],)
        return _changed(self, old, (-1.0,), without(self.lights), without(self.visibilities))

    def paint(
        self,
        mask: Bool[ArrayLike, "height width"],
        *,
        color: Float[ArrayLike, "3"] | None = None,
        diffuse: Float[ArrayLike, "3"] | None = None,
        specular: Float[ArrayLike, "3"] | None = None,
        roughness: Float[ArrayLike, ""] | float | None = None,
    ) -> "RelightState":
        """The state with another material in some pixels.

        A new `color`, `diffuse` or `specular` multiplies the sums over the lights: no light is
        shaded. A new `roughness` shades all of them again.

        **Arguments:**

        - `mask`: height width, true in the pixels that change.
        - `color`: 3, linear RGB. `ambient` and `diffuse` keep their ratio to it; where it was
          0, they become it.
        - `diffuse`, `specular`: 3, linear RGB. The specular reflectance of a Lambert surface
          has no effect.
        - `roughness`: a scalar, in [0, 1].

        **Returns:** the new `RelightState`.

        **Raises:** `ValueError` for a wrong shape.

        **Gradient:** exact with respect to every new value.
        """
        mask = as_array("paint(mask)", mask)
        if mask.shape != self.color.shape[:2]:
            raise ValueError(
                f"`paint(mask)` must have the cache's height and width "
                f"{self.color.shape[:2]}, got {mask.shape}."
            )
        if mask.dtype != jnp.bool_:
            raise ValueError(f"`paint(mask)` must hold booleans, got {mask.dtype}.")
        mask, state, surface = mask[..., None], self, self.surface
        if color is not None:
            new = jnp.where(mask, _vector(self, "color", color), self.color)
            ratio = safe_divide(new, self.color)
            tinted = lambda old: jnp.where(
                mask, jnp.where(self.color == 0, new, old * ratio), old
            )
            surface = surface._replace(
                ambient=tinted(surface.ambient), diffuse=tinted(surface.diffuse)
            )
            state = eqx.tree_at(lambda s: s.color, state, new)
        if diffuse is not None:
            surface = surface._replace(
                diffuse=jnp.where(mask, _vector(self, "diffuse", diffuse), surface.diffuse)
            )
        if specular is not None:
            is_shiny = mask & (surface.shader > 0)[..., None]
            surface = surface._replace(
                specular=jnp.where(
                    is_shiny, _vector(self, "specular", specular), surface.specular
                )
            )
        state = eqx.tree_at(lambda s: s.surface, state, surface)
        if roughness is None:
            return state
        value = share("paint(roughness=...)", roughness, ()).astype(self.color.dtype)
        exponents = jnp.where(mask[..., 0], exponent(value), surface.exponent)
        surface = surface._replace(exponent=exponents)
        if surface.facing is not None:
            surface = surface._replace(lobe=lobe_of(surface.facing, exponents))
        unlit = eqx.tree_at(
            lambda s: (s.surface, s.sums, s.lights, s.visibilities),
            state,
            (surface, sums_of_none(surface), (), ()),
        )
        return _with_all(unlit, self.lights, self.visibilities)


# Functions, not methods: to call a method of a pytree, Equinox visits every leaf.


def _vector(state: RelightState, name: str, value: Any) -> Float[Array, "1 1 3"]:
    """An argument of `paint` as a colour that broadcasts over pixels."""
    return parameter(f"paint({name}=...)", value, (3,)).astype(state.color.dtype)[None, None]


def _index(state: RelightState, method: str, i: Any) -> int:
    """The index of one of the state's lights; `ValueError` otherwise."""
    count = len(state.lights)
    index = whole_number(f"{method}(i)", i, lambda n: True, "a static integer")
    return whole_number(f"{method}(i)", index, lambda n: 0 <= n < count, f"in [0, {count})")


def _check(
    state: RelightState, method: str, lights: Sequence[Any], visibilities: Sequence[Any]
) -> tuple[tuple[Light, ...], tuple[_Visibility | None, ...]]:
    """Lights and visibilities in the type of the sums; `ValueError` names a wrong one."""
    dtype, shape = state.color.dtype, state.color.shape[:2]
    for light in lights:
        check_light(f"{method}(light)", light)
    cast = lambda leaf: leaf.astype(dtype)
    name = f"{method}(visibility)"
    images = (
        None if image is None else check_visibility(name, image, light, shape).astype(dtype)
        for image, light in zip(visibilities, lights, strict=True)
    )
    return tuple(jax.tree.map(cast, tuple(lights))), tuple(images)


def _with_all(
    state: RelightState, lights: Sequence[Light], visibilities: Sequence[Any]
) -> RelightState:
    """A state without lights, with all of these added."""
    terms = _check(state, "start", lights, visibilities)
    return _changed(state, terms, (1.0,) * len(lights), *terms)


def _changed(
    state: RelightState,
    terms: tuple[tuple[Light, ...], tuple[_Visibility | None, ...]],
    signs: tuple[float, ...],
    lights: Sequence[Light],
    visibilities: Sequence[_Visibility | None],
) -> RelightState:
    """The state after `terms`, lights and their visibilities, are added or taken out by sign.

    `lights` and `visibilities` are those of the new state.
    """
    signs_array = jnp.asarray(signs, state.color.dtype)
    return RelightState(
        color=state.color,
        surface=state.surface,
        lights=tuple(lights),
        visibilities=tuple(visibilities),
        sums=with_lights(state.surface, state.sums, *terms, signs_array),
        dtype=state.dtype,
    )
