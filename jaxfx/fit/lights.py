"""The lights of a photograph, from it and a G-buffer: inverse lighting."""

from collections.abc import Collection, Sequence
from functools import partial
from typing import Any, Literal, final, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Num

from jaxfx._arguments import check_camera, check_gbuffer, check_lights
from jaxfx._arrays import ArrayLike
from jaxfx._checks import (
    WholeNumber,
    check,
    check_depth,
    check_image,
    is_concrete,
    items,
    option,
    share,
    whole_number,
)
from jaxfx._progress import Bar
from jaxfx.camera import OrthographicCamera, PinholeCamera
from jaxfx.fit._descent import End, Solver, check_success, descend
from jaxfx.fit._in_program import fitted_under_transform, joined
from jaxfx.fit._light_errors import evidence, groups, linearized
from jaxfx.fit._light_model import Model, free
from jaxfx.fit._light_search import search_in_rounds, search_once
from jaxfx.gbuffer import GBuffer
from jaxfx.light import Light


LIGHT_PARAMETERS = ("color", "position", "direction", "angles", "light_size")

# What lights must meet to be called a success, both ratios: the least share of the weight that
# counts in the end, and the least contrast that is explained. With a lower first bound a few
# pixels decide; with a lower second one lights are accepted for images that they did not light.
_LEAST_SHARE, _LEAST_EXPLAINED = 0.05, 0.7

Loss = Literal["robust", "squares"]


@final
class LightsFit(eqx.Module):
    """The lights that `lights` found, how sure they are, and how well they explain the image.

    - `lights`: the lights, in the order given; what was not fitted is as it was.
    - `image`: height width 3, the cache under them.
    - `losses`: the mean squared residual, as weighted at the time, at the start of each search
      and after every step, in squared units of radiance, always with the best colors where
      colors are fitted. It jumps where the pixels are reweighted.
    - `standard_errors`: for each light those of the parameters that were fitted, by name, in
      their units: 3 for the color (9 3 for coefficients) and the position, an angle in radians
      for the direction, 2 (inner, outer) for the angles, a scalar for the size. From a
      jackknife: the residuals of 8 x 8 tiles of the image are taken for independent of one
      another, and no others. Never less than what noise of a thousandth of the image's root
      mean square would make; inf where the image does not depend on the parameter. Other minima
      are not in it, nor that a shadow map knows edges to a texel.
    - `alike`: booleans of shape light light: which lights, by their indices, the image can't
      tell apart: it stays the same, to a thousandth of what each change alone would do, when
      the parameters of both change together; or they are of one kind, and their positions and
      directions differ by less than three stated errors. Of colors that fit equally well these
      are the smallest. The parameters that take part in the change, and the colors of lights
      that lie so close, have an error of inf.
    - `unsure`: for each light, by the name of its parameters, a scalar boolean: whether the
      error is too large to call it determined.
    - `weights`: height width, how much the square of each pixel's difference counted in the
      end.
    - `share`: the share of the given weight, a ratio, that counted in the end, of pixels that
      lights reach.
    - `explained`: the share of the image's contrast, a ratio, that is explained: 1 leaves no
      difference, 0 is no better than an even image.
    - `result`: optimistix' verdict on the last search, one of its `RESULTS`; it prints as a
      sentence.
    """

    lights: tuple[Light, ...]
    image: Float[Array, "height width 3"]
    losses: Float[Array, " steps"]
    standard_errors: tuple[dict[str, Float[Array, "..."]], ...]
    alike: Bool[Array, "light light"]
    unsure: tuple[dict[str, Bool[Array, ""]], ...]
    weights: Float[Array, "height width"]
    share: Float[Array, ""]
    explained: Float[Array, ""]
    result: optx.RESULTS

    @property
    def indistinct(self) -> tuple[tuple[int, ...], ...]:
        """Groups of lights that are `alike`, by their indices."""
        return groups(self.alike)

    @property
    def untold(self) -> tuple[tuple[int, str], ...]:
        """The parameters that are `unsure`, as the index of their light and their name."""
        return tuple(
            (index, name)
            for index, own in enumerate(self.unsure)
            for name in own
            if bool(own[name])
        )

    @property
    def doubt(self) -> str:
        """Why the lights are not to be trusted, as a sentence; empty for a success."""
        if self.result != optx.RESULTS.successful:
            return str(self.result)
        if not self.share >= _LEAST_SHARE:
            return f"Only {100 * float(self.share):.0f} % of the pixels count."
        if not self.explained >= _LEAST_EXPLAINED:
            return f"Only {100 * float(self.explained):.0f} % of the contrast is explained."
        if self.indistinct:
            groups = ["lights " + " and ".join(map(str, group)) for group in self.indistinct]
            return f"The image can't tell apart {'; '.join(groups)}."
        if self.untold:
            names = [f"the {name} of light {index}" for index, name in self.untold]
            return f"The image does not determine {', '.join(names)}."
        return ""

    @property
    def success(self) -> bool:
        """Whether the solver converged to lights that the image determines."""
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
    """The lights of a photograph, from it and a G-buffer of the scene: inverse lighting.

    Finds colors, positions, directions and cones from a start that is near. `success` and
    `doubt` of the result say whether the image determines them.

    **Arguments:**

    - `reference`: height width 3, linear radiance.
    - `gbuffer`, `camera`: as in `relight.shade`. Where the depth is missing or inf, or the
      shader is -1, a pixel does not count.
    - `lights`: their number and kinds, and where the search starts; colors matter only if they
      are not fitted.
    - `visibilities`: shadows, one entry per light: None; height width in [0, 1], held fixed; or
      a differentiable function from the light to that, a `shadow.MovingShadow` say. Or, for
      shadows that are computed in each round, a function of the lights (those found so far) and
      of the round (0, 1, ...) to such entries.
    - `weights`: height width, no unit: how much the square of each pixel's difference counts,
      besides; 0 leaves a pixel out.
    - `loss`: `"robust"`, or `"squares"`, where pixels count as given: what `robust` takes for
      wrong, the edge of a shadow say, may be all that tells where a light is.
    - `rounds`: how often to search, each time from where the last ended.
    - `solver`: any least-squares solver or minimiser of optimistix. By default
      Levenberg-Marquardt, which has also converged where six steps gain next to nothing.
    - `parameters`: the names to fit, out of `fit.LIGHT_PARAMETERS`; the others stay as given.
      The coefficients of a `SphericalHarmonicsLight` are its colors.
    - `max_steps`: of the solver, each time it starts.
    - `throw`: raise where the fit is no success; else `doubt` says why.
    - `progress`: show a bar on stderr; it needs the extra `plot`.

    **Returns:** a `LightsFit`.

    **Raises:** `ValueError` for what `relight.shade` refuses, for shapes or numbers of entries
    that differ, parameters that no light has, a reference that is not finite, or a start where
    nothing changes the image. `RuntimeError` where the fit is no success and `throw` is true.

    **Gradient:** none through the search: it stops at every step to report. Under `jit` and
    `vmap` it is a part of the program, of a batch one after the other on the device where each
    member lies; `throw` and `progress` must then be false. NaN fills up `losses`.
    What a function of `visibilities` needs it must hold as a pytree.

    **Example:** the color of a sun.

    >>> import numpy as np
    >>> from jaxfx import DirectionalLight, GBuffer, PinholeCamera, fit, relight
    >>> white, normal = np.ones((12, 12, 3)), np.random.default_rng(0).normal(size=(12, 12, 3))
    >>> normal[..., 2] = -2
    >>> flat = {"depth": np.full((12, 12), 2.0), "roughness": np.ones((12, 12))}
    >>> colors = {"color": white, "diffuse": white, "specular": 0 * white, "ambient": white}
    >>> shader = np.zeros((12, 12), int)
    >>> gbuffer = GBuffer(shader=shader, normal=normal, **flat, **colors)
    >>> camera = PinholeCamera.from_fov(1.0, height=12, width=12)
    >>> photograph = relight.shade(gbuffer, camera, DirectionalLight([0, 0, 1], [3, 2, 1]))
    >>> start = [DirectionalLight([0, 0, 1], [1, 1, 1])]
    >>> fitted = fit.lights(photograph, gbuffer, camera, start, parameters=["color"])
    >>> [round(value, 3) for value in fitted.lights[0].color.tolist()]
    [3.0, 2.0, 1.0]

    The fit is by weighted least squares. The image is linear in the colors: for given
    positions, directions and angles the best ones are solved for, and only the rest is searched
    (variable projection). Then pixels are reweighted by their residuals, and so on: shadows
    that the model lacks, clipped highlights and unknown materials come to count for nothing.
    The weight of a pixel is the product of Tukey's biweights of two residuals, its own and the
    sum over 5 x 5 pixels about it. Each is in units of its noise, which is estimated by
    medians, and eased down by halves from the largest residual at the start. Huber's loss would
    not do: a shadow only takes light away, and its pull stays.

    Directions move on the sphere; the angles of a cone are kept in order by logistic functions.
    A negative color says that the model does not fit. The search finds the nearest minimum. A
    parameter that changes nothing at the start, the position of a light that reaches nothing
    say, stays, and the log says so.

    Source: Golub & Pereyra 1973, variable projection; Schoeneman et al. 1993, colors as a
    linear problem; Beaton & Tukey 1974, the weights; Blake & Zisserman 1987, easing down; the
    windows, and the bounds of success, are our own.
    """
    gbuffer = check_gbuffer("lights(gbuffer)", gbuffer)
    check_camera("lights(camera)", camera)
    reference, gbuffer, base_weight = _masked(_reference(reference, gbuffer), gbuffer, weights)
    start = _start(lights)
    names, shape = _names(parameters, start), gbuffer.depth.shape
    option("lights(loss=...)", loss, get_args(Loss))
    rounds = whole_number("lights(rounds=...)", rounds)
    max_steps = whole_number("lights(max_steps=...)", max_steps)

    def fitted_to(data: Any, bar: Bar) -> LightsFit:
        start, reference, gbuffer, camera, base_weight, visibilities = data
        descend_on = partial(descend, solver=solver, max_steps=max_steps, bar=bar)
        model, end, weight, noise = search_in_rounds(
            rounds,
            start,
            lambda entries: Model(gbuffer, camera, _entries(entries, len(start), shape), names),
            visibilities,
            lambda model, lights: search_once(
                model, lights, reference, base_weight, loss == "robust", descend_on
            ),
        )
        return _fitted(model, end, reference, base_weight, weight, noise)

    data = start, reference, gbuffer, camera, base_weight, visibilities
    if not is_concrete(data):
        quiet = partial(fitted_to, bar=Bar(False, "fit"))
        return fitted_under_transform(quiet, data, "lights", throw, progress, solver)
    with Bar(progress, "fit") as bar:
        fitted = fitted_to(data, bar)
    if throw:
        check_success(fitted, "lights", "lights")
    return fitted


def _fitted(
    model: Model, end: End, reference: Array, base_weight: Array, weight: Array, noise: Array
) -> LightsFit:
    """The result at the end of a search: lights, image, errors and quality."""
    lights = end.unknowns
    image, columns = linearized(model, lights)
    quality = evidence(model, lights, columns, image, reference, base_weight, weight, noise)
    return LightsFit(
        lights=lights,
        image=image,
        losses=joined(end.losses),
        weights=weight,
        result=end.result,
        **quality._asdict(),
    )


def _reference(reference: Any, gbuffer: Any) -> Float[Array, "height width 3"]:
    """The photograph, checked, in the type of the cache."""
    reference = check_image("lights(reference)", reference)
    if reference.shape != gbuffer.color.shape:
        raise ValueError(
            f"`lights(reference)` must have the cache's shape {gbuffer.color.shape}, "
            f"got {reference.shape}."
        )
    check("lights(reference)", reference, np.isfinite, "finite")
    return reference.astype(gbuffer.color.dtype)


def _masked(
    reference: Array, gbuffer: GBuffer, weights: Any
) -> tuple[Array, GBuffer, Float[Array, "height width"]]:
    """Reference and cache, black where the cache shows no surface; the weights, 0 there."""
    is_shown = (gbuffer.depth > 0) & (gbuffer.depth < jnp.inf) & (gbuffer.shader >= 0)
    base_weight = is_shown.astype(reference.dtype)
    if weights is not None:
        weights = check_depth("lights(weights=...)", weights, gbuffer.depth.shape)
        is_weight = lambda v: (np.isfinite(v) & (v >= 0)).all() and (v > 0).any()
        check("lights(weights=...)", weights, is_weight, "finite, 0 or positive, and not all 0")
        base_weight = base_weight * weights.astype(base_weight.dtype)
    counts = base_weight > 0
    shader = jnp.where(counts, gbuffer.shader, -1)
    gbuffer = eqx.tree_at(lambda gbuffer: gbuffer.shader, gbuffer, shader)
    return jnp.where(counts[..., None], reference, 0), gbuffer, base_weight


def _start(lights: Any) -> tuple[Light, ...]:
    """The lights, checked, in JAX's default type, which is that of a solver's unknowns."""
    lights = check_lights("lights(lights)", lights)
    if not lights:
        raise ValueError("`lights(lights)` must be a sequence of lights, got none.")
    return jax.tree.map(lambda leaf: leaf.astype(float), lights)


def _names(parameters: Collection[str], lights: tuple[Light, ...]) -> tuple[str, ...]:
    """The parameters to fit, checked, in the order of `LIGHT_PARAMETERS`."""
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
    entries = [None] * count if visibilities is None else visibilities
    entries = items(name, entries, "a sequence of entries, or a function")
    if len(entries) != count:
        raise ValueError(
            f"`lights(visibilities=...)` must have an entry for each of {count} lights, "
            f"got {len(entries)}."
        )
    is_image = lambda entry: entry is not None and not callable(entry)
    return tuple(share(name, entry, shape) if is_image(entry) else entry for entry in entries)
