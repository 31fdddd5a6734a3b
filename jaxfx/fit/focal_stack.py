"""The all-in-focus image and the depth of a scene, from images at several focus distances."""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any, cast, final, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jaxfx import depth as depths
from jaxfx._arguments import check_lens
from jaxfx._arrays import ArrayLike
from jaxfx._checks import (
    Number,
    WholeNumber,
    check,
    check_image,
    items,
    number,
    option,
    whole_number,
)
from jaxfx._numerics import one_program, working_dtype
from jaxfx._progress import Bar
from jaxfx.fit._descent import End, check_success, descend, verdict
from jaxfx.fit._lens_model import Effect
from jaxfx.fit._stack_lenses import Found, Lines, Unknown, searched
from jaxfx.fit._stack_planes import (
    WINDOW,
    Planes,
    around,
    at_inverse_depth,
    best,
    candidate_planes,
    compared,
    explained,
    settled,
)
from jaxfx.fit._stack_search import StackResidual
from jaxfx.lens import ThinLens


# What a stack must meet to be called a success, all ratios: the largest standard error of a
# depth that is determined, and of a number of a lens, over its value; the least share of pixels
# that are determined; the least variation from image to image that is explained; the largest
# difference in exposure. Looser bounds trust stacks that show nothing, tighter ones doubt those
# of which half is even. Scenes 128 and more pixels wide explain 0.93 to 1, noise or not, 0.9
# with apertures 2 % off; a fence of bars two pixels wide, wrong by a quarter, 0.6 to 0.7.
_MOST_ERROR, _LEAST_SHARE, _LEAST_EXPLAINED, _MOST_EXPOSURE = 0.1, 0.05, 0.8, 0.05
# Ratio of energies: up to this one the images agree with what is filled as with what was found.
# A smaller one leaves noise where nothing is told, a larger one fills thin surfaces up.
_MOST_ENERGY_RATIO = 1.25
# Pixels of defocus from one candidate plane to the next. Coarser planes miss the least energy,
# finer ones cost time alone.
_STEP = 0.35
# Pixels. Lenses whose circles of confusion differ less from one another tell no depth.
_LEAST_DIFFERENCE = 0.5


@final
class FocalStackFit(eqx.Module):
    """The image and depth that `focal_stack` found, and how sure they are.

    - `image`: height width channel, all in focus, linear radiance.
    - `depth`: height width, scene units. Where it is not `determined` it is that of a pixel
      nearby.
    - `lenses`: as given, with the apertures or the focus distances that were found.
    - `standard_errors`: `"depth"`, height width, in scene units, from the images alone, without
      the prior: inf where they tell nothing. From the residuals in a window of some 14 pixels;
      errors of pixels more than 5 apart are taken for independent. That a window shows two
      surfaces is not in it, nor are errors of the lenses. Of a lens' number that was searched
      for, under its name, those of each lens, in scene units.
    - `determined`: height width, where the standard error is below a tenth of the depth.
    - `share`: the share of pixels, a ratio, that are determined.
    - `explained`: how much of what varies from image to image is explained, without noise: the
      median share, a ratio, over windows that vary by more than noise. 1 leaves no difference.
    - `exposures`: photograph, the mean of each image over the mean of all, a ratio.
    - `losses`: the mean squared residual at the start of the search through the effect and
      after every step, in units of the noise.
    - `result`: optimistix' verdict on that search, one of its `RESULTS`.
    """

    image: Float[Array, "height width channel"]
    depth: Float[Array, "height width"]
    lenses: tuple[ThinLens, ...]
    standard_errors: dict[str, Float[Array, "..."]]
    determined: Bool[Array, "height width"]
    share: Float[Array, ""]
    explained: Float[Array, ""]
    exposures: Float[Array, " photograph"]
    losses: Float[Array, " steps"]
    result: optx.RESULTS

    @property
    def doubt(self) -> str:
        """Why the depth is not to be trusted, as a sentence; empty for a success."""
        ended = optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
        if not any(self.result == each for each in ended):
            return str(self.result)
        uneven = float(jnp.max(jnp.abs(self.exposures - 1)))
        if not uneven <= _MOST_EXPOSURE:
            return f"The exposure differs by {100 * uneven:.0f} % between the images."
        for name in get_args(Unknown):
            if name in self.standard_errors:
                values = np.array([float(getattr(lens, name)) for lens in self.lenses])
                error = float(np.max(np.asarray(self.standard_errors[name]) / values))
                if not error <= _MOST_ERROR:
                    noun = name.replace("_", " ")
                    return f"The images do not tell the {noun}, by {100 * error:.0f} %."
        if not self.share >= _LEAST_SHARE:
            return f"The images determine the depth of {100 * float(self.share):.0f} % of them."
        if not self.explained >= _LEAST_EXPLAINED:
            part = max(0.0, 100 * float(self.explained))
            return f"Only {part:.0f} % of what varies between the images is explained."
        return ""

    @property
    def success(self) -> bool:
        """Whether the images determine the depth of enough pixels."""
        return not self.doubt


def focal_stack(
    images: Sequence[Float[ArrayLike, "height width channel"]],
    lenses: Sequence[ThinLens],
    *,
    min_depth: Number | None = None,
    max_depth: Number | None = None,
    parameters: Collection[str] = (),
    effect: Effect = "scatter",
    smoothness: Number = 1.0,
    max_steps: WholeNumber = 8,
    throw: bool = True,
    progress: bool = False,
) -> FocalStackFit:
    """The all-in-focus image and the depth of a scene, from images focused at other distances.

    The camera and the scene stand still. `standard_errors` and `determined` of the result say
    of which pixels the images tell the depth.

    **Arguments:**

    - `images`: height width channel each, linear radiance, two or more of one exposure.
    - `lenses`: one for each image, lengths in scene units; at least two focus distances. Known,
      but for `parameters`, of which they are the start.
    - `min_depth`, `max_depth`: static; scene units, the depths between which it is sought. By
      default half a step of inverse focus distance beyond the least and the largest.
    - `parameters`: what of the lenses is searched for too, one at most. `{"aperture"}`: a
      factor of all apertures; focus distances must be known. `{"focus_distance"}`: each one's,
      from up to half a step between them off; their mean inverse stays that of the start, for
      a shift of all is a shift of the scene. The two together have a scale that images do not
      tell: take any aperture then, and depths are in its scale.
    - `effect`: the function of `jaxfx.dof` through which the search goes, `"scatter"` or
      `"layered"`, which takes longer.
    - `smoothness`: weight of the prior, a ratio: each bend of the inverse depth counts like a
      difference of images as large as their noise where it is 0.05 pixels of defocus.
    - `max_steps`: of the search through the effect; 0 ends with the planes, see below.
    - `throw`: raise where the fit is no success; else `doubt` says why.
    - `progress`: show a bar on stderr; it needs the extra `plot`.

    **Returns:** a `FocalStackFit`.

    **Raises:** `ValueError` for a single image, shapes or numbers that differ, an image that is
    not finite, a lens that is none, lenses whose circles of confusion are alike, parameters
    that are none or several, or a range without depths. `RuntimeError` where the fit is no
    success and `throw` is true.

    **Gradient:** none through the search: it stops at every step to report.

    **Example:** a textured wall at 2.5, in focus in none of three images.

    >>> import numpy as np
    >>> from jaxfx import ThinLens, dof, fit
    >>> wall = np.random.default_rng(0).random((32, 32, 1)).astype(np.float32)
    >>> lenses = [ThinLens(0.3, focus, 180.0) for focus in (2.0, 3.0, 5.0)]
    >>> depth = np.full((32, 32), 2.5, np.float32)
    >>> images = [dof.scatter(wall, depth, lens) for lens in lenses]
    >>> found = fit.focal_stack(images, lenses, max_steps=0)
    >>> bool(abs(np.median(found.depth) - 2.5) < 0.01)
    True

    Lenses that are not known are searched for by BFGS: those for which the best of the planes
    below leave least, in the mean of logarithms over pixels.

    Then candidate planes are compared, a third of a pixel of defocus apart. For each the image
    that explains the stack best is a quotient of Fourier transforms, and the plane whose
    residuals in a window are least, plain and with high frequencies raised, gives a pixel its
    depth. An image counts less the larger its circle of confusion would be there, least one
    that is in focus beyond the plane: it shows what a thin surface does not hide. Then each
    takes the median about it, weighted by the planes' agreement with the images and by
    likeness of color; where nothing near is determined it is filled as by `depth.fill`, unless
    the images contradict that. From there image and depth are searched for together, by
    nonlinear conjugate gradients through the effect, with a pseudo-Huber loss, in which an
    image counts less where its circle of confusion is above 2 pixels, and a prior of the same
    form on second differences of the inverse depth, which is less at edges of the image. More
    steps than the default lower the error of depth where little is hidden, and let the image
    follow what the effect draws wrong. The standard error is that of Gauss and Newton, with the
    image solved for, from derivatives of the residuals in the window and the residuals
    themselves.

    Known limits: within the radius of a circle of confusion from an edge in depth, a window
    shows two surfaces. Where all circles are below some 4 pixels the depth is biased, by 5 % in
    this example with a third of the focal length. A lens that breathes must be undone first.

    A lens' standard error is the sandwich estimate, by differences of slopes and by tiles.

    Source: Zhou, Lin & Nayar 2009, the comparison of planes by Wiener quotients; Newey & West
    1987, variances of sums whose terms depend on their neighbors. The raised
    frequencies, the images' weights, the search for lenses, the weighted median's trust, the
    search through the effect, its weights and prior, and the bounds of success are ours.
    """
    stack, lenses = _checked(images, lenses)
    option("focal_stack(effect=...)", effect, get_args(Effect))
    smoothness = number(
        "focal_stack(smoothness=...)", smoothness, lambda x: 0 <= x < math.inf, "0 or positive"
    )
    max_steps = whole_number(
        "focal_stack(max_steps=...)", max_steps, lambda n: n >= 0, "an integer from 0"
    )
    unknown = _unknown(parameters)
    dtype = stack.dtype
    lines = _lines(lenses)
    bounds = _range(lines.foci, min_depth, max_depth)
    largest = _largest(lines, bounds)
    errors: dict[str, Array] = {}
    with Bar(progress, "fit") as bar:
        if unknown is not None:
            found = searched(stack, lines, bounds, unknown, bar)
            lenses, errors = _with_lines(lenses, found, unknown)
            lines = _lines(lenses)
            bounds = _range(lines.foci, min_depth, max_depth)
            largest = _largest(lines, bounds)
        candidates = candidate_planes(bounds, lines.strengths.mean(), _STEP)
        candidates = jnp.asarray(candidates, dtype)
        pad = math.ceil(largest / 2) + 2
        planes = compared(stack, *(jnp.asarray(x, dtype) for x in lines), candidates, pad)
        bar.step(planes=str(len(candidates)))
        start = best(planes, candidates)
        # An image that fits is seen through planes that fit, told or not.
        image = at_inverse_depth(planes.image, candidates, start)
        energy = at_inverse_depth(planes.energy, candidates, start)
        tiny = jnp.finfo(dtype).tiny
        guide = image / jnp.maximum(jnp.sqrt(jnp.mean(image * image)), tiny)
        start = settled(start, energy, guide)
        start = _filled(start, planes, candidates, stack)
        residual = _residual(
            stack, lenses, image, energy, candidates, start, smoothness, effect, largest
        )
        unknowns = {
            "shift": jnp.zeros(start.shape, float),
            "change": jnp.zeros(residual.image.shape, float),
        }
        if max_steps:
            solver = optx.NonlinearCG(rtol=1e-3, atol=1e-3)
            end = descend(residual, unknowns, solver=solver, max_steps=max_steps, bar=bar)
        else:
            loss = jnp.mean(residual(unknowns) ** 2)
            end = End(unknowns, [loss], optx.RESULTS.successful)
    image, inverse_depth = residual.values(end.unknowns)
    drawn = residual.drawn(image, inverse_depth)
    means = jnp.mean(stack, axis=(1, 2, 3))
    error = _errors(planes, candidates, inverse_depth)
    is_determined = error < _MOST_ERROR * inverse_depth
    fitted = FocalStackFit(
        image=image,
        depth=1 / inverse_depth,
        lenses=lenses,
        standard_errors={"depth": error / inverse_depth**2} | errors,
        determined=is_determined,
        share=jnp.mean(is_determined.astype(dtype)),
        explained=explained(stack, drawn),
        exposures=means / jnp.mean(means),
        losses=jnp.stack(end.losses),
        result=verdict(end.result),
    )
    if throw:
        check_success(fitted, "focal_stack", "depth")
    return fitted


def _checked(images: Any, lenses: Any) -> tuple[Array, tuple[ThinLens, ...]]:
    """The images, stacked, and their lenses; or a `ValueError`."""
    images = items("focal_stack(images)", images, "a sequence of images")
    if len(images) < 2:
        raise ValueError(f"`focal_stack(images)` must be two or more, got {len(images)}.")
    checked = []
    for index, image in enumerate(images):
        name = f"focal_stack(images[{index}])"
        read = check_image(name, image)
        check(name, read, np.isfinite, "finite")
        if checked and read.shape != checked[0].shape:
            raise ValueError(
                f"`{name}` must have the first image's shape {checked[0].shape}, "
                f"got {read.shape}."
            )
        checked.append(read.astype(working_dtype(read.dtype)))
    lenses = tuple(items("focal_stack(lenses)", lenses, "a sequence of lenses"))
    if len(lenses) != len(checked):
        raise ValueError(
            f"`focal_stack(lenses)` must be one for each of {len(checked)} images, "
            f"got {len(lenses)}."
        )
    for index, lens in enumerate(lenses):
        name = f"focal_stack(lenses[{index}])"
        if not isinstance(lens, ThinLens):
            raise ValueError(f"`{name}` must be a ThinLens, got {type(lens).__name__}.")
        check_lens(name, lens)
    return jnp.stack([image.astype(checked[0].dtype) for image in checked]), lenses


def _unknown(parameters: Any) -> Unknown | None:
    """The one that is searched for, if any; `ValueError` for others or several."""
    choices = get_args(Unknown)
    is_collection = isinstance(parameters, Collection) and not isinstance(parameters, str)
    if not is_collection or len(parameters) > 1 or not set(parameters) <= set(choices):
        raise ValueError(
            "`focal_stack(parameters=...)` must hold one of the names "
            f"{choices} or none, got {parameters!r:.60}."
        )
    return cast(Any, next(iter(parameters), None))


def _lines(lenses: tuple[ThinLens, ...]) -> Lines:
    strengths = [float(lens.aperture) * float(lens.focal_pixels) for lens in lenses]
    return Lines(np.array(strengths), np.array([1 / float(x.focus_distance) for x in lenses]))


def _with_lines(
    lenses: tuple[ThinLens, ...], found: Found, unknown: Unknown
) -> tuple[tuple[ThinLens, ...], dict[str, Array]]:
    """The lenses with the numbers that were found, and these numbers' standard errors."""
    if unknown == "aperture":
        values = found.lines.strengths / np.array([float(x.focal_pixels) for x in lenses])
        errors = found.errors * values
    else:
        # Nothing is in focus beyond infinity.
        values = 1 / np.maximum(found.lines.foci, 1e-3 * found.lines.foci.max())
        errors = found.errors * values**2
    moved = tuple(
        replace(lens, **{unknown: jnp.asarray(value, jnp.asarray(lens.aperture).dtype)})
        for lens, value in zip(lenses, values, strict=True)
    )
    return moved, {cast(str, unknown): jnp.asarray(errors)}


def _range(foci: np.ndarray, min_depth: Any, max_depth: Any) -> tuple[float, float]:
    """The inverse depths between which the search goes."""
    is_depth = lambda x: 0 < x < math.inf
    named = {"min_depth": min_depth, "max_depth": max_depth}
    given = {
        name: 1 / number(f"focal_stack({name}=...)", value, is_depth, "positive and finite")
        for name, value in named.items()
        if value is not None
    }
    first, last = float(foci.min()), float(foci.max())
    # Lenses that are alike are refused later, by another name.
    step = (last - first) / max(1, len(foci) - 1) / 2 or first / 2
    low: float = given.get("max_depth", max(first - step, first / 4))
    high: float = given.get("min_depth", last + step)
    if not low < high:
        raise ValueError(
            "`focal_stack(min_depth=...)` must be less than `max_depth`, "
            f"got {1 / high:.4g} and {1 / low:.4g}."
        )
    return low, high


def _largest(lines: Lines, bounds: tuple[float, float]) -> float:
    """The largest circle of confusion in pixels; `ValueError` where lenses do not differ."""
    ends = np.abs(lines.strengths * (lines.foci - np.array(bounds)[:, None]))
    difference = np.ptp(ends, axis=1).max()
    if not difference > _LEAST_DIFFERENCE:
        raise ValueError(
            "`focal_stack(lenses)` must have circles of confusion that differ by more than "
            f"{_LEAST_DIFFERENCE} pixels from one image to another, got {difference:.3g}."
        )
    return float(ends.max())


@one_program
def _errors(planes: Planes, candidates: Array, inverse_depth: Array) -> Array:
    """The standard error of the inverse depth at each pixel; inf where nothing tells it."""
    slope, spread = (
        at_inverse_depth(values, candidates, inverse_depth)
        for values in (planes.slope, planes.spread)
    )
    is_told = slope > 0
    return jnp.where(is_told, jnp.sqrt(spread) / jnp.where(is_told, slope, 1), jnp.inf)


def _filled(inverse_depth: Array, planes: Planes, candidates: Array, stack: Array) -> Array:
    """The inverse depth, filled where no pixel within the median's reach is determined.

    A value that the images contradict is not filled in. Beside a thin surface no plane explains
    them, so that nothing is determined there, but they still tell near from far.
    """
    is_known = around(_errors(planes, candidates, inverse_depth) < _MOST_ERROR * inverse_depth)
    if not bool(is_known.any()):
        return inverse_depth
    guide = jnp.mean(stack, axis=0)
    guide = guide / jnp.maximum(jnp.max(guide), jnp.finfo(guide.dtype).tiny)
    filled = 1 / depths.fill(jnp.where(is_known, 1 / inverse_depth, 0), guide).depth
    energy = lambda at: at_inverse_depth(planes.energy, candidates, at)
    agrees = energy(filled) <= _MOST_ENERGY_RATIO * energy(inverse_depth)
    return jnp.where(agrees, filled, inverse_depth)


def _residual(
    stack: Array,
    lenses: tuple[ThinLens, ...],
    image: Array,
    energy: Array,
    candidates: Array,
    start: Array,
    smoothness: float,
    effect: Effect,
    largest: float,
) -> StackResidual:
    """The residual of the search, which starts at the planes' image and inverse depth."""
    dtype = stack.dtype
    level = jnp.sqrt(jnp.mean(stack * stack))
    area = 2 * math.pi * WINDOW**2 * stack.shape[-1]
    noise = jnp.sqrt(jnp.median(energy) / area) + 1e-3 * level
    strengths = _lines(lenses).strengths
    return StackResidual(
        images=stack,
        lenses=jax.tree.map(lambda *leaves: jnp.stack(leaves).astype(dtype), *lenses),
        image=image,
        inverse_depth=start,
        bounds=(candidates[0], candidates[-1]),
        strength=jnp.mean(jnp.asarray(strengths, dtype)),
        noise=jnp.maximum(noise, jnp.finfo(dtype).tiny),
        level=jnp.maximum(level, jnp.finfo(dtype).tiny),
        smoothness=jnp.asarray(smoothness, dtype),
        effect=effect,
        max_coc=math.ceil(largest),
    )
