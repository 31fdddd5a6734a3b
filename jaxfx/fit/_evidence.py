"""Standard errors of lights, and which lights and parameters a picture does not determine."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx.fit._descent import covariance, standard_errors, tiles
from jaxfx.fit._lighting import Model, middle_of, with_values
from jaxfx.fit._robust import CUT, flatness, lengths
from jaxfx.light import Light


# Columns of the normal matrix, each of length 1, are taken for dependent where a combination
# of length 1 is shorter than a thousandth; lights for one group where they share in it so much.
_DEPENDENT, _SHARED = 1e-6, 1e-2

# Two lights of one kind are as one where their places and directions differ by less than so
# many of their joint standard errors: brightness may then go from one to the other, by far more
# than derivatives tell. With a smaller number chance makes two lights of one, with a larger one
# lights that are apart are called one.
_APART = 3.0

# The noise of any picture is at least this share of its root mean square, about that of 8
# bits: less makes no outlier, and nothing is stated to be surer than with such noise.
LEAST_NOISE = 1e-3

# A standard error above this is that of what is not known: of a direction or an angle in
# radians, of a position over its distance to what is lit, of a colour in what its light adds to
# the picture, root mean square, over the picture's.
_MOST_ERROR = 0.2

# A picture whose contrast is a smaller share of its root mean square is taken to have so much:
# on an even wall, noise is all the contrast that there is.
_LEAST_CONTRAST = 0.1

Errors = tuple[dict[str, Float[Array, "..."]], ...]
Groups = tuple[tuple[int, ...], ...]


class Evidence(NamedTuple):
    """The fields of `LightsFit` on how well a picture determines its lights."""

    errors: Errors
    groups: Groups
    untold: tuple[tuple[int, str], ...]
    share: Float[Array, ""]
    explained: Float[Array, ""]


def evidence(
    model: Model,
    lights: tuple[Light, ...],
    columns: Float[Array, "residual number"],
    image: Float[Array, "height width 3"],
    reference: Float[Array, "height width 3"],
    given: Float[Array, "height width"],
    weight: Float[Array, "height width"],
    noise: Float[Array, "2"],
) -> Evidence:
    """From the picture at the end of a search and its derivatives, and what pixels counted.

    The columns are in the order of the lights and of their values. `noise` is inf where all
    counted as given.
    """
    exact = lambda *arrays: (array.astype(float) for array in arrays)
    columns, image, reference, noise = exact(columns, image, reference, noise)
    given, weight, seen = exact(given, weight, _basis(model, lights))
    root = jnp.sqrt(weight)[..., None]
    columns = jnp.repeat(root, 3, axis=2).reshape(-1, 1) * columns
    length = lengths(image - reference, given)
    flat = flatness(length, noise, given)
    residual = root * jnp.where(flat > 0, (image - reference) / flat, jnp.inf)
    block, count = tiles(residual.shape)
    variances = jnp.diagonal(covariance(columns, residual.reshape(-1), block, count))
    least = LEAST_NOISE * brightness(reference, given)
    floor = standard_errors(columns, jnp.full_like(residual, least))
    errors = jnp.sqrt(jnp.maximum(variances, floor**2))
    projection = _projection(np.asarray(columns, np.float64))
    is_untold = np.diag(projection) > _SHARED
    errors = jnp.where(is_untold | jnp.isnan(errors), jnp.inf, errors)
    owners = [i for i, each in enumerate(map(model.values, lights)) for _ in _flat(each)]
    found = _by_light(model, lights, errors)
    near = _near(lights, found)
    for index in {index for pair in near for index in pair}:
        if "color" in found[index]:
            found[index]["color"] = jnp.full(3, jnp.inf)
    return Evidence(
        found,
        _groups([*near, *_dependent(projection, np.array(owners))]),
        _untold(model, lights, found, seen, reference, given),
        jnp.sum(jnp.where(jnp.any(seen != 0, axis=(0, 3)), weight, 0)) / jnp.sum(given),
        _explained(reference, given, jnp.minimum(length[0], CUT * noise[0])),
    )


@eqx.filter_jit
def linearized(model, lights):
    """The picture, and its Jacobian in the order of the lights and of their values."""

    def draw(values):
        moved = [with_values(light, each) for light, each in zip(lights, values, strict=True)]
        image = model(moved)
        return image, image

    values = [model.values(light) for light in lights]
    jacobian, image = jax.jacfwd(draw, has_aux=True)(values)
    blocks = [
        each[name] for each, value in zip(jacobian, values, strict=True) for name in value
    ]
    columns = [block.reshape(-1, block.shape[-1]) for block in blocks]
    return image, jnp.concatenate(columns, axis=1)


@eqx.filter_jit
def _basis(model, lights):
    return model.basis(lights)


def brightness(
    image: Float[Array, "height width 3"], given: Float[Array, "height width"]
) -> Float[Array, ""]:
    """The root mean square of a picture where it counts; 1 for black."""
    root = jnp.sqrt(jnp.mean(given[..., None] * image**2) / jnp.mean(given))
    return jnp.where(root > 0, root, 1)


def _explained(
    reference: Float[Array, "height width 3"],
    given: Float[Array, "height width"],
    length: Float[Array, "height width"],
) -> Float[Array, ""]:
    """The share of the contrast that residuals of these lengths leave explained."""
    weight = (given / jnp.sum(given))[..., None]
    middle = jnp.sum(weight * reference, axis=(0, 1), keepdims=True)
    contrast = jnp.sum(weight * (reference - middle) ** 2)
    least = 3 * (_LEAST_CONTRAST * brightness(reference, given)) ** 2
    return 1 - jnp.sum(weight[..., 0] * length**2) / jnp.maximum(contrast, least)


def _untold(
    model: Model,
    lights: tuple[Light, ...],
    errors: Errors,
    basis: Float[Array, "light height width 3"],
    reference: Float[Array, "height width 3"],
    given: Float[Array, "height width"],
) -> tuple[tuple[int, str], ...]:
    """The parameters, by light and name, that are not known."""
    whole, names = brightness(reference, given), []
    each: tuple[Any, ...] = lights
    for index, (light, own, white) in enumerate(zip(each, errors, basis, strict=True)):
        lit = given * jnp.sum(white, axis=-1)
        for name, error in own.items():
            size = 1.0
            if name == "color":
                size = whole / brightness(white, given)
            elif name == "position":
                lit_middle = middle_of(model.gbuffer, model.camera, lit)
                size = jnp.linalg.norm(light.position - lit_middle)
            if not jnp.linalg.norm(error) <= _MOST_ERROR * size:
                names.append((index, name))
    return tuple(names)


def _flat(values: dict[str, Array]) -> list[Array]:
    return [number for value in values.values() for number in value]


def _by_light(
    model: Model, lights: tuple[Light, ...], errors: Float[Array, " number"]
) -> Errors:
    """The errors by light and name; a direction's two as one angle."""
    rest, found = list(errors), []
    for light in lights:
        found.append({})
        for name, value in model.values(light).items():
            own, rest = jnp.stack(rest[: len(value)]), rest[len(value) :]
            found[-1][name] = jnp.sqrt(jnp.sum(own**2)) if name == "direction" else own
    return tuple(found)


def _projection(columns: Float[np.ndarray, "residual number"]) -> np.ndarray:
    """On the combinations of columns that change nothing, of those that change something."""
    lengths = np.linalg.norm(columns, axis=0)
    is_told = lengths > 0
    columns = columns / np.where(is_told, lengths, 1)
    squares, vectors = np.linalg.eigh(columns.T @ columns + np.diag(1.0 * ~is_told))
    null = vectors[:, squares < _DEPENDENT]
    return null @ null.T


def _dependent(projection: np.ndarray, owners: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of lights that share in combinations of columns that change nothing."""
    lights = np.unique(owners).tolist()
    shared = lambda i, j: np.linalg.norm(projection[owners == i][:, owners == j])
    return [(i, j) for i in lights for j in lights if i < j and shared(i, j) > _SHARED]


def _near(lights: tuple[Light, ...], errors: Errors) -> list[tuple[int, int]]:
    """Pairs of lights of one kind that were moved and are as one within their errors."""
    pairs = []
    for i, one in enumerate(lights):
        for j, other in enumerate(lights[:i]):
            names = [name for name in ("position", "direction") if name in errors[i]]
            if type(one) is not type(other) or not names:
                continue
            if all(_apart(one, other, name, errors[i], errors[j]) < _APART for name in names):
                pairs.append((j, i))
    return pairs


def _apart(one: Any, other: Any, name: str, error: Any, other_error: Any) -> float:
    """How far apart the places or the directions of two lights are, in joint errors."""
    values = [np.asarray(getattr(light, name), np.float64) for light in (one, other)]
    if name == "direction":
        values = [value / np.linalg.norm(value) for value in values]
    joint = np.linalg.norm([*np.ravel(error[name]), *np.ravel(other_error[name])])
    return float(np.linalg.norm(values[0] - values[1]) / joint)


def _groups(pairs: list[tuple[int, int]]) -> Groups:
    """The connected components of a graph whose edges are the pairs."""
    groups: list[set[int]] = []
    for pair in pairs:
        touched = [group for group in groups if group & {*pair}]
        groups = [group for group in groups if group not in touched]
        groups.append({*pair}.union(*touched))
    return tuple(sorted(tuple(sorted(group)) for group in groups))
