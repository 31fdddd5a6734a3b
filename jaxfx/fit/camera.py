"""The pose of a second photograph, by what reprojection shows from there."""

import functools
from typing import Any, Literal, final, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Num

from jaxfx._arguments import check_camera
from jaxfx._arrays import ArrayLike
from jaxfx._checks import (
    Number,
    WholeNumber,
    check,
    check_depth,
    check_image,
    is_concrete,
    option,
    whole_number,
)
from jaxfx._numerics import safe_divide
from jaxfx._progress import Bar
from jaxfx.camera import PinholeCamera
from jaxfx.fit._descent import End, Solver, check_success, descend, linear
from jaxfx.fit._in_program import fitted_under_transform, joined
from jaxfx.fit._jackknife import covariance, tiles
from jaxfx.fit._pose_residual import Comparison, Residual, Views
from jaxfx.fit._pose_search import search
from jaxfx.fit._robust import huber
from jaxfx.reproject.arguments import check_image_depth, check_threshold


# What a pose must meet to be called a success: the least ratio of pixels that both images show,
# the least ratio of contrast that is explained, and the largest standard error of where points
# appear, in radians. Chosen on pairs of rendered views of every overlap, of which by
# `tests/fit/test_camera.py` at most 2 % are wrong poses called a success and at most 5 % right
# ones called a failure: looser bounds break the first, tighter ones the second.
_LEAST_SHARE, _LEAST_EXPLAINED, _MOST_WANDER = 0.05, 0.7, 1.2e-2

Exposure = Literal["free", "equal"]


@final
class CameraFit(eqx.Module):
    """The pose that `camera` found, how sure it is, and how well it explains the photograph.

    - `camera`: the start's intrinsics with the fitted pose, a `PinholeCamera`.
    - `gain`, `offset`: channel, what takes the image's radiance to the reference's, a ratio
      and units of radiance.
    - `losses`: the mean squared residual at the start and after every step, in squared units of
      radiance; it jumps where the search goes on with less blur.
    - `covariance`: 6 x 6, of the twist about the fitted pose in its own axes: three of
      translation in scene units, three of rotation in radians. From a jackknife: the residuals
      of 8 x 8 tiles of the reference are taken for independent of one another, and no others.
    - `share`: the share of the reference's pixels, a ratio, that were compared in the end.
    - `explained`: the share of the reference's contrast there, a ratio, that is explained: 1
      leaves no difference, 0 is no better than an even image.
    - `reach`: the median depth, in scene units, without a sky a thousand times as far.
    - `result`: optimistix' verdict on the last search, one of its `RESULTS`.
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
        """Of the pose, in its own axes: `translation`, 3, scene units; `rotation`, 3, radians.

        The roots of the diagonal of `covariance`.
        """
        translation, rotation = jnp.split(jnp.sqrt(jnp.diagonal(self.covariance)), 2)
        return {"translation": translation, "rotation": rotation}

    @property
    def wander(self) -> Float[Array, ""]:
        """Standard error of the direction in which a point at `reach` appears, in radians."""
        translation, rotation = jnp.split(jnp.diagonal(self.covariance), 2)
        return jnp.sqrt(jnp.sum(translation) / self.reach**2 + jnp.sum(rotation))

    @property
    def doubt(self) -> str:
        """Why the pose is not to be trusted, as a sentence; empty for a success."""
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
        """Whether the solver converged to a pose that the images determine."""
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
    """The pose of the camera that took a photograph, from another image with its depth.

    Use it to register photographs of one static scene. `success` and `doubt` of the result say
    whether the images determine the pose.

    **Arguments:**

    - `reference`: rows columns channel, linear radiance: the photograph whose pose is sought.
    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the axis of `camera`; inf, and what is missing
      (0, negative, NaN), as in `reproject.warp`.
    - `camera`: the camera of `image` and `depth`.
    - `start`: the reference's camera with its true intrinsics and a pose to start from, that of
      `camera` say.
    - `reference_depth`: rows columns, the photograph's own depth where it has one, in the units
      of `depth`; its ratio to the depth that reprojection shows counts beside the colors.
    - `exposure`: `"free"`: gain and offset of each channel are those that fit best; `"equal"`
      where both images have the same radiance.
    - `hole_threshold`: as in `reproject.warp`, a ratio of depths.
    - `solver`: any least-squares solver or minimiser of optimistix; by default
      Levenberg-Marquardt.
    - `max_steps`: of the solver, for each blur.
    - `throw`: raise where the fit is no success; else `doubt` says why.
    - `progress`: show a bar on stderr; it needs the extra `plot`.

    **Returns:** a `CameraFit`.

    **Raises:** `ValueError` for wrong shapes, cameras or options, an image that is not finite,
    or a depth that is nowhere known. `RuntimeError` where the fit is no success and `throw` is
    true.

    **Gradient:** none through the search: it stops at every step to report. Under `jit` and
    `vmap` it is a part of the program, of a batch one after the other on the device where each
    member lies; `throw` and `progress` must then be false. NaN fills up `losses`.

    **Example:** an image is registered to itself.

    >>> import numpy as np
    >>> from jaxfx import PinholeCamera, fit
    >>> y, x = np.mgrid[:12, :12] / 12
    >>> image = np.stack([np.sin(9 * x), np.cos(7 * y), np.sin(5 * x * y)], axis=-1)
    >>> camera = PinholeCamera.from_fov(1.0, height=12, width=12)
    >>> fitted = fit.camera(image, image, np.full((12, 12), 2.0), camera, camera, max_steps=8)
    >>> float(abs(fitted.camera.world_from_camera - camera.world_from_camera).max()) < 1e-3
    True

    The loss is Huber's, of the photograph less the other image as reprojection shows it from
    the pose: squares up to 1.3 standard deviations of the noise, which is estimated from the
    images, and sizes beyond. The pose is the start moved by a twist of six numbers. The
    derivative is that of the point where a pixel's ray meets the depth.

    The search goes from coarse to fine. Images of at most 160 pixels a side are blurred by a
    sigma of a sixteenth of their side, then by half of that, and so on down to a pixel. Where
    the given images are larger, one pixel in four of these is compared, and the last steps are
    made on the images as given, with some 19,000 pixels of the photograph. The last blur stays:
    a reprojected image is read between pixels, hence smoother than a photograph, and sharp
    images would draw the pose to where both look equally smooth.

    Silhouettes are left out: pixels that show a step in depth, or a hole, and their neighbours.
    What comes into sight there is a change of visibility, which the derivative does not
    contain; such pixels would pull the pose to where they happen to agree. The margin of either
    image, whose blur lacks what is outside, is left out too.

    The scene must be lit alike in both images, but for their exposure. The search finds the
    nearest minimum: a texture that repeats, or a start that is too far, may lead to a wrong
    one. Four pairs of photographs of a room with depth, 160 x 120 pixels, 1.5 to 7.7 degrees
    and 5 to 26 cm apart, were all registered from the pose of `camera`: to 0.02 to 0.08 degrees
    and 1 to 3 mm, with `reference_depth` to 0.02 degrees and 0.5 mm; likewise where one image
    was a quarter brighter or darker.

    Source: Lucas & Kanade 1981, image registration, from coarse to fine; Murray, Li & Sastry
    1994, the exponential of a twist; Huber 1964, the loss; Golub & Pereyra 1973, exposure by
    variable projection; the masks, the last blur and the bounds of success are our own.
    """
    views = _views(reference, reference_depth, image, depth, camera, start)
    max_steps = whole_number("camera(max_steps=...)", max_steps)
    hole_threshold = check_threshold("camera", hole_threshold)
    option("camera(exposure=...)", exposure, get_args(Exposure))

    def fitted_to(views: Views, bar: Bar) -> CameraFit:
        descend_on = functools.partial(descend, solver=solver, max_steps=max_steps, bar=bar)
        return _fitted(*search(views, hole_threshold, exposure == "free", descend_on))

    if not is_concrete(views):
        quiet = functools.partial(fitted_to, bar=Bar(False, "fit"))
        return fitted_under_transform(quiet, views, "camera", throw, progress, solver)
    with Bar(progress, "fit") as bar:
        fitted = fitted_to(views, bar)
    if throw:
        check_success(fitted, "camera", "pose")
    return fitted


def _fitted(model: Residual, end: End) -> CameraFit:
    """The result at the end of a search: pose, exposure, covariance and quality."""
    at_end = linear(model, end.unknowns)
    found: Comparison = at_end.aux.details
    block, count = tiles(found.deviations.shape)
    spread = covariance(at_end.jacobian, at_end.residual, block, count)
    spread = spread * model.unit[:, None] * model.unit[None]
    share = jnp.mean(found.counts)
    color = found.deviations[..., : found.gain.size]
    rest = jnp.mean((model.scale[0] * huber(color)) ** 2 * found.counts[..., None])
    contrast = share * found.contrast.astype(float)
    return CameraFit(
        camera=model.moved(end.unknowns),
        gain=found.gain,
        offset=found.offset,
        losses=joined(end.losses),
        covariance=jnp.where(share > 0, spread, jnp.inf),
        share=share,
        explained=jnp.where(contrast > 0, 1 - safe_divide(rest, contrast), 0),
        reach=model.unit[0],
        result=end.result,
    )


def _views(
    reference: Any, reference_depth: Any, image: Any, depth: Any, camera: Any, start: Any
) -> Views:
    """The checked arguments, in the type of `image`."""
    for name, value in (("camera", camera), ("start", start)):
        check_camera(f"camera({name})", value, PinholeCamera)
    image = check_image("camera(image)", image)
    reference = check_image("camera(reference)", reference)
    depth = check_image_depth("camera", depth, image.shape[:2])
    if reference.shape[2] != image.shape[2]:
        raise ValueError(
            f"`camera(reference)` must have the image's {image.shape[2]} channels, "
            f"got {reference.shape[2]}."
        )
    for name, value in (("image", image), ("reference", reference)):
        check(f"camera({name})", value, np.isfinite, "finite")
    is_somewhere = lambda v: (np.isfinite(v) & (v > 0)).any()
    check("camera(depth)", depth, is_somewhere, "known somewhere")
    if reference_depth is not None:
        name = "camera(reference_depth=...)"
        reference_depth = check_depth(name, reference_depth, reference.shape[:2])
        check(name, reference_depth, is_somewhere, "known somewhere")
        reference_depth = reference_depth.astype(image.dtype)
    reference, depth = reference.astype(image.dtype), depth.astype(image.dtype)
    return Views(reference, reference_depth, image, depth, camera, start)
