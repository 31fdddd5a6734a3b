"""Standard errors of what a least-squares fit finds, by the jackknife over blocks of residuals.

The textbook covariance `sigma^2 (J^T J)^-1` takes every residual for independent of the others.
Residuals of an image are not: what a model gets wrong in one pixel it gets wrong beside it. So
residuals are put into blocks (tiles of the image, say), each block is left out in turn, and the
variance of the solutions without it is the stated one.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfx._numerics import one_program
from jaxfx._platform import one_by_one_on_cpu


# Tiles on a side of an image: 64 blocks. Of fewer the variance is estimated poorly; more are
# so small that residuals depend on those of the next tile.
_TILES = 8


@functools.partial(jax.jit, static_argnames="count")
def covariance(
    columns: Float[Array, "residual unknown"],
    residual: Float[Array, " residual"],
    block: Int[Array, " residual"],
    count: int,
) -> Float[Array, "unknown unknown"]:
    """The covariance of a least-squares solution, by leaving out blocks of residuals.

    `columns` is the Jacobian at the solution, `block` the block of each residual, from 0 to
    `count - 1`. Without a block the solution moves by one Gauss-Newton step, solved from the
    sums of squares of the other blocks. An unknown whose column is 0, and every unknown where
    there are no more blocks than unknowns, has the covariance inf. A combination of unknowns
    that changes no residual has a large variance, that of rounding.

    Source: Cameron & Miller 2015, "A practitioner's guide to cluster-robust inference", CV3.
    """
    axes, unknowns = principal(columns), columns.shape[1]
    floor = jnp.finfo(columns.dtype).eps
    is_flat = axes.squares < 64 * floor
    lengths = jnp.sqrt(jnp.where(is_flat, 1, axes.squares))
    # Solved in combinations of length 1: in the unknowns themselves two that are hard to tell
    # apart would lose twice as many digits.
    along = jnp.where(is_flat[None], 0, axes.along / lengths[None])
    basis = axes.basis / lengths[None]
    sums = lambda values: jax.ops.segment_sum(values, block, count)
    curvature = jnp.stack([sums(along * along[:, [i]]) for i in range(unknowns)], axis=1)
    slope = sums(along * residual[:, None])
    rest = jnp.sum(curvature, axis=0, keepdims=True) - curvature
    # One by one on a CPU: of a batch, jaxlib before 0.11 waits for threads that devices of one
    # process keep from each other, for ever where they are as many as its threads.
    eigenvalues, vectors = jax.vmap(one_by_one_on_cpu(jnp.linalg.eigh))(rest)
    turned = jnp.einsum("bji,bj->bi", vectors, jnp.sum(slope, axis=0, keepdims=True) - slope)
    moves = jnp.einsum("bij,bj->bi", vectors, turned / jnp.maximum(eigenvalues, floor))
    is_used = jnp.any(curvature != 0, axis=(1, 2))
    used = jnp.sum(is_used)
    is_enough = used > unknowns
    used = jnp.maximum(used, 1).astype(columns.dtype)
    moves = jnp.where(is_used[:, None], moves, 0)
    mean_move = jnp.sum(moves, axis=0, keepdims=True) / used
    moves = jnp.where(is_used[:, None], moves - mean_move, 0) @ basis.T
    # Along a flat direction no block moves the solution, which says nothing of its variance.
    flat = jnp.where(is_flat, jnp.mean(residual**2) / floor, 0)
    variance = (1 - 1 / used) * moves.T @ moves + (basis * flat[None]) @ basis.T
    is_known = is_enough & axes.is_told
    return jnp.where(is_known[:, None] & is_known[None], variance, jnp.inf)


class Principal(NamedTuple):
    """Combinations of unknowns, one per axis, none of which does what another does.

    - `along`: how each combination changes the residuals; orthogonal to each other.
    - `basis`: each combination of the unknowns, by columns.
    - `squares`: the sum of squares of each combination's `along`, 1 for a single unknown.
    - `is_told`: of each unknown, whether it changes any residual.
    """

    along: Float[Array, "residual axis"]
    basis: Float[Array, "unknown axis"]
    squares: Float[Array, " axis"]
    is_told: Bool[Array, " unknown"]


@one_program
def principal(columns: Float[Array, "residual unknown"]) -> Principal:
    """The principal combinations of unknowns; `columns` is the Jacobian.

    The eigenvalues of its square are known to the rounding of the largest alone: of two
    unknowns that 1e-5 tells apart, to 1e-6. So their sums of squares are those of `along`.
    """
    norms = jnp.linalg.norm(columns, axis=0)
    is_told = norms > 0
    norms = jnp.where(is_told, norms, 1)
    scaled = columns / norms[None]
    # Away from all others, so that rounding mixes what is not told with none of them.
    apart = jnp.diag(jnp.where(is_told, 0, -1).astype(columns.dtype))
    vectors = jnp.linalg.eigh(scaled.T @ scaled + apart)[1]
    along = scaled @ vectors
    return Principal(along, vectors / norms[:, None], jnp.sum(along**2, axis=0), is_told)


def tiles(shape: tuple[int, ...], side: int = _TILES) -> tuple[Int[Array, " residual"], int]:
    """The tile of each residual of an image of `shape`, of `side` x `side` tiles; their count.

    `shape` is height width, and channels, which share their pixel's tile.
    """
    return _tile_of(shape, side), side * side


@functools.partial(one_program, static_argnums=(0, 1))
def _tile_of(shape, side):
    row, column = (jnp.arange(size) * side // size for size in shape[:2])
    tile = side * row[:, None] + column[None]
    return jnp.repeat(tile.reshape(-1), math.prod(shape[2:]))


@one_program
def independent_errors(
    columns: Float[Array, "residual unknown"], residual: Float[Array, "..."]
) -> Float[Array, " unknown"]:
    """The textbook standard errors, as if residuals were independent and of one variance.

    Roots of the diagonal of `sigma^2 (J^T J)^-1`; inf where J has a column of zeros.
    """
    axes = principal(columns)
    squares = jnp.maximum(axes.squares, jnp.finfo(columns.dtype).eps)
    variance = jnp.sum(axes.basis**2 / squares[None], axis=1)
    sigma = jnp.sqrt(jnp.sum(residual**2) / max(residual.size - columns.shape[1], 1))
    return jnp.where(axes.is_told, sigma * jnp.sqrt(variance), jnp.inf)
