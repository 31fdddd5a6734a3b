"""Depth of field by scattering every pixel over its circle of confusion."""

import functools as ft
import math
from collections.abc import Callable
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, WholeNumber, check, is_concrete, option, parameter
from jaxfx._meshes import on_any_mesh
from jaxfx._platform import either
from jaxfx.dof.arguments import (
    check_arguments,
    check_margin,
    largest_of,
    pixels,
    with_own,
    without_margin,
)
from jaxfx.dof.iris import Iris, areas, check_iris, outline
from jaxfx.dof.kernels._adjoint import with_adjoint
from jaxfx.dof.kernels._chords import Shaped, near_reach, painted, taps
from jaxfx.dof.kernels._rows import ROWS
from jaxfx.dof.kernels._segment_sum import COVERAGES, segment_sum
from jaxfx.dof.kernels._spans import SPANS
from jaxfx.dof.kernels._taps import Planes, to_planes
from jaxfx.dof.kernels._tiles import SHIFTS, TILES, farthest, plain
from jaxfx.dof.spoiled import spoiled
from jaxfx.dof.sprites import POINT_RADIUS, Sprites, reach
from jaxfx.lens import Lens


Program = Literal["auto", "segment_sum", "shift", "tiles", "spans", "rows"]
Coverage = Literal["area", "indicator"]

_PROGRAMS = {"shift": SHIFTS, "tiles": TILES, "spans": SPANS, "rows": ROWS}

# For `cheapest`: seconds, and nanoseconds per pixel, per row of a pixel, per computed tap, as
# measured on two cores.
_SECONDS: dict[Any, tuple[float, float, float, float]] = {
    "shift": (0.0, 40.0, 0.0, 1.5),
    "tiles": (0.01, 20.0, 0.0, 0.5),
    "spans": (0.02, 80.0, 6.0, 0.0),
}

# Largest logarithm of an amplification: sums with highlights stay finite in float32.
_LOG_VISIBILITY = 60.0
# Least epsilon, in pixels: no two circles of confusion of an image are so near. Guards a
# quotient.
_SMALLEST_EPSILON = 1e-6


@on_any_mesh
def scatter(
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    lens: Lens,
    *,
    gamma: Float[ArrayLike, ""] | float = 0.0,
    epsilon: Float[ArrayLike, ""] | float = 2.0,
    max_coc: Number | None = None,
    iris: Iris | None = None,
    margin: WholeNumber = 0,
    program: Program = "auto",
    coverage: Coverage = "area",
) -> Float[Array, "rows columns channel"]:
    """Depth of field by point sprites: every pixel is spread over its circle of confusion.

    It is the method whose `gamma` and `epsilon` are fitted to a scene (`fit.dof`), with exact
    derivatives of first and second order. `gamma` is no display gamma.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background; 0, negative
      or NaN where it is missing.
    - `lens`: gives each depth its signed defocus, in pixels.
    - `gamma`: amplification of the foreground, no unit; 0 is none. Amplification is limited
      to e**60.
    - `epsilon`: pixels; circles of confusion below it count as in focus.
    - `max_coc`: static; the largest diameter, in pixels. Larger sprites are clamped to it.
      Outside `jit`, `grad` and `vmap` it may be left out and is then taken from the data.
    - `iris`: the shape of the sprites; by default the disc. It goes with the programs `"auto"`,
      `"shift"` and `"spans"`, which then are others than for the disc, the same on every
      device, and slower.
    - `margin`: static; pixels. By so much the images that are given are larger on each side
      than what is returned: what lies beyond the frame is not in its border else. The corner of
      an iris' `vignetting` is that of what is returned.
    - `program`: which program computes the sums; the result is the same. `"segment_sum"` writes
      every tap out (the oracle, memory in pixels times taps), `"shift"` adds one shifted image
      an offset, `"tiles"` does so tile by tile, each only as far as the sprites that reach it,
      `"spans"` paints large sprites row by row with running sums, at a cost that grows with the
      radius, not its square, `"rows"` adds all offsets of a row at once over the whole image.
      `"auto"` is `"rows"` where the program is compiled for an accelerator; on a CPU it is the
      cheapest of the three before it by a model of their time, outside of transforms for the
      largest circle in the data, else for `max_coc`.
    - `coverage`: `"area"`, the exact area of the disc in each row of pixels, or `"indicator"`,
      the paper's own, 1 where a pixel's centre lies inside (`"segment_sum"` only).

    **Returns:** height width channel, without the margin, in the type of `image`. A pixel whose
    colour is not a number spoils what its sprite can reach, and no more. One whose depth is
    missing has no sprite: it shows what reaches it or, where nothing does, its own colour.

    **Raises:** `ValueError` for a wrong shape, an integer image, no lens, a negative `gamma` or
    `epsilon`, an unknown option, a program that does not take an iris, a `margin` that leaves
    nothing, or no `max_coc` under a transform.

    **Gradient:** exact with respect to `image`, `depth`, `gamma`, `epsilon` and every field of
    `lens` and `iris`, silhouettes included, forward and reverse; again by
    `jax.jacfwd(jax.grad(loss))`, which `jax.hessian` is. In `lens` and `depth`, zero where a
    circle of confusion is below a pixel or above `max_coc`: a search cannot leave a lens all of
    whose circles are. At a kink (the focus plane, the ends of both clamps) one of the two
    one-sided values. With `coverage="indicator"` that of the coverage, almost everywhere zero,
    is missing.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import ThinLens, dof
    >>> image, depth = jnp.ones((8, 8, 3)), jnp.full((8, 8), 4.0)
    >>> lens = ThinLens(aperture=0.1, focus_distance=2.0, focal_pixels=100.0)
    >>> dof.scatter(image, depth, lens, gamma=0.5).shape
    (8, 8, 3)

    The result at target pixel q is the mean of all source pixels p, weighted by
    `K * coverage(q - p; C_p / 2) / area(C_p / 2)`, with C the diameter of the circle of
    confusion and

    - `K = (focus_distance / depth_p) ** gamma` for a foreground pixel (virtual visibility),
    - `K = 1 - clamp((C_p - C_q) / epsilon) * (1 - clamp(C_q / epsilon - 1))` for any other:
      so that background does not leak onto pixels in focus.

    Source: Lee, Kim & Choi, real-time depth of field rendering using pixel intensity scatter on
    GPU, sections 3 and 4; the model is that of Potmesil & Chakravarty 1981. Our own: the exact
    row area as coverage, whose sum over pixels is the disc's area at any radius, so that energy
    is conserved, a pixel in focus is untouched, and the derivative in the radius exists; and
    the split by which `"spans"` carry the leak rejection exactly (a source of 3 epsilon or more
    has the same factor `clamp(C_q / epsilon - 1)` from every pixel behind the focus).
    """
    image, depth, lens, max_coc = check_arguments("scatter", image, depth, lens, max_coc)
    gamma = parameter("scatter(gamma=...)", gamma)
    epsilon = parameter("scatter(epsilon=...)", epsilon)
    check("scatter(gamma=...)", gamma, lambda v: v >= 0, "0 or positive")
    check("scatter(epsilon=...)", epsilon, lambda v: v >= 0, "0 or positive")
    margin = check_margin("scatter", margin, depth)
    option("scatter(program=...)", program, get_args(Program))
    option("scatter(coverage=...)", coverage, tuple(COVERAGES))
    if coverage == "indicator" and program != "segment_sum":
        raise ValueError(
            '`scatter(coverage="indicator")` must go with `program="segment_sum"`, '
            f"got {program!r}."
        )
    if iris is not None:
        iris = check_iris("scatter(iris=...)", iris)
        shaped = _with_iris(image, depth, lens, iris, gamma, epsilon, max_coc, program, margin)
        return without_margin(shaped, margin)
    if program == "auto":
        # From the data where they can be looked at, else from what they may hold; the programs
        # themselves go no farther, tile by tile, than what they do hold.
        largest = largest_of("scatter", depth, lens)
        room = max_coc if largest is None else min(max_coc, largest)
        height, width = depth.shape
        programs = cheapest(height, width, room), "rows"
    else:
        programs = program, program
    result = _scatter(image, depth, lens, gamma, epsilon, max_coc, programs, coverage)
    return without_margin(result, margin)


def to_sprites(
    image: Float[Array, "height width channel"],
    depth: Float[Array, "height width"],
    lens: Lens,
    gamma: Float[Array, ""],
    epsilon: Float[Array, ""],
    max_coc: int | float,
    missing: Bool[Array, "height width"],
    area: Float[Array, "*size"] | float = math.pi,
) -> Sprites:
    """The sprites of an image, in its type; none where the depth is missing.

    `area` is that of a sprite of radius 1, of all or of each.
    """
    dtype = image.dtype
    coc = lens.circle_of_confusion(depth)
    coc = jnp.where(coc < max_coc, coc, max_coc)
    radius = jnp.where(coc / 2 < POINT_RADIUS, POINT_RADIUS, coc / 2)

    focus = lens.focus_distance.astype(dtype)
    foreground = depth < focus
    nearness = jnp.where(foreground, focus / jnp.where(foreground, depth, focus), 1)
    nearness = jnp.minimum(nearness, jnp.finfo(dtype).max)  # at depth 0 under a transform
    log_visibility = gamma.astype(dtype) * jnp.log(nearness)
    visibility = jnp.exp(jnp.minimum(log_visibility, _LOG_VISIBILITY))

    one = jnp.ones_like(image[..., :1])
    weight = visibility / (area * radius * radius)
    value = jnp.concatenate([image, one], axis=-1) * weight[..., None]
    value = jnp.where(missing[..., None], 0, value)
    epsilon = jnp.maximum(epsilon.astype(dtype), _SMALLEST_EPSILON)
    leak = jnp.where(foreground, -1, coc)
    # Onto a pixel whose depth is missing everything leaks: which part should is not known.
    return Sprites(value, radius, leak, jnp.where(missing, max_coc, coc), epsilon)


@ft.partial(jax.custom_jvp, nondiff_argnums=(6, 7, 8))
def _in_or_out_of_focus(
    image, depth, lens, gamma, epsilon, missing, max_coc, programs, coverage
):
    """The blurred image; an image wholly in focus is returned as it is, without the sums."""
    blurred = ft.partial(_blurred, max_coc=max_coc, programs=programs, coverage=coverage)

    def is_sharp(_, depth, lens, *__):
        return (lens.circle_of_confusion(depth) < 2 * POINT_RADIUS).all()

    operands = image, depth, lens, gamma, epsilon, missing
    return either(is_sharp, lambda image, *_: image, blurred, *operands)


@_in_or_out_of_focus.defjvp
def _in_or_out_of_focus_jvp(max_coc, programs, coverage, primals, tangents):
    blurred = ft.partial(_blurred, max_coc=max_coc, programs=programs, coverage=coverage)
    return jax.jvp(blurred, primals, tangents)


def _blurred(image, depth, lens, gamma, epsilon, missing, max_coc, programs, coverage):
    """The sums of colours over the sums of weights, for finite pixels."""
    # Rematerialised: a reverse pass keeps the sprites, not the twenty planes behind them.
    rematerialised = jax.checkpoint(to_sprites, static_argnums=5)
    sprites = rematerialised(image, depth, lens, gamma, epsilon, max_coc, missing)
    if "segment_sum" in programs:
        sums = segment_sum(sprites, reach(max_coc), coverage)
    else:
        planes = _program(*programs)(reach(max_coc), to_planes(sprites))
        sums = jnp.moveaxis(planes, 0, -1)
    return _quotient(with_own(sums, image, missing))


@ft.cache
def _program(cpu: str, accelerator: str) -> Callable[[int, Planes], Array]:
    """The sums by program `cpu` if lowered for a CPU, by `accelerator` elsewhere."""
    return with_adjoint(_PROGRAMS[cpu], plain, _PROGRAMS[accelerator])


@jax.custom_jvp
def _quotient(
    sums: Float[Array, "height width value"],
) -> Float[Array, "height width channel"]:
    """The channels over the weight; its derivative squares no weight, which could underflow."""
    return sums[..., :-1] / sums[..., -1:]


@_quotient.defjvp
def _quotient_jvp(primals, tangents):
    (sums,), (dot,) = primals, tangents
    result = _quotient(sums)
    return result, (dot[..., :-1] - result * dot[..., -1:]) / sums[..., -1:]


def cheapest(height: int, width: int, max_coc: int | float) -> Program:
    """The program that takes a CPU least for an image whose every sprite is the largest.

    Seconds are modelled as `fixed + pixels * (once + row * rows + tap * rows * columns)`, with
    `2 * reach + 1` rows and, in tiles, as many columns as their runs of taps come to; the
    constants were measured on two cores. What is fixed stands for the
    time that a program takes to compile, shared by a few dozen images.
    """
    pixels, far = height * width, reach(max_coc)
    rows = 2 * far + 1

    def seconds(program: str) -> float:
        fixed, once, row, tap = _SECONDS[program]
        columns = 2 * farthest(far) + 1 if program == "tiles" else rows
        return fixed + 1e-9 * pixels * (once + row * rows + tap * rows * columns)

    return min(_SECONDS, key=seconds)


@ft.partial(jax.jit, static_argnames=("max_coc", "programs", "coverage"))
def _scatter(image, depth, lens, gamma, epsilon, max_coc, programs, coverage):
    seen = pixels(image, depth, lens)
    operands = seen.image, seen.depth, lens, gamma, epsilon, seen.missing
    result = _in_or_out_of_focus(*operands, max_coc, programs, coverage)
    spoils = spoiled(seen.bad, lens.circle_of_confusion(seen.depth), max_coc) | seen.lost
    return jnp.where(spoils[..., None], jnp.nan, result).astype(image.dtype)


# Up to this reach, in pixels, all taps are visited; beyond, spans are quicker on two cores.
_FEW_ROWS = 4


def _with_iris(image, depth, lens, iris, gamma, epsilon, max_coc, program, margin):
    """`scatter` by sprites of another shape than the disc."""
    if program not in ("auto", "shift", "spans"):
        raise ValueError(
            '`scatter(iris=...)` must go with `program` "auto", "shift" or "spans", '
            f"got {program!r}."
        )
    is_known = is_concrete(epsilon)
    if program == "auto":
        is_small = reach(max_coc) <= _FEW_ROWS or not is_known
        program = "shift" if is_small else "spans"
    near = None
    if program == "spans":
        near = near_reach(float(epsilon), max_coc) if is_known else reach(max_coc)
    return _scatter_shape(image, depth, lens, iris, gamma, epsilon, max_coc, near, margin)


@ft.partial(jax.jit, static_argnames=("max_coc", "near", "margin"))
def _scatter_shape(image, depth, lens, iris, gamma, epsilon, max_coc, near, margin):
    """By `taps` or, where it is known how far those that stay taps go, by `painted`."""
    seen = pixels(image, depth, lens)
    dtype = seen.image.dtype
    rematerialised = jax.checkpoint(to_sprites, static_argnums=5)
    operands = seen.image, seen.depth, lens, gamma, epsilon, max_coc, seen.missing
    shape = outline(iris, dtype, seen.depth.shape, margin)
    area = iris.area().astype(dtype) if shape.rim is None else areas(shape)
    sprites = rematerialised(*operands, area)
    side = jnp.where(lens.defocus(seen.depth) < 0, -1, 1).astype(dtype)
    shaped = Shaped(sprites, side, shape)
    far = reach(max_coc)
    sums = taps(shaped, far) if near is None else painted(shaped, far, near)
    result = _quotient(with_own(sums, seen.image, seen.missing))
    spoils = spoiled(seen.bad, lens.circle_of_confusion(seen.depth), max_coc) | seen.lost
    return jnp.where(spoils[..., None], jnp.nan, result).astype(image.dtype)
