"""The lights of a picture, from it and a deep frame buffer: inverse lighting."""

import logging
from collections.abc import Callable, Collection, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfx._arguments import check_camera, check_gbuffer, check_lights
from jaxfx._checks import WholeNumber, check, check_image, items, share, whole_number
from jaxfx._progress import Bar
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.fit._descent import End, Solver, descend, standard_errors, verdict
from jaxfx.fit._lighting import (
    Model,
    Residual,
    Search,
    Values,
    best_colors,
    free,
    spread,
    with_values,
)
from jaxfx.gbuffer import GBuffer
from jaxfx.light import Light


_logger = logging.getLogger("jaxfx")

LIGHT_PARAMETERS = ("color", "position", "direction", "angles")

# Columns of the normal matrix, each of length 1, are taken for dependent where a combination
# of length 1 is shorter than a thousandth; lights for one group where they share in it so much.
_DEPENDENT, _SHARED = 1e-6, 1e-2


@final
class LightsFit(eqx.Module):
    """What `lights` found.

    - `lights`: the lights, in the order given; what was frozen as it was.
    - `image`: height width 3, the picture under them.
    - `losses`: the mean squared residual at the start of each round and after every step, in
      squared units of radiance, always with the best colours where colours are fitted.
    - `uncertainty`: for each light a standard error of every parameter that was fitted, in its
      own unit: 3 for the colour and the position, an angle in radians for the direction, 2
      (inner, outer) for the angles. As if the residuals were independent: compare the numbers
      with one another. inf where the picture has nothing to say.
    - `indistinct`: groups of lights, by their indices, that the picture can't tell apart: it
      stays the same, to a thousandth of what each change alone would do, when the parameters of
      all the group's lights change together. Colours within a group are the smallest.
    - `result`: optimistix' verdict on the last round, one of its `RESULTS`; it prints as a
      sentence.
    """

    lights: tuple[Light, ...]
    image: Float[Array, "height width 3"]
    losses: Float[Array, " steps"]
    uncertainty: tuple[dict[str, Float[Array, "..."]], ...]
    indistinct: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    result: optx.RESULTS

    @property
    def success(self) -> bool:
        """Whether the solver converged."""
        return bool(self.result == optx.RESULTS.successful)


def lights(
    reference: Float[ArrayLike, "height width 3"],
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera,
    lights: Sequence[Light],
    *,
    visibility: Any = None,
    rounds: WholeNumber = 1,
    solver: Solver | None = None,
    parameters: Collection[str] = LIGHT_PARAMETERS,
    max_steps: WholeNumber = 64,
    throw: bool = True,
    progress: bool = False,
) -> LightsFit:
    """The lights under which a deep frame buffer looks most like a reference.

    Least squares over all pixels and channels. The picture is linear in the colours: for given
    positions, directions and angles the best ones are solved for, and only the rest is searched
    (variable projection). Directions move on the sphere; a cone stays in order,
    0 < inner < outer < pi, by logistic functions. Colours are not forced to be positive: a
    negative one says that the model does not fit.

    The search is local. Started too far away it may end in another minimum. What changes
    nothing to begin with, the place of a light that lights nothing say, has no derivative to
    move it: it stays, and the log says so.

    **Arguments:**

    - `reference`: height width 3, linear radiance.
    - `gbuffer`, `camera`: as in `relight.shade`. Where the depth is missing (0, negative, NaN)
      a pixel has no say.
    - `lights`: their number and kinds, and where the search starts; colours count only if they
      are not fitted.
    - `visibility`: shadows, one entry a light: None; height width in [0, 1], frozen; or a
      function of the light that gives that and can be differentiated, a `MovingShadow` say. Or,
      for shadows that are made anew in each round, a function of the lights (those found so
      far) and of the round (0, 1, ...) that gives such entries.
    - `rounds`: how often to search, each time from where the last ended.
    - `solver`: any least-squares solver or minimiser of optimistix. By default
      Levenberg-Marquardt, which has also converged where six steps gain next to nothing.
    - `parameters`: the names to fit, out of `fit.LIGHT_PARAMETERS`; the others stay as given.
    - `max_steps`: of the solver, in each round.
    - `throw`: raise where the last round fails; else the failure stands in the result.
    - `progress`: show a bar on stderr; it needs the extra `plot`.

    **Returns:** a `LightsFit`.

    **Raises:** `ValueError` for what `relight.shade` refuses, for shapes or numbers of entries
    that differ, parameters that no light has, a reference that is not finite, or a start where
    nothing changes the image. `RuntimeError` where the last round fails and `throw` is true.

    **Gradient:** none through the search: it stops at every step to report.

    Source: the elimination of the linear unknowns is Golub & Pereyra 1973; that the colours of
    lights are a linear problem, Schoeneman et al. 1993.
    """
    gbuffer = check_gbuffer("lights(gbuffer)", gbuffer)
    check_camera("lights(camera)", camera)
    reference, gbuffer = _known(_reference(reference, gbuffer), gbuffer)
    start = _start(lights)
    names, shape = _names(parameters, start), gbuffer.depth.shape
    rounds = whole_number("lights(rounds=...)", rounds)
    max_steps = whole_number("lights(max_steps=...)", max_steps)
    with Bar(progress, "fit") as bar:
        model, end = _search_in_rounds(
            rounds,
            start,
            lambda given: Model(gbuffer, camera, _entries(given, len(start), shape), names),
            visibility,
            lambda model, lights: _search(model, lights, reference, solver, max_steps, bar),
        )
    if throw:
        end.check("lights", "lights")
    found, losses = end.unknowns, end.losses
    image, columns = _linearized(model, found)
    errors = standard_errors(columns, image - reference)
    owners = [i for i, each in enumerate(map(model.values, found)) for _ in _flat(each)]
    return LightsFit(
        found,
        image,
        jnp.stack(losses),
        _uncertainty(model, found, errors),
        _dependent_groups(np.asarray(columns, np.float64), np.array(owners)),
        end.result,
    )


def _reference(reference: Any, gbuffer: Any) -> Float[Array, "height width 3"]:
    """The picture, checked, in the type of the cache."""
    reference = check_image("lights(reference)", reference)
    if reference.shape != gbuffer.color.shape:
        raise ValueError(
            f"`lights(reference)` must have the cache's shape {gbuffer.color.shape}, "
            f"got {reference.shape}."
        )
    check("lights(reference)", reference, np.isfinite, "finite")
    return reference.astype(gbuffer.color.dtype)


def _known(reference: Array, gbuffer: GBuffer) -> tuple[Array, GBuffer]:
    """Both black where the depth is missing: such a pixel has no say."""
    missing = ~(gbuffer.depth > 0)
    shader = jnp.where(missing, -1, gbuffer.shader)
    gbuffer = eqx.tree_at(lambda gbuffer: gbuffer.shader, gbuffer, shader)
    return jnp.where(missing[..., None], 0, reference), gbuffer


def _start(lights: Any) -> tuple[Light, ...]:
    """The lights, checked, in JAX's default type: that is the type of the solvers' numbers."""
    lights = check_lights("lights(lights)", lights)
    if not lights:
        raise ValueError("`lights(lights)` must be a sequence of lights, got none.")
    return jax.tree.map(lambda leaf: leaf.astype(float), lights)


def _names(parameters: Collection[str], lights: tuple[Light, ...]) -> tuple[str, ...]:
    names = tuple(name for name in LIGHT_PARAMETERS if name in parameters)
    if len(names) != len(parameters) or not any(free(light, names) for light in lights):
        raise ValueError(
            f"`lights(parameters=...)` must name some of {LIGHT_PARAMETERS} that the lights "
            f"have, got {tuple(parameters)}."
        )
    return names


def _entries(visibility: Any, count: int, shape: tuple[int, ...]) -> tuple[Any, ...]:
    """The entries of `visibility`, checked."""
    name = "lights(visibility=...)"
    given = [None] * count if visibility is None else visibility
    entries = items(name, given, "a sequence of entries, or a function")
    if len(entries) != count:
        raise ValueError(
            f"`lights(visibility=...)` must have an entry for each of {count} lights, "
            f"got {len(entries)}."
        )
    return tuple(
        each if each is None or callable(each) else share(name, each, shape) for each in entries
    )


def _search_in_rounds(
    rounds: int,
    lights: tuple[Light, ...],
    make: Callable[[Any], Model],
    visibility: Any,
    search: Callable[[Model, tuple[Light, ...]], End],
) -> tuple[Model, End]:
    """The last round's model and end, with the losses of all."""
    entries_of = visibility if callable(visibility) else lambda lights, index: visibility

    def search_once(lights: tuple[Light, ...], index: int) -> tuple[Model, End]:
        model = make(entries_of(lights, index))
        return model, search(model, lights)

    model, end = search_once(lights, 0)
    for index in range(1, rounds):
        model, again = search_once(end.unknowns, index)
        end = again._replace(losses=end.losses + again.losses)
    return model, end


def _search(
    model: Model,
    lights: tuple[Light, ...],
    reference: Float[Array, "height width 3"],
    solver: Solver | None,
    max_steps: int,
    bar: Bar,
) -> End:
    """One round: an `End` whose unknowns are the lights found."""
    _say_what_does_not_move(model, lights)
    search = Search(model, lights, spread(model.gbuffer, model.camera))
    unit = jnp.sqrt(jnp.mean(reference**2))
    residual = Residual(search, reference, jnp.where(unit > 0, unit, 1))
    unknowns = search.unknowns()
    if any(unknowns):
        end = descend(residual, unknowns, solver=solver, max_steps=max_steps, bar=bar)
    else:
        end = End(
            unknowns, [jnp.mean(residual(unknowns) ** 2)], verdict(optx.RESULTS.successful)
        )
    found = _moved(search, end.unknowns)
    if "color" in model.names:
        best = jnp.asarray(best_colors(_basis(model, found), reference).T, float)
        found = [
            eqx.tree_at(lambda light: light.color, light, color)
            for light, color in zip(found, best, strict=True)
        ]
    square = residual.unit.astype(float) ** 2
    return End(tuple(found), [loss * square for loss in end.losses], end.result)


def _say_what_does_not_move(model: Model, lights: tuple[Light, ...]) -> None:
    """Log what of the lights changes nothing in the image; `ValueError` if all of it does."""
    values = [model.values(light) for light in lights]
    # Colours that are fitted are found whatever they were.
    white = lambda light, own: with_values(
        light, {"color": jnp.ones(3)} if "color" in own else {}
    )
    columns = _linearized(model, tuple(map(white, lights, values)))[1]
    is_moving = np.asarray(jnp.any(columns != 0, axis=0)).tolist()
    moving, fixed = [], []
    for index, own in enumerate(values):
        for name, value in own.items():
            numbers, is_moving = is_moving[: len(value)], is_moving[len(value) :]
            (moving if any(numbers) else fixed).append(f"{name} of light {index}")
    names = ", ".join(fixed)
    if not moving:
        raise ValueError(
            "`lights(lights)` must start where something that is fitted changes the image, "
            f"got no derivative in {names}."
        )
    if fixed:
        _logger.warning("`lights` can't move %s, which changes nothing at the start.", names)


@eqx.filter_jit
def _moved(search, unknowns):
    return search.lights(unknowns)


@eqx.filter_jit
def _basis(model, lights):
    return model.basis(lights)


def _flat(values: Values) -> list[Any]:
    return [number for value in values.values() for number in value]


@eqx.filter_jit
def _linearized(model, lights):
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


def _uncertainty(
    model: Model, lights: tuple[Light, ...], errors: Float[Array, " number"]
) -> tuple[dict[str, Array], ...]:
    """The errors by light and name; a direction's two as one angle."""
    rest, found = list(errors), []
    for light in lights:
        found.append({})
        for name, value in model.values(light).items():
            own, rest = jnp.stack(rest[: len(value)]), rest[len(value) :]
            found[-1][name] = jnp.sqrt(jnp.sum(own**2)) if name == "direction" else own
    return tuple(found)


def _dependent_groups(
    columns: Float[np.ndarray, "residual number"], owners: np.ndarray
) -> tuple[tuple[int, ...], ...]:
    """Lights that share in combinations of columns that change nothing, in groups."""
    lengths = np.linalg.norm(columns, axis=0)
    columns, owners = columns[:, lengths > 0] / lengths[lengths > 0], owners[lengths > 0]
    squares, vectors = np.linalg.eigh(columns.T @ columns)
    null = vectors[:, squares < _DEPENDENT]
    lights = np.unique(owners).tolist()
    projection = null @ null.T
    groups: list[set[int]] = []
    for i in lights:
        for j in lights:
            shared = np.linalg.norm(projection[owners == i][:, owners == j])
            if i < j and shared > _SHARED:
                touched = [group for group in groups if group & {i, j}]
                groups = [group for group in groups if group not in touched]
                groups.append({i, j}.union(*touched))
    return tuple(sorted(tuple(sorted(group)) for group in groups))
