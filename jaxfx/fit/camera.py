"""The pose of a second photograph, by what reprojection shows from there."""

import functools
import math
from collections.abc import Callable
from typing import Any, Literal, final, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Num

from jaxfx._arguments import check_camera
from jaxfx._checks import (
    Number,
    WholeNumber,
    check,
    check_depth,
    check_image,
    option,
    whole_number,
)
from jaxfx._numerics import safe_divide
from jaxfx._progress import Bar
from jaxfx.camera import PinholeCamera
from jaxfx.fit._descent import End, Solver, covariance, descend, huber, tiles
from jaxfx.fit._pose import (
    Comparison,
    Residual,
    Views,
    blurred,
    clear_of_steps,
    reduced,
    report,
    shrunk,
    thinned,
)
from jaxfx.reproject.warp import check_options, check_source


# The widest blur's sigma is at most this share of the picture's side; the last's is a pixel.
_WIDEST = 1 / 16

# The largest side of the images of the coarse steps, in pixels, and the number of the
# reference's pixels in the last steps.
_COARSE, _RAYS = 160, 160 * 120

# What a pose must meet to be trusted: ratios, and a standard error in radians. Chosen on pairs
# of rendered views of every overlap, in `tests/fit/test_camera.py`.
_LEAST_SHARE, _LEAST_EXPLAINED, _MOST_WANDER = 0.05, 0.7, 1.2e-2

Exposure = Literal["free", "equal"]


@final
class CameraFit(eqx.Module):
    """What `camera` found.

    - `camera`: the start's intrinsics with the fitted pose, a `PinholeCamera`.
    - `gain`, `offset`: channel, what takes the source's radiance to the reference's, a ratio
      and units of radiance.
    - `losses`: the mean squared residual at the start and after every step, in squared units of
      radiance; it jumps where the search goes on with less blur.
    - `covariance`: 6 x 6, of the twist about the fitted pose in its own axes: three of
      translation in scene units, three of rotation in radians. It takes the residuals of 8 x 8
      tiles of the reference for independent of one another, and no others.
    - `share`: the share of the reference's pixels, a ratio, that had a say in the end.
    - `explained`: the share of the reference's contrast there, a ratio, that is explained: 1
      leaves no difference, 0 is no better than an even image.
    - `reach`: the median depth of the source, in scene units.
    - `result`: optimistix' verdict on the sharpest images.
    """

    camera: PinholeCamera
    gain: Float[Array, " channel"]
    offset: Float[Array, " channel"]
    losses: Float[Array, " steps"]
    covariance: Float[Array, "6 6"]
    share: Float[Array, ""]
    explained: Float[Array, ""]
    reach: Float[Array, ""]
    result: optx.RESULTS

    @property
    def standard_errors(self) -> dict[str, Float[Array, "3"]]:
        """Roots of the covariance's diagonal, along the axes of the fitted camera.

        `translation`: 3, scene units; `rotation`: 3, radians.
        """
        translation, rotation = jnp.split(jnp.sqrt(jnp.diagonal(self.covariance)), 2)
        return {"translation": translation, "rotation": rotation}

    @property
    def wander(self) -> Float[Array, ""]:
        """By how far the images of points may be off: a standard error, in radians."""
        shift, turn = jnp.split(jnp.diagonal(self.covariance), 2)
        return jnp.sqrt(jnp.sum(shift) / self.reach**2 + jnp.sum(turn))

    @property
    def doubt(self) -> str:
        """Why the pose is not to be trusted, as a sentence; empty where it is."""
        if self.share < _LEAST_SHARE:
            return f"Both see only {100 * float(self.share):.0f} % of the pixels."
        if self.result != optx.RESULTS.successful:
            return str(self.result)
        if self.explained < _LEAST_EXPLAINED:
            return f"Only {100 * float(self.explained):.0f} % of the contrast is explained."
        if not self.wander < _MOST_WANDER:
            return f"Its standard error is {float(self.wander):.2g} radians."
        return ""

    @property
    def success(self) -> bool:
        """Whether the solver converged, to a pose that the images tell."""
        return not self.doubt


def camera(
    reference: Float[ArrayLike, "rows columns channel"],
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    camera: PinholeCamera,
    start: PinholeCamera,
    *,
    reference_depth: Num[ArrayLike, "rows columns"] | None = None,
    exposure: Exposure = "free",
    hole_threshold: Number = 0.1,
    solver: Solver | None = None,
    max_steps: WholeNumber = 32,
    throw: bool = True,
    progress: bool = False,
) -> CameraFit:
    """The pose from which a photograph was taken, given another one with its depth.

    Differences between the photograph and the reprojection of the other are made small over a
    twist of six numbers about the start, by Huber's loss: squares up to 1.3 standard deviations
    of the noise, which the data tell, and sizes beyond. Gain and offset of each channel are
    those that fit best. The search goes from coarse to fine: images of at most 160 pixels a
    side are blurred by a sigma of a sixteenth of their side, then by half of that, and so on
    down to a pixel; the last steps are made on the images as given, with some 19,000 pixels of
    the photograph. The last blur stays: a reprojected image is read between pixels, hence
    smoother than a photograph, and sharp ones would draw the pose to where both look equally
    smooth. The derivative is that of the point where a pixel's ray meets the depth.

    Silhouettes are left out: pixels that look next to a step in depth or to where the source
    saw nothing, and the pixels beside those. What comes into sight there is a change of
    visibility, which the derivative does not contain: the pixel's colour jumps from one
    surface's to another's while its derivative follows only the one that it shows. Kept, such
    pixels would pull the pose to where they happen to agree. So is what lies at the frame of
    either image, whose blur lacks what is outside.

    It takes the scene to be lit alike in both images, but for their exposure, and finds the
    nearest minimum: a texture that repeats, or a start that is too far, may lead to a wrong
    one. `success` says whether the images tell the pose: by the share of pixels that both see,
    the contrast that is explained, and the standard error.

    **Arguments:**

    - `reference`: rows columns channel, linear radiance: the photograph whose pose is asked.
    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the axis of `camera`; inf, and what is missing
      (0, negative, NaN), as in `reproject.warp`.
    - `camera`: the camera of `image` and `depth`.
    - `start`: the reference's camera with its true intrinsics and a pose to start from. Of four
      pairs of photographs of a room with their depth, 160 x 120 pixels, 1.5 to 7.7 degrees and
      5 to 26 cm apart, all were found from the source's own pose: to 0.04 to 0.08 degrees and
      2 to 4 mm, and with `reference_depth` to 0.02 degrees and 0.5 mm; alike where one image
      was a quarter brighter or darker.
    - `reference_depth`: rows columns, the photograph's own depth where it has one, in the units
      of `depth`; its ratio to the depth that is seen counts beside the colors.
    - `exposure`: `"free"`, or `"equal"` where both images have the same radiance.
    - `hole_threshold`: as in `reproject.warp`, a ratio of depths.
    - `solver`: any least-squares solver or minimiser of optimistix; by default
      Levenberg-Marquardt.
    - `max_steps`: of the solver, for each blur.
    - `throw`: raise where the solver fails; else the failure stands in the result.
    - `progress`: show a bar on stderr; it needs the extra `plot`.

    **Returns:** a `CameraFit`.

    **Raises:** `ValueError` for wrong shapes, cameras or options, an image that is not finite,
    or a depth that is nowhere known. `RuntimeError` where the fit is no success and `throw` is
    true.

    **Gradient:** none through the search: it stops at every step to report.

    Source: Lucas & Kanade 1981, image registration, from coarse to fine; Murray, Li & Sastry
    1994, the exponential of a twist; Huber 1964, the loss; Golub & Pereyra 1973, exposure by
    variable projection; the masks, the last blur and the bounds of success are our own.
    """
    views = _views(reference, reference_depth, image, depth, camera, start)
    max_steps = whole_number("camera(max_steps=...)", max_steps)
    check_options("camera", views.reference.shape[:2], "pyramid", hole_threshold)
    option("camera(exposure=...)", exposure, get_args(Exposure))
    with Bar(progress, "fit") as bar:
        descend_on = functools.partial(descend, solver=solver, max_steps=max_steps, bar=bar)
        model, end = _search(views, float(hole_threshold), exposure == "free", descend_on)
    fitted = _fitted(model, end)
    if throw and not fitted.success:
        raise RuntimeError(
            f"`camera` found no pose in {len(end.losses)} steps, the mean squared residual "
            f"going from {end.losses[0]:.3g} to {end.losses[-1]:.3g}: {fitted.doubt} "
            "`throw=False` returns what was reached."
        )
    return fitted


def _fitted(model: Residual, end: End) -> CameraFit:
    """The result at the end of a search: pose, exposure, covariance and quality."""
    columns, residual, found = report(model, end.unknowns)
    block, count = tiles(residual.shape)
    spread = covariance(columns, residual.reshape(-1), block, count)
    spread = spread * model.unit[:, None] * model.unit[None]
    share = jnp.mean(found.counts)
    color = found.noise[..., : found.gain.size]
    rest = jnp.mean((model.scale[0] * huber(color)) ** 2 * found.counts[..., None])
    contrast = share * found.contrast.astype(float)
    return CameraFit(
        model.eye(end.unknowns),
        found.gain,
        found.offset,
        jnp.stack(end.losses),
        jnp.where(share > 0, spread, jnp.inf),
        share,
        jnp.where(contrast > 0, 1 - safe_divide(rest, contrast), 0),
        model.unit[0],
        end.result,
    )


def _search(
    views: Views, threshold: float, exposure: bool, descend_on: Callable[..., End]
) -> tuple[Residual, End]:
    """From one blur to the next on reduced images, then on the given ones; the last model."""
    known = jnp.isfinite(views.depth) & (views.depth > 0)
    reach = jnp.nanmedian(jnp.where(known, views.depth, jnp.nan)).astype(float)
    unit = jnp.concatenate([jnp.full(3, reach), jnp.ones(3, float)])

    def model(views: Views, sigma: float, twist: Array, stride: int = 1) -> Residual:
        """With images blurred alike in the world, and the scale of noise at the twist."""
        finer = float(views.source.intrinsics[0, 0] / views.start.intrinsics[0, 0])
        soft = views._replace(
            reference=blurred(views.reference, jnp.asarray(sigma * max(1 / finer, 1))),
            image=blurred(views.image, jnp.asarray(sigma * max(finer, 1))),
        )
        clear = clear_of_steps(views.depth, threshold)
        first = Residual(soft, clear, unit, jnp.ones(2, float), threshold, exposure, stride)
        return eqx.tree_at(lambda m: m.scale, first, _scale(report(first, twist)[2]))

    small = _small(views)
    twist, losses = jnp.zeros(6, float), []
    sharpest, *coarse = reversed(_sigmas(min(small.reference.shape[:2])))
    for sigma in reversed(coarse):
        end = descend_on(model(small, sigma, twist), twist, patience=2, gain=1e-2)
        twist, losses = end.unknowns, losses + end.losses
    last = model(small, sharpest, twist)
    if small is not views:
        end = descend_on(last, twist, patience=2, gain=1e-2)
        twist, losses = end.unknowns, losses + end.losses
        pixels = math.prod(views.reference.shape[:2])
        last = model(views, sharpest, twist, math.ceil(math.sqrt(pixels / _RAYS)))
    end = descend_on(last, twist, gain=1e-4)
    return last, end._replace(losses=losses + end.losses)


def _small(views: Views) -> Views:
    """The views with images of at most `_COARSE` pixels a side, and the cameras of those."""
    of_reference, of_source = (
        math.ceil(max(size) / _COARSE)
        for size in (views.reference.shape[:2], views.depth.shape)
    )
    if of_reference == of_source == 1:
        return views
    own = views.reference_depth
    return Views(
        reduced(views.reference, of_reference),
        None if own is None else thinned(own, of_reference),
        reduced(views.image, of_source),
        thinned(views.depth, of_source),
        shrunk(views.source, of_source),
        shrunk(views.start, of_reference),
    )


def _scale(found: Comparison) -> Float[Array, "2"]:
    """The standard deviation of noise in what is compared: color, and depth where there is one.

    From the median of the absolute differences, which outliers do not move.
    """
    channels = found.gain.size
    sizes = jnp.where(found.counts[..., None] > 0, jnp.abs(found.noise), jnp.nan)
    color, own = sizes[..., :channels], sizes[..., channels:]
    least = 1e-3 * jnp.sqrt(found.contrast.astype(float)) + 1e-9
    color = jnp.maximum(jnp.nan_to_num(1.4826 * jnp.nanmedian(color)), least)
    if own.size == 0:
        return jnp.stack([color, jnp.ones_like(color)])
    own = 1.4826 * jnp.nanmedian(jnp.where(own > 0, own, jnp.nan))
    return jnp.stack([color, jnp.maximum(jnp.nan_to_num(own, nan=1.0), 1e-4)])


def _views(
    reference: Any, reference_depth: Any, image: Any, depth: Any, camera: Any, start: Any
) -> Views:
    """The checked arguments, in the type of `image`."""
    for name, eye in (("camera", camera), ("start", start)):
        check_camera(f"camera({name})", eye, PinholeCamera)
    image = check_image("camera(image)", image)
    reference = check_image("camera(reference)", reference)
    depth = check_source("camera", depth, image.shape[:2])
    if reference.shape[2] != image.shape[2]:
        raise ValueError(
            f"`camera(reference)` must have the image's {image.shape[2]} channels, "
            f"got {reference.shape[2]}."
        )
    for name, value in (("image", image), ("reference", reference)):
        check(f"camera({name})", value, np.isfinite, "finite")
    known = lambda v: (np.isfinite(v) & (v > 0)).any()
    check("camera(depth)", depth, known, "known somewhere")
    if reference_depth is not None:
        name = "camera(reference_depth=...)"
        reference_depth = check_depth(name, reference_depth, reference.shape[:2])
        check(name, reference_depth, known, "known somewhere")
        reference_depth = reference_depth.astype(image.dtype)
    reference, depth = reference.astype(image.dtype), depth.astype(image.dtype)
    return Views(reference, reference_depth, image, depth, camera, start)


def _sigmas(side: int) -> list[float]:
    """Of the blurs, in pixels, from coarse to fine."""
    halvings = int(math.log2(max(1, _WIDEST * side)))
    return [2.0**level for level in range(halvings, -1, -1)]
