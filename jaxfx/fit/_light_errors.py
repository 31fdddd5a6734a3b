"""Standard errors of lights, and which lights and parameters an image does not determine."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfx._arrays import ArrayLike
from jaxfx.fit._jackknife import covariance, independent_errors, tiles
from jaxfx.fit._light_model import Model, color_shape, mean_point, with_values
from jaxfx.fit._robust import CUT, flatness, lengths
from jaxfx.light import Light, SphericalHarmonicsLight


# Columns of the Jacobian, each of length 1, are dependent where a combination of length 1 of
# them has a square below the first number (is shorter than a thousandth); lights are one group
# where the norm of their part in such combinations is above the second. With larger first or
# smaller second numbers lights that differ are called one.
_DEPENDENT, _SHARED = 1e-6, 1e-2

# Two lights of one kind are as one where their positions and directions differ by fewer of
# their joint standard errors: brightness may then go from one to the other, by far more than
# derivatives tell. With a smaller number two lights are told apart by chance, with a larger one
# lights that are apart are called one.
_APART = 3.0

# The least noise of an image, as a ratio to its root mean square, about that of 8 bits: smaller
# differences are no outliers, and no standard error is below that of such noise.
LEAST_NOISE = 1e-3

# The largest standard error of a parameter that is determined: of a direction or an angle in
# radians; of a position as a ratio to its distance from the lit points; of a size as a ratio to
# it; of a color as the ratio
# of what it adds to the image to the image itself, root mean squares.
_MOST_ERROR = 0.2

# The least contrast of an image, as a ratio to its root mean square: the contrast of an even
# wall is noise, of which nothing can be explained.
_LEAST_CONTRAST = 0.1

# What it must change in an image that a light loses its size, as a ratio to what the derivative
# says: a penumbra of many pixels and texels has 1, one of two texels of a shadow map a half.
# With a smaller number sizes are stated that are those of texels; this one also refuses some
# that are right, of penumbrae of one to two pixels.
_LEAST_CHANGE = 0.5

Errors = tuple[dict[str, Float[Array, "..."]], ...]


class Evidence(NamedTuple):
    """The fields of `LightsFit` on how well an image determines its lights."""

    standard_errors: Errors
    alike: Bool[Array, "light light"]
    unsure: tuple[dict[str, Bool[Array, ""]], ...]
    share: Float[Array, ""]
    explained: Float[Array, ""]


@eqx.filter_jit
def evidence(
    model: Model,
    lights: tuple[Light, ...],
    columns: Float[Array, "residual number"],
    image: Float[Array, "height width 3"],
    reference: Float[Array, "height width 3"],
    base_weight: Float[Array, "height width"],
    weight: Float[Array, "height width"],
    noise: Float[Array, "2"],
) -> Evidence:
    """Standard errors and quality at the end of a search.

    `columns` is the Jacobian of `image` there, in the order of the lights and of their values.
    `base_weight` is the user's weight, `weight` that at the end; `noise` is that of `_robust`,
    inf where the loss is plain squares.
    """
    exact = lambda *arrays: (array.astype(float) for array in arrays)
    columns, image, reference, noise = exact(columns, image, reference, noise)
    base_weight, weight, basis = exact(base_weight, weight, _basis(model, lights))
    root = jnp.sqrt(weight)[..., None]
    columns = jnp.repeat(root, 3, axis=2).reshape(-1, 1) * columns
    length = lengths(image - reference, base_weight)
    flat = flatness(length, noise, base_weight)
    residual = root * jnp.where(flat > 0, (image - reference) / flat, jnp.inf)
    block, count = tiles(residual.shape)
    variances = jnp.diagonal(covariance(columns, residual.reshape(-1), block, count))
    least = LEAST_NOISE * brightness(reference, base_weight)
    floor = independent_errors(columns, jnp.full_like(residual, least))
    errors = jnp.sqrt(jnp.maximum(variances, floor**2))
    projection = _null_projection(columns)
    is_untold = jnp.diagonal(projection) > _SHARED
    is_untold = is_untold | _is_hidden(model, lights, columns, image, root)
    errors = jnp.where(is_untold | jnp.isnan(errors), jnp.inf, errors)
    owners = [i for i, values in enumerate(map(model.values, lights)) for _ in _flat(values)]
    by_light = _by_light(model, lights, errors)
    near = _near(lights, by_light)
    for own, is_near in zip(by_light, near, strict=True):
        if "color" in own:
            own["color"] = jnp.where(jnp.any(is_near), jnp.inf, own["color"])
    is_reached = jnp.any(basis != 0, axis=(0, 3))
    return Evidence(
        by_light,
        near | _dependent(projection, owners, len(lights)),
        _untold(model, lights, by_light, basis, reference, base_weight),
        jnp.sum(jnp.where(is_reached, weight, 0)) / jnp.sum(base_weight),
        _explained(reference, base_weight, jnp.minimum(length[0], CUT * noise[0])),
    )


def _is_hidden(
    model: Model,
    lights: tuple[Light, ...],
    columns: Float[Array, "residual number"],
    image: Float[Array, "height width 3"],
    root: Float[Array, "height width 1"],
) -> Bool[Array, " number"]:
    """Which numbers are sizes whose penumbra no pixel shows.

    There the image is as well explained by every smaller size, and the search ends at the
    largest, where the derivative from above tells nothing of it. A shadow map knows none below
    its texel. `columns` are weighted by `root`.
    """
    hidden, first = [], 0
    for index, light in enumerate(lights):
        for name, value in model.values(light).items():
            own = jnp.zeros(len(value), bool)
            if name == "light_size":
                sharp = list(lights)
                sharp[index] = with_values(light, {name: value * 1e-3})
                without = _drawn(model, tuple(sharp)).astype(image.dtype)
                change = jnp.linalg.norm(root * (without - image))
                expected = jnp.linalg.norm(columns[:, first] * value)
                own = ~(change >= _LEAST_CHANGE * expected)[None]
            hidden.append(own)
            first += len(value)
    return jnp.concatenate(hidden)


@eqx.filter_jit
def _drawn(model, lights):
    return model(lights)


@eqx.filter_jit
def linearized(model, lights):
    """The image, and its Jacobian: residual number, by the lights and their values."""

    def draw(values):
        moved = [with_values(light, own) for light, own in zip(lights, values, strict=True)]
        image = model(moved)
        return image, image

    values = [model.values(light) for light in lights]
    jacobian, image = jax.jacfwd(draw, has_aux=True)(values)
    blocks = [
        derivatives[name]
        for derivatives, own in zip(jacobian, values, strict=True)
        for name in own
    ]
    columns = [block.reshape(-1, block.shape[-1]) for block in blocks]
    return image, jnp.concatenate(columns, axis=1)


@eqx.filter_jit
def _basis(model, lights):
    return model.basis(lights)


def brightness(
    image: Float[Array, "height width 3"], base_weight: Float[Array, "height width"]
) -> Float[Array, ""]:
    """The root mean square of an image by weight; 1 for black."""
    root = jnp.sqrt(jnp.mean(base_weight[..., None] * image**2) / jnp.mean(base_weight))
    return jnp.where(root > 0, root, 1)


def _explained(
    reference: Float[Array, "height width 3"],
    base_weight: Float[Array, "height width"],
    length: Float[Array, "height width"],
) -> Float[Array, ""]:
    """The ratio of the reference's contrast that residuals of these lengths do not take up."""
    weight = (base_weight / jnp.sum(base_weight))[..., None]
    mean = jnp.sum(weight * reference, axis=(0, 1), keepdims=True)
    contrast = jnp.sum(weight * (reference - mean) ** 2)
    least = 3 * (_LEAST_CONTRAST * brightness(reference, base_weight)) ** 2
    return 1 - jnp.sum(weight[..., 0] * length**2) / jnp.maximum(contrast, least)


def _untold(
    model: Model,
    lights: tuple[Light, ...],
    errors: Errors,
    basis: Float[Array, "color height width 3"],
    reference: Float[Array, "height width 3"],
    base_weight: Float[Array, "height width"],
) -> tuple[dict[str, Bool[Array, ""]], ...]:
    """For each light, by name, whether the parameter is not determined.

    `basis` is what each color adds to the image if it is white.
    """
    whole, unsure = brightness(reference, base_weight), []
    fields: tuple[Any, ...] = lights
    for light, errors_of in zip(fields, errors, strict=True):
        count, _ = color_shape(light)
        white, basis = basis[:count], basis[count:]
        lit = base_weight * jnp.sum(white[0], axis=-1)
        unsure.append({})
        for name, error in errors_of.items():
            size, own = 1.0, error
            if name == "color":
                each = jnp.stack([brightness(image, base_weight) for image in white])
                size = whole * count**0.5
                own = error.reshape(count, 3) * each[:, None]
            elif name == "position":
                lit_point = mean_point(model.gbuffer, model.camera, lit)
                size = jnp.linalg.norm(light.position - lit_point)
            elif name == "light_size":
                size = light.light_size
            unsure[-1][name] = ~(jnp.linalg.norm(own) <= _MOST_ERROR * size)
    return tuple(unsure)


def _flat(values: dict[str, Array]) -> list[Array]:
    return [number for value in values.values() for number in value]


def _by_light(
    model: Model, lights: tuple[Light, ...], errors: Float[Array, " number"]
) -> Errors:
    """The errors by light and name; the two of a direction as one angle."""
    rest, by_light = list(errors), []
    for light in lights:
        by_light.append({})
        for name, value in model.values(light).items():
            own, rest = jnp.stack(rest[: len(value)]), rest[len(value) :]
            if name == "color" and isinstance(light, SphericalHarmonicsLight):
                own = own.reshape(light.coefficients.shape)
            is_one = name in ("direction", "light_size")
            by_light[-1][name] = jnp.sqrt(jnp.sum(own**2)) if is_one else own
    return tuple(by_light)


def _null_projection(columns: Float[Array, "residual number"]) -> Float[Array, "number number"]:
    """The projection onto combinations of parameters that change nothing.

    Columns of zeros are left out: they are told by their errors.
    """
    lengths = jnp.linalg.norm(columns, axis=0)
    is_told = lengths > 0
    columns = columns / jnp.where(is_told, lengths, 1)[None]
    # Not by eigenvalues of the columns' products, which in float32 are as small by rounding.
    rows = [jnp.linalg.qr(columns, mode="r"), jnp.diag((~is_told).astype(columns.dtype))]
    _, sizes, vectors = jnp.linalg.svd(jnp.concatenate(rows), full_matrices=False)
    is_null = (sizes**2 < _DEPENDENT)[:, None]
    return vectors.T @ jnp.where(is_null, vectors, 0)


def _dependent(
    projection: Float[Array, "number number"], owners: Sequence[int], count: int
) -> Bool[Array, "light light"]:
    """Which of `count` lights take part in one combination of numbers that changes nothing.

    `owners` is the light of each number.
    """
    own = jnp.asarray(np.eye(count)[:, np.array(owners, int)], projection.dtype)
    squares = own @ projection**2 @ own.T
    return (squares > _SHARED**2) & ~jnp.eye(count, dtype=bool)


def _near(lights: tuple[Light, ...], errors: Errors) -> Bool[Array, "light light"]:
    """Which lights of one kind have fitted places within `_APART` joint errors."""
    near = jnp.zeros((len(lights), len(lights)), bool)
    for i, light in enumerate(lights):
        for j, other in enumerate(lights[:i]):
            names = [name for name in ("position", "direction") if name in errors[i]]
            if type(light) is not type(other) or not names:
                continue
            apart = [_apart(light, other, name, errors[i], errors[j]) for name in names]
            is_near = jnp.all(jnp.stack(apart) < _APART)
            near = near.at[i, j].set(is_near).at[j, i].set(is_near)
    return near


def _apart(first: Any, other: Any, name: str, error: Any, other_error: Any) -> Array:
    """The distance between the positions or directions of two lights, in joint errors."""
    values = [getattr(light, name).astype(float) for light in (first, other)]
    if name == "direction":
        values = [value / jnp.linalg.norm(value) for value in values]
    joint = jnp.concatenate([jnp.reshape(each[name], -1) for each in (error, other_error)])
    return jnp.linalg.norm(values[0] - values[1]) / jnp.linalg.norm(joint)


def groups(alike: Bool[ArrayLike, "light light"]) -> tuple[tuple[int, ...], ...]:
    """The connected components of a graph, by its matrix, of two lights or more."""
    found: list[set[int]] = []
    for pair in np.argwhere(np.triu(np.asarray(alike))).tolist():
        touched = [group for group in found if group & {*pair}]
        found = [group for group in found if group not in touched]
        found.append({*pair}.union(*touched))
    return tuple(sorted(tuple(sorted(group)) for group in found))
