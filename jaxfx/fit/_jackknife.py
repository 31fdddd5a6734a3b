"""Standard errors of what a least-squares fit finds, by the jackknife over blocks of residuals.

The textbook covariance `sigma^2 (J^T J)^-1` takes every residual for independent of the others.
Residuals of an image are not: what a model gets wrong in one pixel it gets wrong beside it. So
residuals are put into blocks (tiles of the image, say), each block is left out in turn, and the
variance of the solutions without it is the stated one.
"""

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

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
    norms = jnp.linalg.norm(columns, axis=0)
    is_told, unknowns = norms > 0, columns.shape[1]
    norms = jnp.where(is_told, norms, 1)
    scaled = columns / norms[None]
    sums = lambda values: jax.ops.segment_sum(values, block, count)
    curvature = jnp.stack([sums(scaled * scaled[:, [i]]) for i in range(unknowns)], axis=1)
    slope = sums(scaled * residual[:, None])
    floor = jnp.finfo(columns.dtype).eps
    rest = jnp.sum(curvature, axis=0, keepdims=True) - curvature
    # One by one on a CPU: of a batch, jaxlib before 0.11 waits for threads that devices of one
    # process keep from each other, for ever where they are as many as its threads.
    eigenvalues, vectors = jax.vmap(one_by_one_on_cpu(jnp.linalg.eigh))(rest)
    along = jnp.einsum("bji,bj->bi", vectors, jnp.sum(slope, axis=0, keepdims=True) - slope)
    moves = jnp.einsum("bij,bj->bi", vectors, along / jnp.maximum(eigenvalues, floor))
    is_used = jnp.any(curvature != 0, axis=(1, 2))
    used = jnp.sum(is_used)
    is_enough = used > unknowns
    used = jnp.maximum(used, 1).astype(columns.dtype)
    moves = jnp.where(is_used[:, None], moves, 0)
    mean_move = jnp.sum(moves, axis=0, keepdims=True) / used
    moves = jnp.where(is_used[:, None], moves - mean_move, 0)
    variance = (1 - 1 / used) * moves.T @ moves
    # Along a flat direction no block moves the solution, which says nothing of its variance.
    eigenvalues, vectors = jnp.linalg.eigh(jnp.sum(curvature, axis=0))
    flat = jnp.where(eigenvalues < 64 * floor, jnp.mean(residual**2) / floor, 0)
    variance = (variance + (vectors * flat[None]) @ vectors.T) / (norms[:, None] * norms[None])
    is_known = is_enough & is_told
    return jnp.where(is_known[:, None] & is_known[None], variance, jnp.inf)


def tiles(shape: tuple[int, ...], side: int = _TILES) -> tuple[Int[Array, " residual"], int]:
    """The tile of each residual of an image of `shape`, of `side` x `side` tiles; their count.

    `shape` is height width, and channels, which share their pixel's tile.
    """
    row, column = (jnp.arange(size) * side // size for size in shape[:2])
    tile = side * row[:, None] + column[None]
    return jnp.repeat(tile.reshape(-1), math.prod(shape[2:])), side * side


def independent_errors(
    columns: Float[Array, "residual unknown"], residual: Float[Array, "..."]
) -> Float[Array, " unknown"]:
    """The textbook standard errors, as if residuals were independent and of one variance.

    Roots of the diagonal of `sigma^2 (J^T J)^-1`; inf where J has a column of zeros.
    """
    norms = jnp.linalg.norm(columns, axis=0)
    is_told = norms > 0
    scaled = columns / jnp.where(is_told, norms, 1)[None]
    eigenvalues, vectors = jnp.linalg.eigh(scaled.T @ scaled)
    floor = jnp.finfo(columns.dtype).eps
    variance = jnp.sum(vectors**2 / jnp.maximum(eigenvalues, floor)[None], axis=1)
    sigma = jnp.sqrt(jnp.sum(residual**2) / max(residual.size - columns.shape[1], 1))
    error = sigma * jnp.sqrt(variance) / jnp.where(is_told, norms, 1)
    return jnp.where(is_told, error, jnp.inf)
