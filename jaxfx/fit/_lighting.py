"""The picture as a function of its lights: what `fit.lights` searches."""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._checks import share
from jaxfx._numerics import normalize
from jaxfx._sampling import pixel_centers
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.light import Light, SpotLight
from jaxfx.relight import shade


# In units of the colours' own columns: what keeps the search finite where two are the same.
_RIDGE = 1e-3
# The ratios of a cone's angles that a search starts from are this far from 0 and 1.
_MARGIN = 1e-3

Values = dict[str, Float[Array, "_"]]
_Camera = PinholeCamera | OrthographicCamera


def free(light: Light, names: tuple[str, ...]) -> list[str]:
    """Those of the parameters that a light has."""
    has = lambda name: hasattr(light, "inner_angle" if name == "angles" else name)
    return [name for name in names if has(name)]


class Model(eqx.Module):
    """The picture as a function of the lights, of which some parameters are free."""

    gbuffer: GBuffer
    camera: _Camera
    visibilities: tuple[Any, ...]  # an entry each: None, an array, or a function
    names: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, lights: Sequence[Light]) -> Float[Array, "height width 3"]:
        return functools.reduce(jnp.add, self.terms(lights))

    def terms(self, lights: Sequence[Light]) -> list[Float[Array, "height width 3"]]:
        """What each light adds to the picture."""
        name, shape = "lights(visibilities=...)", self.gbuffer.depth.shape
        seen: list[Any] = [
            share(name, entry(light), shape) if callable(entry) else entry
            for light, entry in zip(lights, self.visibilities, strict=True)
        ]
        draw = functools.partial(shade, self.gbuffer, self.camera)
        return [draw(light, visible) for light, visible in zip(lights, seen, strict=True)]

    def basis(self, lights: Sequence[Light]) -> Float[Array, "light height width 3"]:
        """What each would add if it were white."""
        return jnp.stack(
            self.terms([with_values(light, {"color": jnp.ones(3)}) for light in lights])
        )

    def values(self, light: Light) -> Values:
        """A light's free parameters, of which the direction is a step from its own."""
        values = {"direction": jnp.zeros(2)} | {
            name: getattr(light, name) for name in ("color", "position") if hasattr(light, name)
        }
        if isinstance(light, SpotLight):
            values["angles"] = jnp.stack([light.inner_angle, light.outer_angle])
        return {name: values[name] for name in free(light, self.names)}


def with_values(light: Any, values: Values) -> Any:
    """A light with some of its parameters replaced, the direction turned."""
    given = {name: getattr(light, name) for name in vars(light)} | values
    if "direction" in values:
        given["direction"] = _turned(light.direction, values["direction"])
    if "angles" in values:
        given["inner_angle"], given["outer_angle"] = given.pop("angles")
    return type(light)(**given)


def _turned(direction: Float[Array, "3"], step: Float[Array, "2"]) -> Float[Array, "3"]:
    """The direction a tangent step away, in radians for small ones: stereographic."""
    ahead = normalize(direction)
    across = normalize(jnp.cross(ahead, jnp.eye(3)[jnp.argmin(jnp.abs(ahead))]))
    quarter = step @ step / 4
    sideways = step[0] * across + step[1] * jnp.cross(ahead, across)
    return ((1 - quarter) * ahead + sideways) / (1 + quarter)


class Search(eqx.Module):
    """What the solver's unknowns stand for: steps from the lights of the start."""

    model: Model
    start: tuple[Any, ...]
    scale: Float[Array, ""]

    def unknowns(self) -> list[Values]:
        """Those of the start."""
        unknowns = []
        for light in self.start:
            values = self.model.values(light)
            values.pop("color", None)
            unknowns.append({name: jnp.zeros_like(value) for name, value in values.items()})
            if "angles" in values:
                inner, outer = values["angles"]
                ratios = jnp.stack([inner / outer, outer / jnp.pi])
                held = jnp.clip(ratios, _MARGIN, 1 - _MARGIN)
                unknowns[-1]["angles"] = jnp.log(held) - jnp.log1p(-held)
        return unknowns

    def lights(self, unknowns: list[Values]) -> list[Light]:
        """The lights of the start, moved; their colours as they were."""
        moved = []
        for light, steps in zip(self.start, unknowns, strict=True):
            values = dict(steps)
            if "position" in steps:
                values["position"] = light.position + self.scale * steps["position"]
            if "angles" in steps:
                ratio, outer = jax.nn.sigmoid(steps["angles"]) * jnp.array([1, jnp.pi])
                values["angles"] = jnp.stack([ratio * outer, outer])
            moved.append(with_values(light, values))
        return moved


class Residual(eqx.Module):
    """The picture less the reference, over the reference's root mean square, as it counts.

    - `root`: height width 1, the root of each pixel's weight.
    """

    search: Search
    reference: Float[Array, "height width 3"]
    unit: Float[Array, ""]
    root: Float[Array, "height width 1"]

    def __call__(self, unknowns: list[Values]) -> Float[Array, "height width 3"]:
        model, lights = self.search.model, self.search.lights(unknowns)
        if "color" in model.names:
            basis = model.basis(lights)
            colors = _ridge_colors(self.root[None] * basis, self.root * self.reference)
            image = jnp.einsum("lc,lhwc->hwc", colors, basis)
        else:
            image = model(lights)
        return (self.root * (image - self.reference) / self.unit).astype(float)


def _ridge_colors(
    basis: Float[Array, "light height width 3"], reference: Float[Array, "height width 3"]
) -> Float[Array, "light 3"]:
    """Colours close to the best ones, by the normal equations: differentiable everywhere."""
    gram = jnp.einsum("ihwc,jhwc->cij", basis, basis)
    right = jnp.einsum("ihwc,hwc->ci", basis, reference)
    squares = jnp.diagonal(gram, axis1=1, axis2=2)
    lengths = jnp.where(squares > 0, jnp.sqrt(jnp.where(squares > 0, squares, 1)), 1)
    ridge = _RIDGE * jnp.sqrt(jnp.finfo(gram.dtype).eps) * jnp.eye(len(basis), dtype=gram.dtype)
    scaled = gram / lengths[:, :, None] / lengths[:, None, :] + ridge[None]
    solved = jnp.linalg.solve(scaled, (right / lengths)[..., None])[..., 0]
    return (solved / lengths).T


def best_colors(
    basis: Float[Array, "light height width 3"],
    reference: Float[Array, "height width 3"],
    root: Float[Array, "height width 1"],
) -> Float[np.ndarray, "3 light"]:
    """The best colours, the smallest of them where several are as good."""
    white, aim, weight = (np.asarray(each, np.float64) for each in (basis, reference, root))
    columns, right = weight * white, weight * aim
    solve = lambda a, b: np.linalg.lstsq(a.reshape(len(a), -1).T, b.ravel(), rcond=1e-6)[0]
    return np.stack([solve(columns[..., c], right[..., c]) for c in range(3)])


def spread(gbuffer: GBuffer, camera: _Camera) -> Float[Array, ""]:
    """How far the visible points are from their mean, root mean square; 1 for a single one."""
    points, shown = _points(gbuffer, camera)
    points = points[shown]
    spread = np.sqrt(np.var(points, axis=0).sum()) if len(points) else 0.0
    return jnp.asarray(spread if spread > 0 else 1.0, float)


def middle_of(
    gbuffer: GBuffer, camera: _Camera, weight: Float[Array, "height width"]
) -> Float[np.ndarray, "3"]:
    """The mean of the visible points by weight; of all where that is nowhere."""
    points, shown = _points(gbuffer, camera)
    counts = np.where(shown, np.asarray(weight, np.float64), 0)
    counts = counts if counts.sum() > 0 else np.ones(shown.shape)
    return np.einsum("hw,hwc->c", counts, points) / counts.sum()


def _points(gbuffer: GBuffer, camera: _Camera) -> tuple[np.ndarray, np.ndarray]:
    """The point that each pixel shows, in world space, and where it shows one."""
    shown = (gbuffer.depth > 0) & jnp.isfinite(gbuffer.depth)
    height, width = shown.shape
    pixels = pixel_centers(height, width, gbuffer.depth.dtype)
    points = camera.unproject(pixels, jnp.where(shown, gbuffer.depth, 1))
    return np.asarray(points, np.float64), np.asarray(shown)
