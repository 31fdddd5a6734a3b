"""The lens and the amplifications of pictures with depth of field."""

import functools
import math
from collections.abc import Collection, Sequence
from typing import Literal, final, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Num

from jaxfx._checks import (
    Number,
    WholeNumber,
    number,
    option,
    whole_number,
)
from jaxfx._progress import Bar
from jaxfx.fit import _lens_arguments as _arguments
from jaxfx.fit._descent import End, Solver, covariance, descend, tiles
from jaxfx.fit._lens import (
    BINS,
    DISPARITY,
    LENS,
    Method,
    Model,
    Residual,
    Tone,
    evaluate,
    plain,
    report,
    strata,
)
from jaxfx.fit._lens_search import Search
from jaxfx.lens import ThinLens


PARAMETERS, LAYERED_PARAMETERS = _arguments.PARAMETERS.values()
DISPARITY_PARAMETERS = DISPARITY

# A lens is told if its parameters' standard errors are below this share of them, and if so much
# of the contrast is explained.
_MOST_ERROR, _LEAST_EXPLAINED = 0.5, 0.5

Loss = Literal["robust", "squares"]
Exposure = Literal["free", "equal"]


@final
class DofFit(eqx.Module):
    """What `dof` found.

    - `lenses`: one for each picture, lengths in scene units.
    - `gamma`, `epsilon`, `threshold`, `scale`, `shift`: the other parameters: a number, pixels
      twice, a ratio and inverse scene units. Frozen ones, and those of the other method, are
      as they were given.
    - `footprint`: a ratio: how far small circles of confusion blur as discs do, which the
      sprites of the method do not: 0 in pictures made by the method, near 1 in others.
    - `gain`, `offset`: picture channel, a ratio and units of radiance.
    - `images`: picture height width channel: what the method draws with all that but gain and
      offset.
    - `losses`: the mean squared residual at the start and after every step, in squared units
      of radiance; it jumps where the search goes on with other lenses, sizes or weights.
    - `ends`: where the searches on small pictures ended, the best first: the parameters and
      the `"loss"` of each.
    - `uncertainty`: a standard error for each fitted parameter, in its own unit, one for each
      picture where the parameter has one. It takes the residuals of 8 x 8 tiles of the image
      for independent of one another, and no others. A parameter that the pictures do not tell
      has a large one, or inf.
    - `explained`: the share of the references' contrast, a ratio, that is explained.
    - `clamped`: the share of pixels, a ratio, whose circle of confusion in the fitted lens is
      larger than `max_coc`. Above 0, the fit may be biased: repeat it with a larger `max_coc`.
    - `result`: optimistix' verdict, one of its `RESULTS`; it prints as a sentence.
    """

    lenses: tuple[ThinLens, ...]
    gamma: Float[Array, ""]
    epsilon: Float[Array, ""]
    threshold: Float[Array, ""]
    scale: Float[Array, ""]
    shift: Float[Array, ""]
    footprint: Float[Array, ""]
    gain: Float[Array, "picture channel"]
    offset: Float[Array, "picture channel"]
    images: Float[Array, "picture height width channel"]
    losses: Float[Array, " steps"]
    ends: tuple[dict[str, Array], ...]
    uncertainty: dict[str, Float[Array, "*picture"]]
    explained: Float[Array, ""]
    clamped: Float[Array, ""]
    result: optx.RESULTS

    @property
    def lens(self) -> ThinLens:
        """The lens of the first picture."""
        return self.lenses[0]

    @property
    def image(self) -> Float[Array, "height width channel"]:
        """The first picture."""
        return self.images[0]

    @property
    def untold(self) -> tuple[str, ...]:
        """The fitted parameters whose standard error is half of them or more."""
        return tuple(name for name, error in self.uncertainty.items() if not self._tells(name))

    def _tells(self, name: str) -> bool:
        error = np.asarray(self.uncertainty[name], float)
        if name == "shift":  # Beside the inverse depths, it may well be 0.
            distances = [np.asarray(lens.focus_distance, float) for lens in self.lenses]
            size = 1 / np.min(distances)
        elif name in LENS:
            size = np.array([np.asarray(getattr(lens, name), float) for lens in self.lenses])
        else:
            size = np.asarray(getattr(self, name), float)
        return bool((error < _MOST_ERROR * size).all())

    @property
    def doubt(self) -> str:
        """Why the fit is not to be trusted, as a sentence; empty where it is."""
        if self.result != optx.RESULTS.successful:
            return str(self.result)
        if not self.explained > _LEAST_EXPLAINED:
            return f"Only {100 * float(self.explained):.0f} % of the contrast is explained."
        untold = [name for name in self.untold if name in LENS + DISPARITY]
        if untold:
            return f"The pictures do not tell {' and '.join(untold)}."
        return ""

    @property
    def success(self) -> bool:
        """Whether the solver converged, to a lens that the pictures tell."""
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
    method: Method = "scatter",
    threshold: Float[ArrayLike, ""] | float = 2.0,
    behind: tuple[Float[ArrayLike, "height width channel"], Num[ArrayLike, "height width"]]
    | None = None,
    max_coc: Number | None = None,
    weights: Num[ArrayLike, "height width"] | None = None,
    loss: Loss = "robust",
    tone: Tone = "linear",
    exposure: Exposure = "equal",
    solver: Solver | None = None,
    parameters: Collection[str] | None = None,
    ratios: Collection[str] = (),
    max_steps: WholeNumber = 64,
    throw: bool = True,
    progress: bool = False,
) -> DofFit:
    """The lens and the other parameters that make a method look most like a photograph.

    Photographs show what one image does not hold: surfaces that near ones hide, and highlights.
    So the loss is Huber's, and pixels that a sprite from an edge in depth reaches count by the
    noise that they have, which is estimated apart from that of all others.

    First, lenses of half to twice the aperture and 0.7 to 1.4 times the focus distance are
    tried on pictures of at most 160 pixels a side. From the best two, and of `"scatter"` from
    half and twice the epsilon, a search goes on there; the best end is refined on the pictures
    as given.

    **Arguments:**

    - `reference`: height width channel, linear radiance: a photograph or a multi-pass picture;
      or several of one scene.
    - `image`, `depth`: height width channel and height width, as in the method.
    - `lens`: where the search starts, lengths in scene units, one for each picture;
      `focal_pixels` is never fitted.
    - `gamma`, `epsilon`: where the search starts, no unit and pixels; of `"scatter"`.
    - `method`: the one of `jaxfx.dof` whose parameters are sought.
    - `threshold`, `behind`: where the search starts, in pixels, and the second layer, as in
      `dof.layered`; of `"layered"`.
    - `max_coc`: static; the largest diameter, in pixels, that the search may draw. By default
      a quarter more than the largest so far, and larger wherever that proves too small.
    - `weights`: height width, no unit: how much the square of each pixel's difference counts;
      0 leaves a pixel out.
    - `loss`: `"robust"`, or `"squares"`: all pixels alike, and the footprint is held at 0.
    - `tone`: `"linear"`, or `"log"`: radiances are compared by their logarithms, far above
      the reference's mean, and as they are far below.
    - `exposure`: `"equal"`, or `"free"` where gain and offset of each channel and picture are
      those that fit best.
    - `solver`: any least-squares solver or minimiser of optimistix. By default
      Levenberg-Marquardt, which has also converged where its steps gain next to nothing.
    - `parameters`: the names to fit, out of `fit.PARAMETERS` or, of `"layered"`, out of
      `fit.LAYERED_PARAMETERS`, and of `fit.DISPARITY_PARAMETERS`: the inverse depth is
      `scale` times the given one plus `shift`. The others stay as given. By default all but
      scale and shift: with a lens that is free too, one picture does not tell them.
    - `ratios`: those of the lens's parameters whose ratios between the pictures are known to
      be the starts'.
    - `max_steps`: of the solver, each time it starts.
    - `throw`: raise where the fit is no success; else `doubt` says why.
    - `progress`: show a bar on stderr; it needs the extra `plot`.

    **Returns:** a `DofFit`.

    **Raises:** `ValueError` for what the method refuses, for shapes that differ, an unknown
    or empty choice of parameters, a lens to start from that can't move (a zero aperture; all
    circles of confusion below a pixel or above `max_coc`), or a picture that is not finite.
    `RuntimeError` where the fit is no success and `throw` is true.

    **Gradient:** none through the search: it stops at every step to report.

    Source: Huber 1964, the loss; Golub & Pereyra 1973, exposure by variable projection. The
    noise near edges, the footprint and the lenses that are tried are our own.
    """
    pictures, lenses = _arguments.read_pictures(reference, image, depth, lens, behind, weights)
    option("dof(method=...)", method, get_args(Method))
    option("dof(loss=...)", loss, get_args(Loss))
    option("dof(tone=...)", tone, get_args(Tone))
    option("dof(exposure=...)", exposure, get_args(Exposure))
    start = _arguments.read_start(lenses, gamma, epsilon, threshold, pictures.image.dtype)
    names = _arguments.read_names(method, parameters)
    ratios = _arguments.read_ratios(ratios)
    max_steps = whole_number("dof(max_steps=...)", max_steps)
    if max_coc is not None:
        max_coc = number("dof(max_coc=...)", max_coc, lambda x: 0 < x < math.inf)
    _arguments.check_moves(names, lenses, pictures, max_coc)
    corrects = loss == "robust" and set(LENS + DISPARITY).intersection(names)
    searched = (*names, "footprint") if corrects else names
    model = Model(pictures, start, jnp.zeros(()), searched, method, 1.0)
    make = lambda model: plain(model, exposure == "free", tone)
    with Bar(progress, "fit") as bar:
        solve = functools.partial(descend, solver=solver, max_steps=max_steps, bar=bar)
        search = Search(make, solve, loss == "robust", max_coc, ratios)
        residual, end, ends = search.run(model)
    fitted = _fitted(residual, end, ends)
    if throw and not fitted.success:
        raise RuntimeError(
            f"`dof` found no lens in {len(end.losses)} steps, the mean squared residual going "
            f"from {end.losses[0]:.3g} to {end.losses[-1]:.3g}: {fitted.doubt} "
            "`throw=False` returns what was reached."
        )
    return fitted


def _fitted(residual: Residual, end: End, ends: tuple[dict[str, Array], ...]) -> DofFit:
    """The result at the end of a search: parameters, pictures and standard errors."""
    model = residual.model
    values = model.values(end.unknowns)
    columns, rest, drawn, gain, offset = report(residual, end.unknowns)
    block, count = tiles(rest.shape[1:])
    block = jnp.tile(block, rest.shape[0])
    spread = covariance(columns, rest.reshape(-1), block, count)
    if residual.is_robust:
        alike = strata(model.circles(values), residual.scale, rest.shape[3])
        spread = spread + covariance(columns, rest.reshape(-1), alike, 2 * BINS)
    errors = ravel_pytree(end.unknowns)[1](jnp.sqrt(jnp.diagonal(spread)))
    ones = jax.tree.map(jnp.ones_like, end.unknowns)
    slopes = jax.jvp(model.values, (end.unknowns,), (ones,))[1]
    one, is_plain = len(model.pictures.references) == 1, "footprint" not in model.names
    flat = eqx.tree_at(lambda r: r.model.corrects, residual, jnp.zeros(()))
    uncertainty = {}
    for name in (name for name in model.names if name != "footprint"):
        error = jnp.abs(slopes[name].astype(float)) * errors[name]
        uncertainty[name] = error[0] if one and name in LENS else error
    references = model.pictures.references
    middle = jnp.mean(references, axis=(1, 2), keepdims=True)
    contrast = jnp.mean(residual.weighted(references - middle) ** 2)
    names = ("gamma", "epsilon", "threshold", "scale", "shift", "footprint")
    return DofFit(
        lenses=tuple(model.lens(values, picture) for picture in range(len(references))),
        gain=gain,
        offset=offset,
        images=drawn if is_plain else evaluate(flat, end.unknowns)[1],
        losses=jnp.stack(end.losses),
        ends=ends,
        uncertainty=uncertainty,
        explained=jnp.where(contrast > 0, 1 - jnp.mean(rest**2) / contrast, 1),
        clamped=jnp.mean(model.circles(values) > model.max_coc),
        result=end.result,
        **{name: values[name] for name in names},
    )
