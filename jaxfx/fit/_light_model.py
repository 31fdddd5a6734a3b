"""An image as a function of its lights, and the residual of `fit.lights`.

`Model` draws the image of given lights. `Search` turns a solver's unknowns into lights.
`Residual` solves for the colors, in which the image is linear; the rest is the solver's.
"""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._checks import is_concrete, share
from jaxfx._numerics import normalize
from jaxfx._sampling import pixel_centers
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.gbuffer import GBuffer
from jaxfx.light import EnvironmentLight, Light, SphericalHarmonicsLight, SpotLight
from jaxfx.relight import shade


# Ridge of the normal equations of colors, in roots of the type's rounding, with columns of
# length 1: it keeps a search finite where two lights are the same. A larger one moves colors, a
# smaller one leaves them to rounding.
_RIDGE = 1e-3
# The least distance from 0 and 1 of the ratios of a cone's angles where a search starts: at 0
# and 1 the logistic functions that keep them in order have no derivative.
_MARGIN = 1e-3

Values = dict[str, Float[Array, "_"]]
_Camera = PinholeCamera | OrthographicCamera


def free(light: Light, names: tuple[str, ...]) -> list[str]:
    """Those of the parameters that a light has."""
    fields = {"angles": ("inner_angle",), "color": ("color", "coefficients")}
    has = lambda field: getattr(light, field, None) is not None
    return [name for name in names if any(map(has, fields.get(name, (name,))))]


def color_shape(light: Light) -> tuple[int, int]:
    """How many colors a light has, of which the image is a sum; and 3."""
    return (9 if isinstance(light, SphericalHarmonicsLight) else 1), 3


class Model(eqx.Module):
    """An image as a function of its lights, of which some parameters are free.

    - `visibilities`: for each light None, an image, or a function of the light.
    - `names`: the parameters that are free.
    """

    gbuffer: GBuffer
    camera: _Camera
    visibilities: tuple[Any, ...]
    names: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, lights: Sequence[Light]) -> Float[Array, "height width 3"]:
        return functools.reduce(jnp.add, self.terms(lights))

    def terms(self, lights: Sequence[Light]) -> list[Float[Array, "height width 3"]]:
        """The image of each light alone."""
        pairs = zip(lights, self.visibilities, strict=True)
        return [self._term(light, light, entry) for light, entry in pairs]

    def _term(self, light: Light, place: Light, entry: Any) -> Float[Array, "height width 3"]:
        """The image of a light with the shadow of one where `place` is."""
        name, shape = "lights(visibilities=...)", self.gbuffer.depth.shape
        visible = share(name, entry(place), shape) if callable(entry) else entry
        return shade(self.gbuffer, self.camera, light, visible)

    def basis(self, lights: Sequence[Light]) -> Float[Array, "color height width 3"]:
        """The image of each color of each light alone, if it were white."""
        images = []
        for light, entry in zip(lights, self.visibilities, strict=True):
            count, _ = color_shape(light)
            for one in jnp.eye(count):
                white = with_values(light, {"color": jnp.repeat(one, 3)})
                images.append(self._term(white, light, entry))
        return jnp.stack(images)

    def values(self, light: Light) -> Values:
        """The free parameters of a light; its direction as a step, 0 0, from where it is."""
        values = {"direction": jnp.zeros(2)} | {
            name: getattr(light, name) for name in ("color", "position") if hasattr(light, name)
        }
        if isinstance(light, SphericalHarmonicsLight):
            values["color"] = light.coefficients.reshape(-1)
        if isinstance(light, SpotLight):
            values["angles"] = jnp.stack([light.inner_angle, light.outer_angle])
        if (light_size := getattr(light, "light_size", None)) is not None:
            values["light_size"] = light_size[None]
        return {name: values[name] for name in free(light, self.names)}


def with_values(light: Any, values: Values) -> Any:
    """A light with some of its parameters replaced, and its direction turned by a step."""
    if isinstance(light, SphericalHarmonicsLight):
        color = values.get("color", light.coefficients)
        return SphericalHarmonicsLight(color.reshape(light.coefficients.shape))
    if isinstance(light, EnvironmentLight):  # Of which only the color is free.
        color = values.get("color", light.color)
        return eqx.tree_at(lambda light: light.color, light, color)
    fields = {name: getattr(light, name) for name in vars(light)} | values
    if "direction" in values:
        fields["direction"] = _turned(light.direction, values["direction"])
    if "angles" in values:
        fields["inner_angle"], fields["outer_angle"] = fields.pop("angles")
    if "light_size" in values:
        (fields["light_size"],) = values["light_size"]
    return type(light)(**fields)


def _turned(direction: Float[Array, "3"], step: Float[Array, "2"]) -> Float[Array, "3"]:
    """A direction after a step across it, by stereographic projection.

    A small step is an angle in radians; no step is too large.
    """
    ahead = normalize(direction)
    across = normalize(jnp.cross(ahead, jnp.eye(3)[jnp.argmin(jnp.abs(ahead))]))
    quarter_square = step @ step / 4
    sideways = step[0] * across + step[1] * jnp.cross(ahead, across)
    return ((1 - quarter_square) * ahead + sideways) / (1 + quarter_square)


class Search(eqx.Module):
    """The solver's unknowns as lights: steps from the lights of the start.

    - `scale`: the unit of a position's step, in scene units.
    """

    model: Model
    start: tuple[Any, ...]
    scale: Float[Array, ""]

    def unknowns(self) -> list[Values]:
        """The unknowns of the start: zeros; for a cone, logits of its ratios of angles.

        A size's is the logarithm of its ratio to the start's.
        """
        unknowns = []
        for light in self.start:
            values = self.model.values(light)
            values.pop("color", None)
            unknowns.append({name: jnp.zeros_like(value) for name, value in values.items()})
            if "angles" in values:
                inner, outer = values["angles"]
                ratios = jnp.stack([inner / outer, outer / jnp.pi])
                ratios = jnp.clip(ratios, _MARGIN, 1 - _MARGIN)
                unknowns[-1]["angles"] = jnp.log(ratios) - jnp.log1p(-ratios)
        return unknowns

    def lights(self, unknowns: list[Values]) -> list[Light]:
        """The lights of the start after these steps; their colors as they were."""
        moved = []
        for light, steps in zip(self.start, unknowns, strict=True):
            values = dict(steps)
            if "position" in steps:
                values["position"] = light.position + self.scale * steps["position"]
            if "angles" in steps:
                ratio, outer = jax.nn.sigmoid(steps["angles"]) * jnp.array([1, jnp.pi])
                values["angles"] = jnp.stack([ratio * outer, outer])
            if "light_size" in steps:
                values["light_size"] = light.light_size * jnp.exp(steps["light_size"])
            moved.append(with_values(light, values))
        return moved


class Residual(eqx.Module):
    """The image less the reference, as a function of the unknowns, with the best colors.

    - `unit`: the root mean square of the reference, which divides the difference.
    - `root`: the root of each pixel's weight.
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
            image = jnp.einsum("kc,khwc->hwc", colors, basis)
        else:
            image = model(lights)
        return (self.root * (image - self.reference) / self.unit).astype(float)


def _ridge_colors(
    basis: Float[Array, "color height width 3"], reference: Float[Array, "height width 3"]
) -> Float[Array, "color 3"]:
    """Colors close to the best, by normal equations with a ridge: differentiable everywhere.

    `basis` is the image of each color if it is white.
    """
    gram = jnp.einsum("ihwc,jhwc->cij", basis, basis)
    right = jnp.einsum("ihwc,hwc->ci", basis, reference)
    squares = jnp.diagonal(gram, axis1=1, axis2=2)
    lengths = jnp.where(squares > 0, jnp.sqrt(jnp.where(squares > 0, squares, 1)), 1)
    ridge = _RIDGE * jnp.sqrt(jnp.finfo(gram.dtype).eps) * jnp.eye(len(basis), dtype=gram.dtype)
    scaled = gram / lengths[:, :, None] / lengths[:, None, :] + ridge[None]
    # No batch, for the reason that `_jackknife` has.
    pairs = zip(scaled, right / lengths, strict=True)
    solved = jnp.stack([jnp.linalg.solve(matrix, vector) for matrix, vector in pairs])
    return (solved / lengths).T


def best_colors(
    basis: Float[Array, "color height width 3"],
    reference: Float[Array, "height width 3"],
    root: Float[Array, "height width 1"],
) -> Float[Any, "3 color"]:
    """The best colors, the smallest of them where several are as good, for the end of a search.

    `root` is the root of each pixel's weight.
    """
    if not is_concrete(basis, reference, root):
        solve = lambda a, b: jnp.linalg.lstsq(a.reshape(len(a), -1).T, b.ravel(), rcond=1e-6)[0]
        weight = root.astype(float)
        columns, right = weight[None] * basis.astype(float), weight * reference.astype(float)
        return jnp.stack([solve(columns[..., c], right[..., c]) for c in range(3)])
    weight = np.asarray(root, np.float64)
    columns = weight * np.asarray(basis, np.float64)
    right = weight * np.asarray(reference, np.float64)
    solve = lambda a, b: np.linalg.lstsq(a.reshape(len(a), -1).T, b.ravel(), rcond=1e-6)[0]
    return np.stack([solve(columns[..., c], right[..., c]) for c in range(3)])


def spread(gbuffer: GBuffer, camera: _Camera) -> Float[Array, ""]:
    """Root mean square distance of the visible points from their mean; 1 where it is 0."""
    points, shown = _points(gbuffer, camera)
    counts = shown.astype(float)[..., None]
    share = counts / jnp.maximum(jnp.sum(counts), 1)
    from_mean = points - jnp.sum(share * points, axis=(0, 1))[None, None]
    square = jnp.sum(share * from_mean**2)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 1)


def mean_point(
    gbuffer: GBuffer, camera: _Camera, weight: Float[Array, "height width"]
) -> Float[Array, "3"]:
    """The mean of the visible points by weight; of all where the weight is 0 everywhere."""
    points, shown = _points(gbuffer, camera)
    counts = jnp.where(shown, weight.astype(float), 0)
    counts = jnp.where(jnp.sum(counts) > 0, counts, 1)
    return jnp.einsum("hw,hwc->c", counts / jnp.sum(counts), points)


def _points(gbuffer: GBuffer, camera: _Camera) -> tuple[Array, Array]:
    """The point that each pixel shows, in world space, 0 where it shows none; and whether."""
    shown = (gbuffer.depth > 0) & jnp.isfinite(gbuffer.depth)
    height, width = shown.shape
    pixels = pixel_centers(height, width, gbuffer.depth.dtype)
    points = camera.unproject(pixels, jnp.where(shown, gbuffer.depth, 1))
    return points.astype(float), shown
