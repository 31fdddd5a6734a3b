"""The lights of a picture, from it and a deep frame buffer: inverse lighting."""

from collections.abc import Collection, Sequence
from functools import partial
from typing import Any, Literal, final, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Num

from jaxfx._arguments import check_camera, check_gbuffer, check_lights
from jaxfx._checks import (
    WholeNumber,
    check,
    check_depth,
    check_image,
    items,
    option,
    share,
    whole_number,
)
from jaxfx._progress import Bar
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.fit._descent import End, Solver, descend
from jaxfx.fit._evidence import evidence, linearized
from jaxfx.fit._light_search import search_in_rounds, search_once
from jaxfx.fit._lighting import Model, free
from jaxfx.gbuffer import GBuffer
from jaxfx.light import Light


LIGHT_PARAMETERS = ("color", "position", "direction", "angles")

# What lights must meet to be trusted, both ratios. With a lower share a few pixels decide; a
# lower share of the contrast is what lights explain of pictures that they did not light.
_LEAST_SHARE, _LEAST_EXPLAINED = 0.05, 0.7

Loss = Literal["robust", "squares"]


@final
class LightsFit(eqx.Module):
    """What `lights` found.

    - `lights`: the lights, in the order given; what was frozen as it was.
    - `image`: height width 3, the picture under them.
    - `losses`: the mean squared residual, as weighted at the time, at the start of each search
      and after every step, in squared units of radiance, always with the best colours where
      colours are fitted. It jumps where the pixels are reweighted.
    - `standard_errors`: for each light those of the parameters that were fitted, by name, in
      their units: 3 for the colour and the position, an angle in radians for the direction, 2
      (inner, outer) for the angles. It takes the residuals of 8 x 8 tiles of the image for
      independent of one another, and no others, and is never less than what noise of a
      thousandth of the picture's root mean square would make. inf where the picture has nothing
      to say. It knows nothing of other minima.
    - `indistinct`: groups of lights, by their indices, that the picture can't tell apart: it
      stays the same, to a thousandth of what each change alone would do, when the parameters of
      all the group's lights change together; or they are of one kind, and where they are and
      where to they shine differs by less than three stated errors. Colours of dependent lights
      are the smallest. What takes part in the change, and the colours, have an error of inf.
    - `untold`: what has too large an error to be called known, as the index of its light and
      its name.
    - `weights`: height width, how much the square of each pixel's difference counted in the
      end.
    - `share`: the share of the given weight, a ratio, that counted in the end, of pixels that
      lights reach.
    - `explained`: the share of the picture's contrast, a ratio, that is explained: 1 leaves no
      difference, 0 is no better than an even image.
    - `result`: optimistix' verdict on the last search, one of its `RESULTS`; it prints as a
      sentence.
    """

    lights: tuple[Light, ...]
    image: Float[Array, "height width 3"]
    losses: Float[Array, " steps"]
    standard_errors: tuple[dict[str, Float[Array, "..."]], ...]
    indistinct: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    untold: tuple[tuple[int, str], ...] = eqx.field(static=True)
    weights: Float[Array, "height width"]
    share: Float[Array, ""]
    explained: Float[Array, ""]
    result: optx.RESULTS

    @property
    def doubt(self) -> str:
        """Why the lights are not to be trusted, as a sentence; empty where they are."""
        if self.result != optx.RESULTS.successful:
            return str(self.result)
        if not self.share >= _LEAST_SHARE:
            return f"Only {100 * float(self.share):.0f} % of the pixels have a say."
        if not self.explained >= _LEAST_EXPLAINED:
            return f"Only {100 * float(self.explained):.0f} % of the contrast is explained."
        if self.indistinct:
            groups = ["lights " + " and ".join(map(str, each)) for each in self.indistinct]
            return f"The picture can't tell apart {'; '.join(groups)}."
        if self.untold:
            names = [f"the {name} of light {index}" for index, name in self.untold]
            return f"The picture does not tell {', '.join(names)}."
        return ""

    @property
    def success(self) -> bool:
        """Whether the solver converged, to lights that the picture tells."""
        return not self.doubt


def lights(
    reference: Float[ArrayLike, "height width 3"],
    gbuffer: GBuffer,
    camera: PinholeCamera | OrthographicCamera,
    lights: Sequence[Light],
    *,
    visibilities: Any = None,
    weights: Num[ArrayLike, "height width"] | None = None,
    loss: Loss = "robust",
    rounds: WholeNumber = 1,
    solver: Solver | None = None,
    parameters: Collection[str] = LIGHT_PARAMETERS,
    max_steps: WholeNumber = 64,
    throw: bool = True,
    progress: bool = False,
) -> LightsFit:
    """The lights under which a deep frame buffer looks most like a reference.

    Weighted least squares. The picture is linear in the colours: for given positions,
    directions and angles the best ones are solved for, and only the rest is searched (variable
    projection). Then pixels are reweighted by their residuals, and so on: shadows that the
    model lacks, highlights that are clipped and unknown materials come to have no say. A weight
    is Tukey's biweight of a pixel's difference and that of the sum over 5 x 5 about it, each by
    its noise, which medians tell, and which is eased down, by halves, from what is far off at
    the start. Huber's loss does not do: a shadow only takes light away, and its pull stays.

    Directions move on the sphere; a cone stays in order by logistic functions. A negative
    colour says that the model does not fit. The search is local. What changes nothing to begin
    with, the place of a light that lights nothing say, stays, and the log says so.

    **Arguments:**

    - `reference`: height width 3, linear radiance.
    - `gbuffer`, `camera`: as in `relight.shade`. Where the depth is missing or inf, or the
      shader is -1, a pixel has no say.
    - `lights`: their number and kinds, and where the search starts; colours count only if they
      are not fitted.
    - `visibilities`: shadows, one entry a light: None; height width in [0, 1], frozen; or a
      function of the light that gives that and can be differentiated, a `MovingShadow` say. Or,
      for shadows that are made anew in each round, a function of the lights (those found so
      far) and of the round (0, 1, ...) that gives such entries.
    - `weights`: height width, no unit: how much the square of each pixel's difference counts,
      besides; 0 leaves a pixel out.
    - `loss`: `"robust"`, or `"squares"`, where pixels count as given: what `robust` takes for
      wrong, the edge of a shadow say, may be all that tells where a light is.
    - `rounds`: how often to search, each time from where the last ended.
    - `solver`: any least-squares solver or minimiser of optimistix. By default
      Levenberg-Marquardt, which has also converged where six steps gain next to nothing.
    - `parameters`: the names to fit, out of `fit.LIGHT_PARAMETERS`; the others stay as given.
    - `max_steps`: of the solver, each time it starts.
    - `throw`: raise where the fit is no success; else the failure stands in the result.
    - `progress`: show a bar on stderr; it needs the extra `plot`.

    **Returns:** a `LightsFit`.

    **Raises:** `ValueError` for what `relight.shade` refuses, for shapes or numbers of entries
    that differ, parameters that no light has, a reference that is not finite, or a start where
    nothing changes the image. `RuntimeError` where the fit is no success and `throw` is true.

    **Gradient:** none through the search: it stops at every step to report.

    Source: Golub & Pereyra 1973, variable projection; Schoeneman et al. 1993, colours as a
    linear problem; Beaton & Tukey 1974, the weights; Blake & Zisserman 1987, easing down; the
    windows, and the bounds of success, are our own.
    """
    gbuffer = check_gbuffer("lights(gbuffer)", gbuffer)
    check_camera("lights(camera)", camera)
    reference, gbuffer, given = _known(_reference(reference, gbuffer), gbuffer, weights)
    start = _start(lights)
    names, shape = _names(parameters, start), gbuffer.depth.shape
    option("lights(loss=...)", loss, get_args(Loss))
    rounds = whole_number("lights(rounds=...)", rounds)
    max_steps = whole_number("lights(max_steps=...)", max_steps)
    with Bar(progress, "fit") as bar:
        descend_on = partial(descend, solver=solver, max_steps=max_steps, bar=bar)
        model, end, weight, noise = search_in_rounds(
            rounds,
            start,
            lambda given: Model(gbuffer, camera, _entries(given, len(start), shape), names),
            visibilities,
            lambda model, lights: search_once(
                model, lights, reference, given, loss == "robust", descend_on
            ),
        )
    return _fitted(model, end, reference, given, weight, noise, throw)


def _fitted(
    model: Model,
    end: End,
    reference: Array,
    given: Array,
    weight: Array,
    noise: Array,
    throw: bool,
) -> LightsFit:
    """The result at the end of a search: lights, picture, errors and quality."""
    found = end.unknowns
    image, columns = linearized(model, found)
    proof = evidence(model, found, columns, image, reference, given, weight, noise)
    fitted = LightsFit(
        found,
        image,
        jnp.stack(end.losses),
        proof.errors,
        proof.groups,
        proof.untold,
        weight,
        proof.share,
        proof.explained,
        end.result,
    )
    if throw and not fitted.success:
        raise RuntimeError(
            f"`lights` found no lights in {len(end.losses)} steps, the mean squared residual "
            f"going from {end.losses[0]:.3g} to {end.losses[-1]:.3g}: {fitted.doubt} "
            "`throw=False` returns what was reached."
        )
    return fitted


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


def _known(
    reference: Array, gbuffer: GBuffer, weights: Any
) -> tuple[Array, GBuffer, Float[Array, "height width"]]:
    """Both black where nothing is known; and the weights, 0 there."""
    known = (gbuffer.depth > 0) & (gbuffer.depth < jnp.inf) & (gbuffer.shader >= 0)
    given = known.astype(reference.dtype)
    if weights is not None:
        weights = check_depth("lights(weights=...)", weights, gbuffer.depth.shape)
        is_weight = lambda v: (np.isfinite(v) & (v >= 0)).all() and (v > 0).any()
        check("lights(weights=...)", weights, is_weight, "finite, 0 or positive, and not all 0")
        given = given * weights.astype(given.dtype)
    known = given > 0
    shader = jnp.where(known, gbuffer.shader, -1)
    gbuffer = eqx.tree_at(lambda gbuffer: gbuffer.shader, gbuffer, shader)
    return jnp.where(known[..., None], reference, 0), gbuffer, given


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


def _entries(visibilities: Any, count: int, shape: tuple[int, ...]) -> tuple[Any, ...]:
    """The entries of `visibilities`, checked."""
    name = "lights(visibilities=...)"
    given = [None] * count if visibilities is None else visibilities
    entries = items(name, given, "a sequence of entries, or a function")
    if len(entries) != count:
        raise ValueError(
            f"`lights(visibilities=...)` must have an entry for each of {count} lights, "
            f"got {len(entries)}."
        )
    return tuple(
        each if each is None or callable(each) else share(name, each, shape) for each in entries
    )
