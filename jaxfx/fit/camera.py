"""The pose of a second photograph, by what reprojection shows from there."""

import functools
import math
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Num

from jaxfx._arguments import check_camera
from jaxfx._checks import Number, WholeNumber, check, check_image, whole_number
from jaxfx._numerics import safe_divide
from jaxfx._progress import Bar
from jaxfx._sampling import bilinear, nearest, pixel_centers
from jaxfx.camera import PinholeCamera
from jaxfx.fit._descent import End, Solver, descend, standard_errors, verdict
from jaxfx.reproject._view import look
from jaxfx.reproject.warp import check_options, check_source


# The widest blur's sigma is at most this share of the picture's side; the last's is a pixel.
_WIDEST = 1 / 16


@final
class CameraFit(eqx.Module):
    """What `camera` found.

    - `camera`: the start's intrinsics with the fitted pose, a `PinholeCamera`.
    - `losses`: the mean squared residual at the start and after every step, in squared units of
      radiance; it jumps where the search goes on with less blur.
    - `uncertainty`: 6, a standard error for each part of the twist about the fitted pose, in
      its own axes: three of translation in scene units, three of rotation in radians. As if
      the residuals were independent: they are not, so compare the numbers with one another.
    - `share`: the share of the reference's pixels, a ratio, that had a say in the end.
    - `result`: optimistix' verdict on the sharpest pictures, and divergence where nothing of
      the source is seen in the end.
    """

    camera: PinholeCamera
    losses: Float[Array, " steps"]
    uncertainty: Float[Array, "6"]
    share: Float[Array, ""]
    result: optx.RESULTS

    @property
    def success(self) -> bool:
        """Whether the solver converged."""
        return bool(self.result == optx.RESULTS.successful)


def camera(
    reference: Float[ArrayLike, "rows columns channel"],
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    source: PinholeCamera,
    start: PinholeCamera,
    *,
    hole_threshold: Number = 0.1,
    solver: Solver | None = None,
    max_steps: WholeNumber = 32,
    throw: bool = True,
    progress: bool = False,
) -> CameraFit:
    """The pose from which a photograph was taken, given another one with its depth.

    Least squares between the photograph and the reprojection of the other, over a twist of six
    numbers about the start, from coarse to fine: both pictures are blurred by a sigma of a
    sixteenth of their side, then by half of that, and so on down to a pixel. The last blur
    stays: a reprojected picture is read between pixels, hence smoother than a photograph, and
    sharp ones would draw the pose to where both look equally smooth. The derivative is that of
    the point where a pixel's ray meets the depth.

    Silhouettes are left out: pixels that look next to a step in depth or to where the source
    saw nothing, and the pixels beside those. What comes into sight there is a change of
    visibility, which the derivative does not contain: the pixel's colour jumps from one
    surface's to another's while its derivative follows only the one that it shows. Kept, such
    pixels would pull the pose to where they happen to agree.

    It takes the scene to be lit and coloured alike in both pictures, highlights included, and
    finds the nearest minimum: a start more than a few degrees away, or a texture that repeats
    within that, may lead to a wrong one.

    **Arguments:**

    - `reference`: rows columns channel, linear radiance: the photograph whose pose is asked.
    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the axis of `source`; inf, and what is missing
      (0, negative, NaN), as in `reproject.warp`.
    - `source`: the camera of `image` and `depth`.
    - `start`: the reference's camera with its true intrinsics and a pose to start from: some
      3 degrees and 3 % of the scene's depth away. Of four pairs of photographs of a room with
      their depth, 160 x 120 pixels, two that lie 1.5 and 3.8 degrees apart (5 and 9 cm) were
      found from the source's own pose to 0.04 degrees and 2 mm; two that lie 7.7 degrees apart
      (14 and 26 cm) to 0.06 degrees and 2 mm, and to 0.4 degrees and 13 mm.
    - `hole_threshold`: as in `reproject.warp`, a ratio of depths.
    - `solver`: any least-squares solver or minimiser of optimistix; by default
      Levenberg-Marquardt.
    - `max_steps`: of the solver, for each blur.
    - `throw`: raise where the solver fails; else the failure stands in the result.
    - `progress`: show a bar on stderr; it needs the extra `plot`.

    **Returns:** a `CameraFit`.

    **Raises:** `ValueError` for wrong shapes, cameras or options, a picture that is not finite,
    or a depth that is nowhere known. `RuntimeError` where the solver fails or ends where
    nothing of the source is seen, and `throw` is true.

    **Gradient:** none through the search: it stops at every step to report.

    Source: Lucas & Kanade 1981, image registration, from coarse to fine; Murray, Li & Sastry
    1994, the exponential of a twist; the masks and the last blur are our own.
    """
    reference, image, depth = _pictures(reference, image, depth)
    max_steps = _check(source, start, max_steps)
    check_options("camera", reference.shape[:2], "pyramid", hole_threshold)
    with Bar(progress, "fit") as bar:
        descend_on = functools.partial(descend, solver=solver, max_steps=max_steps, bar=bar)
        model, end = _search(
            reference, image, depth, source, start, float(hole_threshold), descend_on
        )
    columns, residual, share = _report(model, end.unknowns)
    # Where nothing is seen the residual is 0, which a solver takes for success.
    result = end.result if share > 0 else verdict(optx.RESULTS.nonlinear_divergence)
    if throw and result != optx.RESULTS.successful:
        raise RuntimeError(
            f"`camera` found no pose in {len(end.losses)} steps, the mean squared residual "
            f"going from {end.losses[0]:.3g} to {end.losses[-1]:.3g} over "
            f"{100 * float(share):.0f} % of the pixels: {result} "
            "`throw=False` returns what was reached."
        )
    errors = standard_errors(columns, residual) / jnp.sqrt(share)
    errors = jnp.where(share > 0, errors, jnp.inf) * model.unit
    eye, losses = model.eye(end.unknowns), jnp.stack(end.losses)
    return CameraFit(eye, losses, errors, share, result)


def _search(
    reference: Array,
    image: Array,
    depth: Array,
    source: PinholeCamera,
    start: PinholeCamera,
    threshold: int | float,
    descend_on: Callable[["_Residual", Array], End],
) -> tuple["_Residual", End]:
    """From one blur to the next, and the model of the last."""
    known = jnp.isfinite(depth) & (depth > 0)
    reach = jnp.nanmedian(jnp.where(known, depth, jnp.nan)).astype(float)
    unit = jnp.concatenate([jnp.full(3, reach), jnp.ones(3, float)])
    clear = _clear_of_steps(depth, threshold)
    # One blur for both, in the world: a pixel of the coarser picture at the least.
    finer = float(source.intrinsics[0, 0] / start.intrinsics[0, 0])

    def model(sigma: float) -> _Residual:
        pictures = (
            _blurred(reference, jnp.asarray(sigma * max(1 / finer, 1))),
            _blurred(image, jnp.asarray(sigma * max(finer, 1))),
        )
        return _Residual(*pictures, depth, clear, source, start, unit, threshold)

    *coarse, sharpest = map(model, _sigmas(min(reference.shape[:2])))
    twist, losses = jnp.zeros(6, float), []
    for blurred in coarse:
        end = descend_on(blurred, twist)
        twist, losses = end.unknowns, losses + end.losses
    end = descend_on(sharpest, twist)
    return sharpest, end._replace(losses=losses + end.losses)


def _check(source: Any, start: Any, max_steps: Any) -> int:
    """The number of steps; `ValueError` names a camera or a number that is none."""
    for name, eye in (("source", source), ("start", start)):
        check_camera(f"camera({name})", eye, PinholeCamera)
    return whole_number("camera(max_steps=...)", max_steps)


def _pictures(reference: Any, image: Any, depth: Any) -> tuple[Array, Array, Array]:
    """The pictures, checked, in the type of `image`."""
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
    check("camera(depth)", depth, lambda v: (np.isfinite(v) & (v > 0)).any(), "known somewhere")
    return reference.astype(image.dtype), image, depth.astype(image.dtype)


def _sigmas(side: int) -> list[float]:
    """Of the blurs, in pixels, from coarse to fine."""
    halvings = int(math.log2(max(1, _WIDEST * side)))
    return [2.0**level for level in range(halvings, -1, -1)]


@jax.jit
def _blurred(image: Array, sigma: Array) -> Float[Array, "height width channel"]:
    """A Gaussian of what is inside the frame: one program for all sigmas."""

    def weights(size: int) -> Float[Array, "size size"]:
        place = jnp.arange(size, dtype=image.dtype) / sigma.astype(image.dtype)
        weight = jnp.exp(-0.5 * (place[:, None] - place[None]) ** 2)
        return weight / jnp.sum(weight, axis=1, keepdims=True)

    down, across = map(weights, image.shape[:2])
    return jnp.einsum("ij,jkc,lk->ilc", down, image, across)


def _largest(x: Array) -> Array:
    """The largest of 3 x 3."""
    return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (3, 3), (1, 1), "SAME")


@eqx.filter_jit
def _clear_of_steps(depth: Array, threshold: int | float) -> Bool[Array, "height width"]:
    """Where no step in depth is within two texels."""
    known = (depth > 0) & jnp.isfinite(depth)
    inverse = safe_divide(known.astype(depth.dtype), jnp.where(known, depth, 1))
    step = _largest(inverse) > (1 + threshold) * -_largest(-inverse)
    return _largest(step.astype(depth.dtype)) == 0


class _Residual(eqx.Module):
    """The reprojected picture less the reference, where both are known, from a pose."""

    reference: Float[Array, "rows columns channel"]
    image: Float[Array, "height width channel"]
    depth: Float[Array, "height width"]
    clear: Bool[Array, "height width"]
    source: PinholeCamera
    start: PinholeCamera
    unit: Float[Array, "6"]
    hole_threshold: int | float = eqx.field(static=True)

    def eye(self, twist: Float[Array, "6"]) -> PinholeCamera:
        """The start moved by a twist, in its own axes."""
        pose = self.start.world_from_camera
        moved = pose.astype(float) @ _rigid(twist * self.unit)
        return PinholeCamera(self.start.intrinsics, moved.astype(pose.dtype))

    def difference(self, twist: Float[Array, "6"]) -> tuple[Array, Float[Array, ""]]:
        """The residual, and the share of pixels that have a say in it."""
        rows, columns, _ = self.reference.shape
        pixels = pixel_centers(rows, columns, self.depth.dtype).reshape(-1, 2)
        options = {"method": "pyramid", "hole_threshold": self.hole_threshold}
        view = look(self.depth, self.source, self.eye(twist), pixels, **options)
        shown = bilinear(self.image, view.pixels).reshape(self.reference.shape)
        counts = view.mask & nearest(self.clear, view.pixels)
        ignored = (~counts).astype(shown.dtype).reshape(rows, columns)
        counts = 1 - _largest(jax.lax.stop_gradient(ignored))
        # By the root of their share: to look away from what differs shall not pay.
        share = jnp.mean(counts)
        weight = counts / jnp.sqrt(jnp.maximum(share, 1 / counts.size))
        residual = (shown - self.reference) * jnp.broadcast_to(weight[..., None], shown.shape)
        return residual.astype(float), share

    def __call__(self, twist: Float[Array, "6"]) -> Float[Array, "rows columns channel"]:
        return self.difference(twist)[0]


@eqx.filter_jit
def _report(model: _Residual, twist: Array) -> tuple[Array, Array, Array]:
    """The columns of the Jacobian, the residual, and the share of pixels in it."""

    def difference(twist: Array) -> tuple[Array, tuple[Array, Array]]:
        residual, share = model.difference(twist)
        return residual, (residual, share)

    columns, (residual, share) = jax.jacfwd(difference, has_aux=True)(twist)
    return columns.reshape(-1, 6), residual, share.astype(float)


def _rigid(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """The rigid motion of a twist: three of translation, three of rotation, in radians."""
    generator = jnp.zeros((4, 4), twist.dtype).at[:3, 3].set(twist[:3])
    x, y, z = twist[3:]
    zero = jnp.zeros_like(x)
    turn = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    return jax.scipy.linalg.expm(generator.at[:3, :3].set(turn))
