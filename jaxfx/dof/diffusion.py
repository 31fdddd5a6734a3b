"""Depth of field as the flow of heat, explicit or implicit.

Heat that flows for a time t with conductance g spreads a point by a variance of 2 g t along
each axis. A disc of diameter C has C^2 / 16. So a pixel's conductance, for a time of 1, is
C^2 / 32, and a border between two pixels conducts as the less blurred of them does: nothing
flows into or out of what is in focus. The conductance is symmetric, so that energy is kept.
"""

import functools as ft
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, check, parameter
from jaxfx._loops import scan
from jaxfx._meshes import on_any_mesh
from jaxfx._platform import by_platform
from jaxfx.dof.arguments import Defocused, check_arguments, defocused
from jaxfx.lens import Lens


# Largest conductance of a border per step: the four borders of a pixel then pass on its heat
# and no more. With a larger one the explicit steps ring.
_LARGEST_CONDUCTANCE = 1 / 4


@on_any_mesh
def anisotropic_diffusion(
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    lens: Lens,
    *,
    max_coc: Number | None = None,
    edge: Float[ArrayLike, ""] | float = 4.0,
) -> Float[Array, "height width channel"]:
    """Depth of field by explicit heat flow that stops at depth edges. Kept for comparison.

    A point becomes a Gaussian, not a disc, and nothing crosses a silhouette: a blurred
    foreground keeps its hard outline. Time grows with the square of the radius.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background; 0, negative
      or NaN where it is missing.
    - `lens`: gives each depth its signed defocus, in pixels.
    - `max_coc`: static; the largest diameter, in pixels. Larger ones are clamped to it. Outside
      `jit`, `grad` and `vmap` it may be left out and is then taken from the data.
    - `edge`: pixels; a step of the defocus by this much halves the flow.

    **Returns:** height width channel, in the type of `image`. A pixel that is not a number
    conducts nothing, so it spoils itself alone; one whose depth is missing keeps its colour.

    **Raises:** `ValueError` for a wrong shape, an integer image, no lens, an `edge` that is not
    positive, or no `max_coc` under a transform.

    **Gradient:** exact with respect to `image`, `depth`, `edge` and every field of `lens`; zero
    where a circle is clamped. Its memory grows with the root of the number of steps.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import ThinLens, dof
    >>> image, depth = jnp.ones((8, 8, 3)), jnp.full((8, 8), 4.0)
    >>> lens = ThinLens(aperture=0.1, focus_distance=2.0, focal_pixels=100.0)
    >>> dof.anisotropic_diffusion(image, depth, lens).shape
    (8, 8, 3)

    `dI/dt = div(g grad I)` for a time of 1, with
    `g = min(C_p, C_q)^2 / 32 / (1 + ((D_p - D_q) / edge)^2)` between neighbours p and q, C
    their circles of confusion and D their signed defocus, in
    `ceil(max_coc^2 / 8)` steps, the fewest that are stable.

    A bar that is narrower than its blur keeps its colour.

    Source: Bertalmio, Fort & Sanchez-Crespo 2004, depth of field as anisotropic diffusion.
    Reconstructed: the form of the stop at an edge. Our own: the scale of the conductance, which
    gives a point the variance of its disc.
    """
    image, depth, lens, max_coc = check_arguments(
        "anisotropic_diffusion", image, depth, lens, max_coc
    )
    edge = _check_edge("anisotropic_diffusion", edge)
    return _explicit(image, depth, lens, edge, max_coc)


@on_any_mesh
def implicit_diffusion(
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    lens: Lens,
    *,
    max_coc: Number | None = None,
    edge: Float[ArrayLike, ""] | float = 4.0,
) -> Float[Array, "height width channel"]:
    """Depth of field by two implicit steps of heat flow, in constant time at any radius.

    A point becomes the product of two exponentials, with a cusp and long tails, and nothing
    crosses a silhouette. Kept for comparison.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background; 0, negative
      or NaN where it is missing.
    - `lens`: gives each depth its signed defocus, in pixels.
    - `max_coc`: static; the largest diameter, in pixels. Larger ones are clamped to it; the
      work does not depend on it. Outside `jit`, `grad` and `vmap` it may be left out.
    - `edge`: pixels; a step of the defocus by this much halves the flow.

    **Returns:** height width channel, in the type of `image`. A pixel that is not a number
    conducts nothing, so it spoils itself alone; one whose depth is missing keeps its colour.

    **Raises:** `ValueError` for a wrong shape, an integer image, no lens, an `edge` that is not
    positive, or no `max_coc` under a transform.

    **Gradient:** exact with respect to `image`, `depth`, `edge` and every field of `lens`, by
    the implicit function, in the memory of a few images; zero where a circle is clamped.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import ThinLens, dof
    >>> image, depth = jnp.ones((8, 8, 3)), jnp.full((8, 8), 4.0)
    >>> lens = ThinLens(aperture=0.1, focus_distance=2.0, focal_pixels=100.0)
    >>> dof.implicit_diffusion(image, depth, lens).shape
    (8, 8, 3)

    Solves `u - d(g du/dx)/dx = image` along rows, then `v - d(g dv/dy)/dy = u` along columns:
    two tridiagonal systems, with the conductance g of `anisotropic_diffusion`.

    The order of rows and columns shows where g changes.

    Source: Kass, Lefohn & Owens 2006, interactive depth of field using simulated diffusion: the
    two solves and the smaller conductance at a border. Reconstructed: one layer only, theirs
    keeps the foreground apart. Our own: the scale of the conductance, which gives a point the
    variance of its disc, and `edge`.
    """
    image, depth, lens, max_coc = check_arguments(
        "implicit_diffusion", image, depth, lens, max_coc
    )
    edge = _check_edge("implicit_diffusion", edge)
    return _implicit(image, depth, lens, edge, max_coc)


def _check_edge(function: str, edge: Any) -> Float[Array, ""]:
    name = f"{function}(edge=...)"
    edge = parameter(name, edge)
    check(name, edge, lambda v: v > 0, "positive")
    return edge


def _conductances(
    view: Defocused, edge: Float[Array, ""]
) -> tuple[Float[Array, "_ width"], Float[Array, "height _"]]:
    """Conductances of the borders between rows and between columns, for a time of 1."""
    spread = jnp.where(view.bad | view.missing, 0, view.defocus**2 / 32)
    edge = edge.astype(spread.dtype)

    def between(axis):
        slope = jnp.diff(view.defocus, axis=axis) / edge
        size = spread.shape[axis]
        first = jax.lax.slice_in_dim(spread, 0, size - 1, axis=axis)
        second = jax.lax.slice_in_dim(spread, 1, size, axis=axis)
        return jnp.minimum(first, second) / (1 + slope * slope)

    return between(0), between(1)


@ft.partial(jax.jit, static_argnames=("max_coc",))
def _explicit(image, depth, lens, edge, max_coc):
    view = defocused(image, depth, lens, max_coc)
    # Two nested loops, so that a reverse pass keeps the states of one of each.
    steps = math.ceil(max_coc**2 / 32 / _LARGEST_CONDUCTANCE)
    inner = math.isqrt(steps)
    outer = -(-steps // inner)
    rows, columns = (g / (outer * inner) for g in _conductances(view, edge))

    def flow(heat):
        down = rows * jnp.diff(heat, axis=0)
        right = columns * jnp.diff(heat, axis=1)
        heat = heat + jnp.pad(down, ((0, 1), (0, 0)))
        heat = heat - jnp.pad(down, ((1, 0), (0, 0)))
        heat = heat + jnp.pad(right, ((0, 0), (0, 1)))
        return heat - jnp.pad(right, ((0, 0), (1, 0)))

    def step(channels, _):
        # Channel by channel: XLA adds planes ten times as fast as it sums over a last axis of
        # 3.
        return tuple(map(flow, channels)), None

    @jax.checkpoint
    def inner_steps(channels, _):
        return scan(step, channels, None, inner)

    channels = tuple(jnp.moveaxis(view.image, -1, 0))
    channels, _ = scan(inner_steps, channels, None, outer)
    result = jnp.stack(channels, axis=-1)
    return jnp.where((view.bad | view.lost)[..., None], jnp.nan, result).astype(image.dtype)


@ft.partial(jax.jit, static_argnames=("max_coc",))
def _implicit(image, depth, lens, edge, max_coc):
    view = defocused(image, depth, lens, max_coc)
    rows, columns = _conductances(view, edge)
    # The axis of a solve comes first, and the axis that is not solved is the vectors'.
    heat = solve(columns.T, jnp.transpose(view.image, (1, 2, 0)))
    heat = solve(rows, jnp.transpose(heat, (2, 1, 0)))
    result = jnp.transpose(heat, (0, 2, 1))
    return jnp.where((view.bad | view.lost)[..., None], jnp.nan, result).astype(image.dtype)


def solve(
    conductance: Float[Array, "border lane"], heat: Float[Array, "size channel lane"]
) -> Float[Array, "size channel lane"]:
    """One implicit step along the first axis: `x` with `x - d(g dx) = heat`, for every lane."""
    conductance = conductance[:, None, :]

    def matvec(x):
        flow = conductance * jnp.diff(x, axis=0)
        ends = ((0, 1), (0, 0), (0, 0)), ((1, 0), (0, 0), (0, 0))
        return x - jnp.pad(flow, ends[0]) + jnp.pad(flow, ends[1])

    def direct(_, heat):
        held = jax.lax.stop_gradient(conductance)
        return by_platform(held, heat, cpu=_thomas, accelerator=_cyclic_reduction)

    # The matrix is symmetric: an adjoint is one more solve.
    return jax.lax.custom_linear_solve(matvec, heat, direct, symmetric=True)


def _thomas(
    conductance: Float[Array, "border 1 lane"], heat: Float[Array, "size channel lane"]
) -> Float[Array, "size channel lane"]:
    """Elimination for this matrix, without a difference: all errors are relative.

    With `e` what a pivot has beyond the conductance to the next unknown, pivots are `e + g`
    and `e' = 1 + g e / (e + g)`. A pivot formed by subtraction loses digits as g grows.
    """
    before = jnp.pad(conductance, ((1, 0), (0, 0), (0, 0)))
    after = jnp.pad(conductance, ((0, 1), (0, 0), (0, 0)))

    def eliminate(carry, row):
        excess, known, pivot = carry
        before, after, heat = row
        excess = 1 + before * excess / pivot
        pivot = excess + after
        known = (heat + before * known) / pivot
        return (excess, known, pivot), (known, after / pivot)

    one = jnp.ones_like(after[0])
    start = one, jnp.zeros_like(heat[0]), one
    _, (known, ratio) = scan(eliminate, start, (before, after, heat))

    def substitute(x, row):
        known, ratio = row
        x = known + ratio * x
        return x, x

    _, x = scan(substitute, jnp.zeros_like(heat[0]), (known, ratio), reverse=True)
    return x


def _cyclic_reduction(
    conductance: Float[Array, "border 1 lane"], heat: Float[Array, "size channel lane"]
) -> Float[Array, "size channel lane"]:
    """Elimination of all unknowns at once, also without a difference (Hockney 1965).

    A row is `(excess + left + right) x[i] - left x[i - reach] - right x[i + reach] = heat[i]`.
    Multiples of the rows at `i - reach` and `i + reach` that eliminate their unknowns are added
    to it: then it reaches twice as far, and after log2(size) turns beyond both ends.
    """
    left = jnp.pad(conductance, ((1, 0), (0, 0), (0, 0)))
    right = jnp.pad(conductance, ((0, 1), (0, 0), (0, 0)))
    excess, zero = jnp.ones_like(left), jnp.zeros((), heat.dtype)
    reach, size = 1, len(heat)

    def moved(x: Array, by: int) -> Array:
        """Each row's that lies `by` rows before it; 0 beyond the ends."""
        return jax.lax.pad(x, zero, ((by, -by, 0), (0, 0, 0), (0, 0, 0)))

    while reach < size:
        per_pivot = 1 / (excess + left + right)
        before, after = left * moved(per_pivot, reach), right * moved(per_pivot, -reach)

        def added(x, reach=reach, before=before, after=after):
            return x + before * moved(x, reach) + after * moved(x, -reach)

        heat, excess = added(heat), added(excess)
        left, right = before * moved(left, reach), after * moved(right, -reach)
        reach *= 2
    return heat / excess
