"""The lens of photographs with depth of field."""

import functools
import math
from collections.abc import Collection, Sequence
from typing import Literal, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, is_concrete, number, whole_number
from jaxfx._progress import Bar
from jaxfx.dof.iris import Iris, check_iris
from jaxfx.fit import _circle_error, _lens_arguments as read
from jaxfx.fit._descent import End, Solver, check_success, descend
from jaxfx.fit._in_program import fitted_under_transform, joined
from jaxfx.fit._jackknife import covariance, tiles
from jaxfx.fit._lens_model import DISPARITY, IRIS, LENS, Effect, Model, Values
from jaxfx.fit._lens_noise import defocus
from jaxfx.fit._lens_residual import Report, Residual, Tone, plain, report
from jaxfx.fit._lens_search import Search
from jaxfx.lens import ThinLens


PARAMETERS, LAYERED_PARAMETERS = read.PARAMETERS.values()
DISPARITY_PARAMETERS = DISPARITY

# What a lens must meet to be called a success: the largest standard error, as a ratio to the
# parameter, and the least ratio of contrast that is explained. Looser bounds trust lenses that
# the images do not determine, tighter ones doubt more fits of noisy or nearly sharp images.
_MOST_ERROR, _LEAST_EXPLAINED = 0.5, 0.5


@final
class DofFit(eqx.Module):
    """The lenses and the other parameters that `dof` found, and how sure they are.

    - `lenses`: one for each photograph, lengths in scene units.
    - `gamma`, `epsilon`, `threshold`, `scale`, `shift`: the other parameters: a number, pixels
      twice, a ratio and inverse scene units. Parameters that were not sought, those of the
      other effect among them, are as given.
    - `footprint`: a ratio: how far small circles of confusion blur as discs do, which the
      sprites of the effect do not: 0 in images made by the effect, near 1 in others.
    - `gain`, `offset`: photograph channel, a ratio and units of radiance.
    - `images`: photograph height width channel: the images that the effect draws with the
      parameters, before footprint, gain and offset.
    - `losses`: the mean squared residual at the start and after every step, in squared units
      of radiance; it jumps where the search goes on with other lenses, sizes or weights.
    - `ends`: where the searches on small images ended, the best first: the parameters, in
      their units, and the `"loss"` of each.
    - `standard_errors`: by the name of each fitted parameter, in its unit; one for each
      photograph where it differs between them. From a jackknife: the residuals of 8 x 8 tiles
      of the image are taken for independent of one another, and no others. With
      `loss="robust"` those of lenses, `scale`, `shift` and the iris allow for what an effect
      draws wrong: circles of confusion that are off by 5 % and 0.28 pixels, alike for all
      pixels of about the same defocus. A parameter that the images do not determine has a
      large one, or inf.
    - `explained`: the share of the references' contrast, a ratio, that is explained in the
      pixels that count, times the share of those.
    - `clamped`: the share of pixels, a ratio, whose circle of confusion in the fitted lens is
      larger than `max_coc`. Above 0, the fit may be biased: repeat it with a larger `max_coc`,
      unless those pixels are an even background.
    - `iris`: the shape with the numbers found; None where none was given.
    - `result`: optimistix' verdict, one of its `RESULTS`; it prints as a sentence.
    """

    lenses: tuple[ThinLens, ...]
    gamma: Float[Array, ""]
    epsilon: Float[Array, ""]
    threshold: Float[Array, ""]
    scale: Float[Array, ""]
    shift: Float[Array, ""]
    footprint: Float[Array, ""]
    gain: Float[Array, "photograph channel"]
    offset: Float[Array, "photograph channel"]
    images: Float[Array, "photograph height width channel"]
    losses: Float[Array, " steps"]
    ends: tuple[dict[str, Array], ...]
    standard_errors: dict[str, Float[Array, "*photograph"]]
    explained: Float[Array, ""]
    clamped: Float[Array, ""]
    iris: Iris | None
    result: optx.RESULTS

    @property
    def lens(self) -> ThinLens:
        """The lens of the first photograph."""
        return self.lenses[0]

    @property
    def image(self) -> Float[Array, "height width channel"]:
        """The first of the images, height width channel."""
        return self.images[0]

    @property
    def untold(self) -> tuple[str, ...]:
        """The fitted parameters whose standard error is half of them or more."""
        return tuple(
            name for name, error in self.standard_errors.items() if not self._tells(name)
        )

    def _tells(self, name: str) -> bool:
        error = np.asarray(self.standard_errors[name], float)
        if name == "shift":  # It may well be 0: beside the inverse focus distance.
            distances = [np.asarray(lens.focus_distance, float) for lens in self.lenses]
            size = 1 / np.min(distances)
        elif name == "rotation":  # It may be 0 too: beside the angle between blades.
            size = 2 * math.pi / self.iris.blades if self.iris else 0.0
        elif name == "squeeze":
            size = np.asarray(self.iris.squeeze, float) if self.iris else 0.0
        elif name in LENS:
            size = np.array([np.asarray(getattr(lens, name), float) for lens in self.lenses])
        else:
            size = np.asarray(getattr(self, name), float)
        return bool((error < _MOST_ERROR * size).all())

    @property
    def doubt(self) -> str:
        """Why the fit is not to be trusted, as a sentence; empty for a success."""
        if self.result != optx.RESULTS.successful:
            return str(self.result)
        if not self.explained > _LEAST_EXPLAINED:
            return f"Only {100 * float(self.explained):.0f} % of the contrast is explained."
        untold = [name for name in self.untold if name in LENS + DISPARITY + IRIS]
        if untold:
            return f"The images do not determine {' and '.join(untold)}."
        return ""

    @property
    def success(self) -> bool:
        """Whether the solver converged to a lens that the images determine."""
        return not self.doubt


def dof(
    reference: Float[ArrayLike, "height width channel"]
    | Sequence[Float[ArrayLike, "height width channel"]],
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    lens: ThinLens | Sequence[ThinLens],
    *,
    gamma: Float[ArrayLike, ""] | float = 1.0,
    epsilon: Float[ArrayLike, ""] | float = 2.0,
    effect: Effect = "scatter",
    threshold: Float[ArrayLike, ""] | float = 2.0,
    behind: tuple[Float[ArrayLike, "height width channel"], Num[ArrayLike, "height width"]]
    | Literal["peel"]
    | None = None,
    iris: Iris | None = None,
    max_coc: Number | None = None,
    weights: Num[ArrayLike, "height width"] | None = None,
    loss: read.Loss = "robust",
    tone: Tone = "linear",
    exposure: read.Exposure = "equal",
    solver: Solver | None = None,
    parameters: Collection[str] | None = None,
    ratios: Collection[str] = (),
    max_steps: WholeNumber = 64,
    throw: bool = True,
    progress: bool = False,
) -> DofFit:
    """The lens that took a photograph, from an image without blur and its depth.

    Finds aperture and focus distance, and the parameters of `dof.scatter` or `dof.layered` that
    make the effect look most like the photograph. To measure a lens use `effect="layered"`;
    scatter takes slanted surfaces for flat ones and finds too small an aperture there.

    **Arguments:**

    - `reference`: height width channel, linear radiance: a photograph or a multi-pass image;
      or a list of several of one scene.
    - `image`, `depth`: height width channel and height width, as in the effect.
    - `lens`: where the search starts, lengths in scene units, one for each photograph;
      `focal_pixels` is never fitted.
    - `gamma`, `epsilon`, `threshold`: where the search starts, a number and pixels twice.
    - `effect`: the function of `jaxfx.dof` whose parameters are sought.
    - `behind`: the second layer of `"layered"`, as there a pair of shapes height width channel
      and height width; nothing is guessed behind it. `"peel"` guesses it, for each lens that is
      tried; None fits through a single layer. To draw what was fitted, give `dof.layered` the
      same, a pair as `[pair, None]`.
    - `iris`: the shape of the lens, where the search starts; by default the disc. `parameters`
      may then name its `rotation` (unless it is a disc) and `squeeze`, which start within a
      quarter of the angle between blades and at less than 1. Its roundness is never fitted.
    - `max_coc`: static; the largest diameter that may be drawn, in pixels; None for any. If
      given, it decides how small the images of the first searches are, else the start does.
      Give one where an even background, far from the focus, has by far the largest circles:
      they show nothing, and take most of the time.
    - `weights`: height width, no unit: how much the square of each pixel's difference counts;
      0 leaves a pixel out.
    - `loss`: `"robust"`, or `"squares"` for images that the effect itself made: all pixels
      alike, the footprint is held at 0, and the standard errors are those of noise alone.
    - `tone`: `"linear"`, or `"log"` for what is far above the reference's mean.
    - `exposure`: `"equal"`, or `"free"`: gain and offset, by channel, are those that fit best.
    - `solver`: any least-squares solver or minimiser of optimistix. By default
      Levenberg-Marquardt, which has also converged where its steps gain next to nothing. On
      images with a side of more than 112 pixels it computes derivatives once in four
      evaluations, and corrects them by what the others show (Broyden 1965).
    - `parameters`: the names to fit. By default those of the effect, `fit.PARAMETERS`
      (aperture, focus_distance, gamma, epsilon) or `fit.LAYERED_PARAMETERS` (aperture,
      focus_distance, threshold). With either also `fit.DISPARITY_PARAMETERS`, scale and shift:
      the inverse depth is then `scale / depth + shift`. One photograph determines two of
      aperture, focus_distance, scale and shift; of three or four the standard errors are inf.
    - `ratios`: those of the lenses' parameters whose ratios are known to be the starts'.
    - `max_steps`: of the solver, each time it starts.
    - `throw`: raise where the fit is no success; else `doubt` says why.
    - `progress`: show a bar on stderr; it needs the extra `plot`.

    **Returns:** a `DofFit`.

    **Raises:** `ValueError` for what the effect refuses, shapes that differ, an unknown or
    empty choice of parameters, a start that can't move (a zero aperture; all circles of
    confusion below a pixel or above `max_coc`), or an image that is not finite.
    `RuntimeError` where the fit is no success and `throw` is true.

    **Gradient:** none through the search: it stops at every step to report. Under `jit` and
    `vmap` it is a part of the program, of a batch one after the other on the device where each
    member lies; `throw` and `progress` must then be false, and `max_coc` be given.
    NaN then fills up `losses`.

    **Example:** the aperture of a blurred image.

    >>> import numpy as np
    >>> from jaxfx import ThinLens, dof, fit
    >>> image = np.random.default_rng(0).random((12, 12, 1)).astype(np.float32)
    >>> depth = np.broadcast_to(np.linspace(2, 4, 12, dtype=np.float32), (12, 12))
    >>> photograph = dof.scatter(image, depth, ThinLens(0.2, 3.0, 40.0), max_coc=4)
    >>> start, names = ThinLens(0.25, 3.0, 40.0), ["aperture"]
    >>> options = {"parameters": names, "max_coc": 4, "max_steps": 8, "loss": "squares"}
    >>> fitted = fit.dof(photograph, image, depth, start, **options)
    >>> round(float(fitted.lens.aperture), 2)
    0.2

    Photographs show what one image does not hold: surfaces that near ones hide, and highlights.
    So the loss is Huber's, and pixels that a sprite from an edge in depth or of the frame
    reaches have a noise of their own, which is estimated beside that of the others. A pixel
    that differs by twenty standard deviations is left out, and so is one where the photograph
    is saturated: where a channel has its own largest value, with seven others at least. First,
    lenses of half to twice the aperture and 0.7 to 1.4 times the focus distance are compared on
    images of at most 112 pixels a side. From the best two, and from half and twice the epsilon
    or the threshold, a search goes on there. The best end is searched from again with no
    footprint and with that of a photograph, and the better of both is refined on the images as
    given.

    Source: Huber 1964, the loss; Golub & Pereyra 1973, exposure by variable projection. The
    noise near edges, the footprint and the lenses that are compared are our own.
    """
    peels = read.peels(behind)
    known = None if peels else behind
    images, lenses = read.images(reference, image, depth, lens, known, weights)
    read.options(effect=effect, loss=loss, tone=tone, exposure=exposure)
    max_steps = whole_number("dof(max_steps=...)", max_steps)
    iris = None if iris is None else check_iris("dof(iris=...)", iris)
    start = read.start(lenses, iris, gamma, epsilon, threshold, images.image.dtype)
    names = read.names(effect, parameters, iris)
    if max_coc is not None:
        is_diameter = lambda x: 0 < x < math.inf
        max_coc = number("dof(max_coc=...)", max_coc, is_diameter, "positive and finite")
    is_traced = not is_concrete(images, start, iris)
    if is_traced:
        read.check_given(max_coc)
    else:
        read.check_moves(names, lenses, images, max_coc)
    is_robust, is_free = loss == "robust", exposure == "free"
    if is_robust:
        images = read.without_saturated(images)
    # The footprint knows what the sprites of discs lack.
    if is_robust and iris is None and {*LENS, *DISPARITY}.intersection(names):
        names = (*names, "footprint")
    model = Model(images, start, jnp.zeros(()), iris, names, effect, 1.0, peels)
    ratios = read.ratios(ratios)

    def fitted_to(model: Model, bar: Bar) -> DofFit:
        solve = functools.partial(descend, solver=solver, max_steps=max_steps, bar=bar)
        residual = functools.partial(plain, exposure=is_free, tone=tone)
        return _fitted(*Search(residual, solve, is_robust, max_coc, ratios).run(model))

    if is_traced:
        quiet = functools.partial(fitted_to, bar=Bar(False, "fit"))
        return fitted_under_transform(quiet, model, "dof", throw, progress, solver)
    with Bar(progress, "fit") as bar:
        fitted = fitted_to(model, bar)
    if throw:
        check_success(fitted, "dof", "lens")
    return fitted


def _fitted(residual: Residual, end: End, ends: tuple[dict[str, Array], ...]) -> DofFit:
    """The result at the end of a search: parameters, images and standard errors."""
    model = residual.model
    values = model.values(end.unknowns)
    reported = report(residual, end.unknowns)
    variances = _variances(residual, end.unknowns, reported)
    ones = jax.tree.map(jnp.ones_like, end.unknowns)
    slopes = jax.jvp(model.values, (end.unknowns,), (ones,))[1]
    references = model.images.references
    is_single = len(references) == 1
    # A photograph tells two numbers: aperture x scale, and aperture x (1 / focus - shift).
    sought = [name for name in (*LENS, *DISPARITY) if name in end.unknowns]
    if sum(jnp.size(end.unknowns[name]) for name in sought) > 2 * len(references):
        variances |= {name: jnp.full_like(variances[name], jnp.inf) for name in sought}
    standard_errors = {}
    for name in (name for name in model.names if name != "footprint"):
        error = jnp.abs(slopes[name].astype(float)) * jnp.sqrt(variances[name])
        standard_errors[name] = error[0] if is_single and name in LENS else error
    mean = jnp.mean(references, axis=(1, 2), keepdims=True)
    contrast = jnp.mean(residual.weighted(references - mean) ** 2)
    unexplained = jnp.mean(reported.residual**2)
    share = jnp.mean(jnp.isfinite(residual.scale).astype(contrast.dtype))
    names = ("gamma", "epsilon", "threshold", "scale", "shift", "footprint")
    return DofFit(
        lenses=tuple(model.lens(values, photograph) for photograph in range(len(references))),
        gain=reported.compared.gain,
        offset=reported.compared.offset,
        images=reported.compared.drawn,
        losses=joined(end.losses),
        ends=ends,
        standard_errors=standard_errors,
        explained=jnp.where(contrast > 0, 1 - unexplained / contrast, 1) * share,
        clamped=jnp.mean(model.circles(values) > model.max_coc),
        iris=model.shape(values),
        result=end.result,
        **{name: values[name] for name in names},
    )


def _variances(residual: Residual, unknowns: Values, reported: Report) -> Values:
    """The variance of each unknown, by leaving out tiles, and by what an effect draws wrong.

    What an effect draws wrong biases a lens and a depth, which have true values. It biases
    `gamma`, `epsilon` and `threshold` by nothing: those are what makes the effect look most
    like the photograph, and have no others.
    """
    columns, rest, tree = reported.columns, reported.residual, ravel_pytree(unknowns)[1]
    tile, count = tiles(rest.shape[1:])
    tile = jnp.tile(tile, rest.shape[0])
    variances = tree(jnp.diagonal(covariance(columns, rest.reshape(-1), tile, count)))
    if residual.is_robust:
        model = residual.model
        signed = defocus(model, model.values(unknowns)).astype(columns.dtype)
        bias = tree(_circle_error.variances(columns, reported.widening, signed))
        for name in {*LENS, *DISPARITY, *IRIS}.intersection(variances):
            variances[name] = variances[name] + bias[name]
    return variances
