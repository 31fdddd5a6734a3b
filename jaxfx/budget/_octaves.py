"""Scatter with large sprites at lower resolutions: a large disc has little detail to lose."""

import functools as ft

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx._numerics import clip01
from jaxfx.dof.arguments import pixels, with_own
from jaxfx.dof.kernels import shift, spans, tiles
from jaxfx.dof.scatter import cheapest, to_sprites
from jaxfx.dof.sprites import POINT_RADIUS, Sprites, reach
from jaxfx.lens import Lens


# The epsilon of `dof.scatter` that this stands for, in pixels: its default.
EPSILON = 2.0
_PROGRAMS = {"shift": shift, "tiles": tiles, "spans": spans}
_Values = Float[Array, "height width value"]


@ft.partial(jax.jit, static_argnames=("max_coc", "split"))
def octaves(
    image: Float[Array, "height width channel"],
    depth: Float[Array, "height width"],
    lens: Lens,
    max_coc: float,
    split: float,
) -> Float[Array, "height width channel"]:
    """`dof.scatter` with gamma 0 and epsilon 2; sprites wider than `split` pixels coarser.

    Four sprites wider than `split` become one at half the resolution, and so on until none is
    wider. The sums that they add, in front of the focus and behind it apart, are enlarged again
    before the quotient is taken. The leak rejection behind the focus is applied at full size:
    for sprites of three times epsilon and more it is a factor of the target pixel alone.
    """
    dtype = image.dtype
    image, depth, missing, _, _ = pixels(image, depth, lens)
    gamma, epsilon = jnp.zeros((), image.dtype), jnp.asarray(EPSILON, image.dtype)
    sprites = to_sprites(image, depth, lens, gamma, epsilon, max_coc, missing)

    large = sprites.radius > split / 2
    sums = _painted(_without(sprites, large), split)
    is_front = large & (sprites.leak < 0)
    parts = (is_front, large & ~is_front)
    planes = [jnp.where(part[..., None], sprites.value, 0) for part in parts]
    coarse = _coarse(jnp.concatenate(planes, axis=-1), sprites.radius, large, max_coc, split)
    front, back = jnp.split(_enlarged(coarse, depth.shape), 2, axis=-1)
    passed = clip01(sprites.coc / EPSILON - 1)[..., None]
    sums = with_own(sums + front + passed * back, image, missing)
    return (sums[..., :-1] / sums[..., -1:]).astype(dtype)


def _coarse(
    value: _Values,
    radius: Float[Array, "height width"],
    large: Bool[Array, "height width"],
    max_coc: float,
    split: float,
) -> Float[Array, "rows columns value"]:
    """The sums of the large sprites, at half the resolution; the larger ones drawn coarser."""
    is_large = large[..., None].astype(value.dtype)
    pooled = _pooled(jnp.concatenate([value, is_large * radius[..., None], is_large], axis=-1))
    count, max_coc = pooled[..., -1], max_coc / 2
    radius = jnp.where(count > 0, pooled[..., -2] / jnp.maximum(count, 1) / 2, POINT_RADIUS)
    none = jnp.zeros_like(radius)
    sprites = Sprites(pooled[..., :-2], radius, none - 1, none, jnp.ones((), radius.dtype))
    if max_coc <= split:
        return _painted(sprites, max_coc)
    large = radius > split / 2
    value = jnp.where(large[..., None], sprites.value, 0)
    coarser = _coarse(value, radius, large, max_coc, split)
    return _painted(_without(sprites, large), split) + _enlarged(coarser, radius.shape)


def _without(sprites: Sprites, some: Array) -> Sprites:
    """The sprites, those of `some` pixels empty and of the smallest radius."""
    value = jnp.where(some[..., None], 0, sprites.value)
    return sprites._replace(value=value, radius=jnp.where(some, POINT_RADIUS, sprites.radius))


def _painted(sprites: Sprites, max_coc: float) -> _Values:
    """The sums of sprites no wider than `max_coc` pixels, by scatter's quickest program."""
    height, width = sprites.radius.shape
    program = cheapest(height, width, max_coc)
    return _PROGRAMS[program](sprites, reach(max_coc))


def _pooled(planes: _Values) -> Float[Array, "rows columns value"]:
    """The sums over blocks of 2 x 2 pixels."""
    height, width, count = planes.shape
    planes = jnp.pad(planes, ((0, height % 2), (0, width % 2), (0, 0)))
    blocks = planes.reshape((height + 1) // 2, 2, (width + 1) // 2, 2, count)
    return blocks.sum(axis=(1, 3))


def _enlarged(planes: Float[Array, "rows columns value"], shape: tuple[int, ...]) -> _Values:
    """Planes at twice their size, linear between pixels, cut to `shape`."""
    for axis in (0, 1):
        size = planes.shape[axis]
        ends = [(1, 1) if axis == a else (0, 0) for a in range(3)]
        padded = jnp.pad(planes, ends, mode="edge")
        before, after = (
            jax.lax.slice_in_dim(padded, start, start + size, axis=axis) for start in (0, 2)
        )
        # The two halves of a pixel lie a quarter of its size off its center.
        halves = [0.75 * planes + 0.25 * other for other in (before, after)]
        double = [n * 2 if axis == a else n for a, n in enumerate(planes.shape)]
        planes = jnp.stack(halves, axis=axis + 1).reshape(double)
    return planes[: shape[0], : shape[1]]
