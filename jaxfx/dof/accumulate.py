"""The multi-pass reference: many pinhole images through one lens, averaged."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfx._arguments import check_camera, check_lens
from jaxfx._arrays import ArrayLike
from jaxfx._checks import WholeNumber, check_image, parameter, whole_number
from jaxfx._numerics import safe_sqrt, working_dtype
from jaxfx._progress import counted
from jaxfx.camera import PinholeCamera
from jaxfx.dof.iris import Iris, Points, check_iris, let_through, points_of
from jaxfx.lens import ThinLens


# Weight of a pass that a pixel does not see, beside about 1 for one that it does: of few passes
# it may see none, and shows their mean. Larger, and it would show beside those that are seen.
_LEAST = 1e-9


class Accumulation(NamedTuple):
    """The result of `accumulate`.

    - `image`: height width channel, the mean of all passes, linear radiance.
    - `convergence`: the root-mean-square difference between the mean of the first half of the
      passes and the mean of all, over the pixels that are finite, in units of radiance; NaN for
      a single pass.
    """

    image: Float[Array, "height width channel"]
    convergence: Float[Array, ""]


def accumulate(
    render: Callable[[PinholeCamera], ArrayLike],
    camera: PinholeCamera,
    lens: ThinLens,
    *,
    samples: WholeNumber = 256,
    iris: Iris | None = None,
    jitter: bool = True,
    seed: WholeNumber = 0,
    progress: bool = False,
) -> Accumulation:
    """Depth of field by many passes: the mean of images from points all over the lens.

    It is the reference that the other methods approach. The points cover the disc with equal
    area, by a low-discrepancy sequence whose every prefix covers it too.

    **Arguments:**

    - `render`: from a camera to an image, height width channel, linear radiance. Anything
      serves: a rasteriser, a ray tracer, a reprojection of one image. Integers are taken as
      they are, for floats.
    - `camera`: the pinhole camera at the lens' centre.
    - `lens`: its `aperture` and `focus_distance` are used, in scene units.
    - `samples`: static; how many passes.
    - `iris`: the shape of the lens' opening; by default the disc. Its points are those of the
      disc's sequence that lie in it. With `vignetting` each pixel has the mean of the passes
      whose points it sees past the rim; with a `profile` a mean weighted by that.
    - `jitter`: move each pass within a pixel too, which antialiases the mean by a box of one
      pixel.
    - `seed`: static; an integer from 0, scrambles the sequence in another way.
    - `progress`: show a bar on stderr; it needs the extra `plot`.

    **Returns:** an `Accumulation`: `image`, height width channel, in the renderer's float type
    (JAX's default for integers), summed in float32 at least; and `convergence`.

    **Raises:** `ValueError` where `samples` is not a positive integer, the lens is not a
    `ThinLens`, `iris` is no `Iris`, or `render` returns no image, or images of different
    shapes.

    **Gradient:** that of `render`, through its camera: exact in the aperture, the focus
    distance, the camera, and the iris' `rotation`, `squeeze` and `profile`, where `render` is;
    with `vignetting` that of the rim is missing from those in `rotation`. A rasteriser's is
    zero or missing. `roundness` and `vignetting` must not be traced.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import PinholeCamera, ThinLens, dof
    >>> camera = PinholeCamera.from_fov(1.0, height=8, width=8)
    >>> lens = ThinLens.from_camera(camera, aperture=0.1, focus_distance=2.0)
    >>> dof.accumulate(lambda eye: jnp.ones((8, 8, 3)), camera, lens, samples=4).image.shape
    (8, 8, 3)

    All cameras share the plane in focus. Where the rim cuts the opening follows from the pixel
    that light arrives at; in the effects, from the one that it comes from. They differ by
    `vignetting` times the radius over half the diagonal.

    Source: Haeberli & Akeley 1990, the accumulation buffer. The sequence is Sobol's of 1967 in
    four dimensions, scrambled (Matousek 1998), by SciPy.
    """
    check_camera("accumulate(camera)", camera, PinholeCamera)
    if not isinstance(lens, ThinLens):
        raise ValueError(f"`accumulate(lens)` must be a ThinLens, got {type(lens).__name__}.")
    check_lens("accumulate(lens)", lens)
    samples = whole_number("accumulate(samples=...)", samples)
    seed = whole_number("accumulate(seed=...)", seed, lambda n: n >= 0, "an integer from 0")

    offsets, shifts = lens_samples(samples, seed)
    points = None
    if iris is not None:
        iris = check_iris("accumulate(iris=...)", iris)
        points, shifts = iris_samples(iris, samples, seed)
        offsets = points.squeezed / 2
        if iris.vignetting is None and iris.profile is None:
            points = None
    total = half = dtype = None
    weights = 0
    for index in counted(range(samples), progress, "lens"):
        offset = lens.aperture * jnp.asarray(offsets[index], lens.aperture.dtype)
        eye = camera.through_lens(offset, focus_distance=lens.focus_distance)
        if jitter:
            eye = _shifted(eye, shifts[index])
        name = "accumulate(render)"
        image = check_image(name, parameter(name, render(eye), None))
        dtype = image.dtype
        image = image.astype(working_dtype(dtype))
        if total is not None and image.shape != total.shape:
            raise ValueError(
                "`accumulate(render)` must give images of one shape, got "
                f"{total.shape}, then {image.shape}."
            )
        weight = 1
        if iris is not None and points is not None:
            height, width, _ = image.shape
            point = points.unit[index], jnp.asarray(points.held[index])
            weight = let_through(iris, *point, height, width, image.dtype)
            weight = jnp.maximum(weight, _LEAST)[..., None]
            image = weight * image
        weights = weights + weight
        total = image if total is None else total + image
        if index + 1 == samples // 2:
            half = total / weights
    assert total is not None
    mean = total / weights
    if half is None:
        return Accumulation(mean.astype(dtype), jnp.asarray(jnp.nan, mean.dtype))
    return Accumulation(mean.astype(dtype), _root_mean_square(half - mean))


def _root_mean_square(difference: Float[Array, "..."]) -> Float[Array, ""]:
    """Of the numbers that are finite; NaN where none is."""
    finite = jnp.isfinite(difference)
    squares = jnp.where(finite, difference, 0) ** 2
    return safe_sqrt(jnp.sum(squares) / jnp.sum(finite, dtype=squares.dtype))


def lens_samples(
    samples: int, seed: int = 0
) -> tuple[Float[np.ndarray, "samples 2"], Float[np.ndarray, "samples 2"]]:
    """Points on a disc of diameter 1, and offsets within a pixel, each in [-1/2, 1/2]."""
    # Imported here: it takes half a second, which `import jaxfx.dof` should not.
    from scipy.stats import qmc

    sequence = qmc.Sobol(4, rng=np.random.default_rng(seed))
    u = sequence.random_base2(max(samples - 1, 1).bit_length())[:samples]
    radius, angle = np.sqrt(u[:, 0]) / 2, 2 * np.pi * u[:, 1]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1), u[:, 2:] - 0.5


def iris_samples(
    iris: Iris, samples: int, seed: int = 0
) -> tuple[Points, Float[np.ndarray, "samples 2"]]:
    """The same for an iris: the first points of the disc's sequence that lie in it.

    On a disc of radius 1.
    """
    # The least share of the disc that an iris has: that of the triangle, 0.41.
    offsets, shifts = lens_samples(4 * samples + 16, seed)
    points = points_of(iris, 2 * offsets)
    chosen = np.flatnonzero(points.held[:, -1])[:samples]
    unit, squeezed, held = points
    return Points(unit[chosen], squeezed[chosen], held[chosen]), shifts[chosen]


def _shifted(camera: PinholeCamera, shift: Float[np.ndarray, "2"]) -> PinholeCamera:
    move = jnp.asarray(shift, camera.intrinsics.dtype)
    return PinholeCamera(camera.intrinsics.at[:2, 2].add(move), camera.world_from_camera)
