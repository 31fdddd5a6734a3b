"""Depth of field by scattering every pixel over its circle of confusion."""

import functools as ft
import math
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfx._numerics import (
    check,
    check_depth,
    check_image,
    is_concrete,
    parameter,
    working_dtype,
)
from jaxfx.dof._segment_sum import COVERAGES, segment_sum
from jaxfx.dof._spans import spans
from jaxfx.dof._spoiled import spoiled
from jaxfx.dof._sprites import POINT_RADIUS, Sprites, reach
from jaxfx.dof._tiles import farthest, shifts, tiles
from jaxfx.lens import FocusPlanes, ThinLens


Kernel = Literal["auto", "segment_sum", "shift", "tiles", "spans"]
Coverage = Literal["area", "indicator"]

# For `cheapest`: seconds, and nanoseconds a pixel, a pixel's row, a tap that is computed.
_SECONDS: dict[Any, tuple[float, float, float, float]] = {
    "shift": (0.0, 40.0, 0.0, 1.5),
    "tiles": (0.01, 20.0, 0.0, 0.5),
    "spans": (0.02, 80.0, 6.0, 0.0),
}

# Visibility stays below e**60, so that its sums with highlights are finite in float32.
_LOG_VISIBILITY = 60.0
# An epsilon below this is this: no two circles of confusion of a picture lie so near.
_SMALLEST_EPSILON = 1e-6


def scatter(
    image: Float[ArrayLike, "height width channel"],
    depth: Float[ArrayLike, "height width"],
    lens: ThinLens | FocusPlanes,
    *,
    gamma: Float[ArrayLike, ""] | float = 0.0,
    epsilon: Float[ArrayLike, ""] | float = 2.0,
    max_coc: int | float | None = None,
    kernel: Kernel = "auto",
    coverage: Coverage = "area",
) -> Float[Array, "height width channel"]:
    """Depth of field by point sprites: every pixel is spread over its circle of confusion.

    The result at q is the mean of all pixels p, weighted by
    `K * coverage(q - p; C_p / 2) / area(C_p / 2)`, with C the diameter of the circle of
    confusion and

    - `K = (focus_distance / depth_p) ** gamma` for a foreground pixel (virtual visibility),
    - `K = 1 - clamp((C_p - C_q) / epsilon) * (1 - clamp(C_q / epsilon - 1))` for any other:
      background is kept from leaking onto what is in focus.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background.
    - `lens`: gives each depth its signed defocus, in pixels.
    - `gamma`: amplification of the foreground, no unit; 0 is none. Amplification is limited
      to e**60.
    - `epsilon`: pixels; circles of confusion below it count as in focus.
    - `max_coc`: static; the largest diameter, in pixels. Larger sprites are clamped to it.
      Outside `jit`, `grad` and `vmap` it may be left out and is then taken from the data.
    - `kernel`: which program computes the sums, all the same: `"segment_sum"` writes every tap
      out (the oracle, memory in pixels times taps), `"shift"` adds one shifted image an
      offset, `"tiles"` does so tile by tile, each only as far as the sprites that reach it,
      `"spans"` paints large sprites row by row with running sums, at a cost that grows with the
      radius, not its square. `"auto"` is the cheapest of the last three by a model of their
      time: outside of transforms for the largest circle in the data, else for `max_coc`.
    - `coverage`: `"area"`, the exact area of the disc in each row of pixels, or `"indicator"`,
      the paper's own, 1 where a pixel's centre lies inside (`"segment_sum"` only).

    **Returns:** height width channel, in the type of `image`. A pixel whose colour or depth is
    not a number spoils what its sprite can reach, `max_coc` where that is unknown, and no more.

    **Raises:** `ValueError` for a wrong shape, an integer image, a depth that is not positive,
    a negative `gamma` or `epsilon`, an unknown option, or no `max_coc` under a transform.

    **Gradient:** exact with respect to `image`, `depth`, `gamma`, `epsilon` and every field of
    `lens`, silhouettes included, forward and reverse; again by `jax.jacfwd(jax.grad(loss))`,
    which `jax.hessian` is. In `lens` and `depth`, zero where a circle of confusion is below a
    pixel or above `max_coc`: no search leaves a lens all of whose circles are. At a kink (the
    focus plane, the ends of both clamps) one of the two one-sided values. With
    `coverage="indicator"` that of the coverage, almost everywhere zero, is missing.

    Source: Lee, Kim & Choi, real-time depth of field rendering using pixel intensity scatter on
    GPU, sections 3 and 4; the model is that of Potmesil & Chakravarty 1981. Our own: the exact
    row area as coverage, whose sum over pixels is the disc's area at any radius, so that energy
    is conserved, a pixel in focus is untouched, and the derivative in the radius exists; and
    the split by which `"spans"` carry the leak rejection exactly (a source of 3 epsilon or more
    has the same factor `clamp(C_q / epsilon - 1)` from every pixel behind the focus).
    """
    image = check_image("scatter(image)", image)
    depth = check_depth("scatter(depth)", depth, image.shape[:2])
    gamma = parameter("scatter(gamma=...)", gamma)
    epsilon = parameter("scatter(epsilon=...)", epsilon)
    check("scatter(gamma=...)", gamma, lambda v: v >= 0, "0 or positive")
    check("scatter(epsilon=...)", epsilon, lambda v: v >= 0, "0 or positive")
    if kernel not in get_args(Kernel):
        raise ValueError(
            f"`scatter(kernel=...)` must be one of {get_args(Kernel)}, got {kernel!r}."
        )
    if coverage not in COVERAGES:
        raise ValueError(
            f"`scatter(coverage=...)` must be one of {tuple(COVERAGES)}, got {coverage!r}."
        )
    if coverage == "indicator" and kernel != "segment_sum":
        raise ValueError(
            '`scatter(coverage="indicator")` must go with `kernel="segment_sum"`, '
            f"got {kernel!r}."
        )
    max_coc = largest_coc("scatter", depth, lens) if max_coc is None else max_coc
    if not (isinstance(max_coc, int | float) and 0 < max_coc < math.inf):
        raise ValueError(f"`scatter(max_coc=...)` must be positive, got {max_coc}.")
    if kernel == "auto":
        # From the data where they can be looked at, else from what they may hold; the kernels
        # themselves go no farther, tile by tile, than what they do hold.
        room = max_coc
        if is_concrete(depth, lens):
            room = min(room, _largest(depth, lens))
        height, width = depth.shape
        kernel = cheapest(height, width, room)
    return _scatter(image, depth, lens, gamma, epsilon, float(max_coc), kernel, coverage)


def largest_coc(
    function: str, depth: Float[Array, "height width"], lens: ThinLens | FocusPlanes
) -> float:
    """The largest circle of confusion of concrete data, rounded up, in pixels.

    Rounded to about eight steps an octave, so that near-by lenses share a compiled program.
    """
    if not is_concrete(depth, lens):
        raise ValueError(
            f"`{function}(max_coc=...)` must be given under `jit`, `grad` and `vmap`, where it "
            "can't be taken from the data: a static diameter in pixels, got None."
        )
    largest = _largest(depth, lens)
    if not math.isfinite(largest):
        raise ValueError(
            f"`{function}(max_coc=...)` must be given where a circle of confusion is not "
            f"finite, got None and a largest circle of {largest}."
        )
    step = 2 ** max(0, math.floor(math.log2(max(largest, 1))) - 2) / 2
    return max(1.0, math.ceil(largest / step) * step)


def _largest(depth: Float[Array, "height width"], lens: ThinLens | FocusPlanes) -> float:
    """The largest circle of concrete data that is a number, inside of another trace as well."""
    with jax.ensure_compile_time_eval():
        return float(jnp.nanmax(lens.circle_of_confusion(depth)))


def to_sprites(
    image: Float[Array, "height width channel"],
    depth: Float[Array, "height width"],
    lens: ThinLens | FocusPlanes,
    gamma: Float[Array, ""],
    epsilon: Float[Array, ""],
    max_coc: int | float,
) -> Sprites:
    """The sprites of an image, in its type."""
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
    weight = visibility / (jnp.pi * radius * radius)
    value = jnp.concatenate([image, one], axis=-1) * weight[..., None]
    epsilon = jnp.maximum(epsilon.astype(dtype), _SMALLEST_EPSILON)
    return Sprites(value, radius, jnp.where(foreground, -1, coc), coc, epsilon)


@ft.partial(jax.custom_jvp, nondiff_argnums=(5, 6, 7))
def _in_or_out_of_focus(image, depth, lens, gamma, epsilon, max_coc, kernel, coverage):
    """A picture wholly in focus is itself; its derivative is computed like any other."""
    blurred = ft.partial(_blurred, max_coc=max_coc, kernel=kernel, coverage=coverage)

    # A batch is worked through one by one: each of its pictures may be sharp or not.
    @sequential_vmap
    def picture(image, depth, lens, gamma, epsilon):
        sharp = (lens.circle_of_confusion(depth) < 2 * POINT_RADIUS).all()
        operands = image, depth, lens, gamma, epsilon
        return jax.lax.cond(sharp, lambda image, *_: image, blurred, *operands)

    return picture(image, depth, lens, gamma, epsilon)


@_in_or_out_of_focus.defjvp
def _in_or_out_of_focus_jvp(max_coc, kernel, coverage, primals, tangents):
    blurred = ft.partial(_blurred, max_coc=max_coc, kernel=kernel, coverage=coverage)
    return jax.jvp(blurred, primals, tangents)


def _blurred(image, depth, lens, gamma, epsilon, max_coc, kernel, coverage):
    """The quotient of the two sums, for finite pixels."""
    # Rematerialised: a reverse pass keeps the sprites, not the twenty planes they are made of.
    made = jax.checkpoint(to_sprites, static_argnums=5)
    sprites = made(image, depth, lens, gamma, epsilon, max_coc)
    if kernel == "segment_sum":
        sums = segment_sum(sprites, reach(max_coc), coverage)
    else:
        kernels = {"shift": shifts, "tiles": tiles, "spans": spans}
        sums = kernels[kernel](sprites, reach(max_coc))
    return _quotient(sums)


@jax.custom_jvp
def _quotient(
    sums: Float[Array, "height width value"],
) -> Float[Array, "height width channel"]:
    """The channels over the weight. As the rule states it, a weight is never squared."""
    return sums[..., :-1] / sums[..., -1:]


@_quotient.defjvp
def _quotient_jvp(primals, tangents):
    (sums,), (dot,) = primals, tangents
    result = _quotient(sums)
    return result, (dot[..., :-1] - result * dot[..., -1:]) / sums[..., -1:]


def cheapest(height: int, width: int, max_coc: int | float) -> Kernel:
    """The kernel that takes least for a picture whose every sprite is the largest.

    Seconds are modelled as `fixed + pixels * (once + row * rows + tap * rows * columns)`, with
    `2 * reach + 1` rows and, in tiles, as many columns as their runs of taps come to; the
    constants were measured on two cores. What is fixed stands for the
    time that a kernel takes to compile, shared by a few dozen pictures.
    """
    pixels, far = height * width, reach(max_coc)
    rows = 2 * far + 1

    def seconds(kernel: str) -> float:
        fixed, once, row, tap = _SECONDS[kernel]
        columns = 2 * farthest(far) + 1 if kernel == "tiles" else rows
        return fixed + 1e-9 * pixels * (once + row * rows + tap * rows * columns)

    return min(_SECONDS, key=seconds)


@ft.partial(jax.jit, static_argnames=("max_coc", "kernel", "coverage"))
def _scatter(image, depth, lens, gamma, epsilon, max_coc, kernel, coverage):
    dtype = image.dtype
    image = image.astype(working_dtype(dtype))
    depth = depth.astype(image.dtype)

    given, coc = depth, lens.circle_of_confusion(depth)
    lost = jnp.isnan(coc) | (depth < 0)
    wrong = lost | ~jnp.isfinite(image).all(axis=-1)
    image = jnp.where(wrong[..., None], 0, image)
    depth = jnp.where(lost, lens.focus_distance.astype(image.dtype), depth)

    result = _in_or_out_of_focus(image, depth, lens, gamma, epsilon, max_coc, kernel, coverage)
    spoils = spoiled(wrong, given, lens, max_coc)
    return jnp.where(spoils[..., None], jnp.nan, result).astype(dtype)
