"""Pixels that hold the colours of two surfaces, at silhouettes, as a share of each."""

import functools as ft
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx.dof.arguments import defocused


# Of a neighbour's weight in the colour of its surface, per pixel of another surface next to it:
# those are likely to be mixed themselves. With 1, silhouettes are mixed with each other; with
# 0, wires of a pixel have no colour.
_ACROSS = 0.2
# Pixels. How far the colours of the two surfaces are looked for. With 1, silhouettes have no
# clean neighbour; larger, and texture is taken for a mixture.
_WINDOW = 2
# Of the squared colours: the least variance that a texture is taken to have. It only keeps the
# shares finite where there is none.
_NOISE = 1e-6
# Scene units. Stands for the background's inf in a layer behind, where inf says that nothing
# is there.
_BACKGROUND = 1e30

_Image = Float[Array, "height width channel"]
_Plane = Float[Array, "height width"]


class Split(NamedTuple):
    """An image whose mixed pixels are two surfaces, in the working type.

    - `is_mixed`: where. Elsewhere `image`, `depth` and `pure` are what was given, alpha is 1.
    - `image`, `depth`, `alpha`: the nearer surface, and its share of the pixel, 0 to 1.
    - `behind`, `farther`: the colour of the surface behind and its depth, where it is mixed.
    - `pure`: the colour of that surface of which the given depth is.
    """

    is_mixed: Bool[Array, "height width"]
    image: _Image
    depth: _Plane
    alpha: _Plane
    behind: _Image
    farther: _Plane
    pure: _Image


@ft.partial(jax.jit, static_argnames=("max_coc",))
def split(image: _Image, depth: _Plane, lens: Any, threshold: Array, max_coc: float) -> Split:
    """Split the pixels that are next to an edge in depth.

    Their colours are `alpha * image + (1 - alpha) * behind`, exactly. An edge is where the
    defocus of one of 8 neighbours differs from the pixel's by more than the threshold. The
    nearest surface of those 9 is the one in front. Both have the mean colour of their pixels
    within 5 x 5, in which those count most that are near and have few neighbours of another
    surface. Alpha is where the pixel's colour lies between the two. It is drawn towards "not
    mixed" as far as the texture of the pixel's own surface explains its colour (a Wiener
    filter), and the depth's surface has at least half the pixel, since depth is that of its
    middle. What remains of the colour is shared out by the least change of both.
    """
    view = defocused(image, depth, lens, max_coc)
    given, depth = view.image, depth.astype(view.image.dtype)
    threshold = threshold.astype(given.dtype)
    defocus = jax.lax.stop_gradient(view.defocus)
    is_known = ~(view.missing | view.bad)
    near = jnp.where(is_known, defocus, jnp.inf)
    far = jnp.where(is_known, defocus, -jnp.inf)
    front = ft.reduce(jnp.minimum, (there for *_, there in _around(near, 1, jnp.inf)))
    back = ft.reduce(jnp.maximum, (there for *_, there in _around(far, 1, -jnp.inf)))
    is_behind = is_known & (defocus - front > threshold)
    # From the pixel's own, so that steep surfaces have no edges.
    is_edge = is_behind | (is_known & (back - defocus > threshold))

    # Not by a power of a sum: one pass over the neighbours for both surfaces.
    lone_front, lone_back = jnp.ones_like(defocus), jnp.ones_like(defocus)
    for down, right, there in _around(near, 1, jnp.inf):
        if down or right:
            is_there = there < jnp.inf
            lone_front *= jnp.where(is_there & (there - defocus > threshold), _ACROSS, 1)
            lone_back *= jnp.where(is_there & (defocus - there > threshold), _ACROSS, 1)

    none = jnp.zeros_like(given), jnp.zeros_like(defocus), jnp.zeros_like(defocus)
    fronts, backs = none, none
    other, most = depth, jnp.zeros_like(defocus)
    windows = (
        _around(plane, _WINDOW, outside)
        for plane, outside in (
            (near, jnp.inf),
            (given, 0.0),
            (depth, 1.0),
            (lone_front, 0.0),
            (lone_back, 0.0),
        )
    )
    for places, colors, depths, of_front, of_back in zip(*windows, strict=True):
        down, right, place = places
        if not (down or right):
            continue
        closeness = 1 / (0.5 + down * down + right * right)
        is_front = place - front <= threshold
        is_back = (place < jnp.inf) & ~is_front
        is_back &= ~is_behind | (jnp.abs(place - defocus) <= threshold)
        in_front = jnp.where(is_front, closeness * of_front[-1], 0)
        in_back = jnp.where(is_back, closeness * of_back[-1], 0)
        change = colors[-1] - given
        fronts, backs = _counted(fronts, in_front, change), _counted(backs, in_back, change)
        # Of the surface that the pixel's depth is not of, the pixel that counts most.
        weight = jnp.where(is_behind, in_front, in_back)
        other = jnp.where(weight > most, depths[-1], other)
        most = jnp.maximum(weight, most)

    (to_front, of_front, front_weight), (to_back, of_back, back_weight) = fronts, backs
    has_both = is_edge & (front_weight > 0) & (back_weight > 0)
    front_weight = jnp.where(has_both, front_weight, 1)
    back_weight = jnp.where(has_both, back_weight, 1)
    to_front, to_back = to_front / front_weight[..., None], to_back / back_weight[..., None]
    spread = jnp.where(
        is_behind,
        of_back / back_weight - _square(to_back),
        of_front / front_weight - _square(to_front),
    )
    brightness = _square(given + to_front) + _square(given + to_back)
    noise = jnp.maximum(spread, 0) + _NOISE * brightness
    across = to_front - to_back
    contrast = _square(across)
    has_both &= contrast > _NOISE * brightness
    contrast = jnp.where(has_both, contrast, 1)
    # The share that the pixel's own surface lacks, of which it can lack half.
    away = jnp.where(is_behind[..., None], -to_back, to_front)
    along = jnp.sum(away * across, axis=-1)
    lacking = jnp.clip(along / contrast, 0, 0.5)
    explained = along * along / contrast
    lacking *= explained / jnp.where(has_both, explained + noise, 1)
    alpha = jnp.where(is_behind, lacking, 1 - lacking)
    is_mixed = has_both & (lacking > 0)
    alpha = jnp.where(is_mixed, alpha, 1)
    # From the pixel's own colour, which is that where alpha makes none of the other.
    rest = -alpha[..., None] * to_front - (1 - alpha)[..., None] * to_back
    total = (alpha * alpha + (1 - alpha) ** 2)[..., None]
    nearer = given + to_front + rest * alpha[..., None] / total
    behind = given + to_back + rest * (1 - alpha)[..., None] / total

    is_other = is_mixed & is_behind
    farther = jnp.where(is_behind, depth, other)
    farther = jnp.where(farther < _BACKGROUND, farther, _BACKGROUND)
    pick = lambda mask, x, y: jnp.where(mask[..., None], x, y)
    typed = lambda x: x.astype(image.dtype)
    return Split(
        is_mixed,
        typed(pick(is_mixed, nearer, image)),
        jnp.where(is_other, other, depth),
        alpha,
        typed(pick(is_mixed, behind, 0)),
        jnp.where(is_mixed, farther, 0),
        typed(pick(is_mixed, pick(is_behind, behind, nearer), image)),
    )


def _square(color: _Image) -> _Plane:
    return jnp.sum(color * color, axis=-1)


def _counted(sums: tuple, weight: _Plane, change: _Image) -> tuple:
    """Sums of colours, of their squares and of weights, with one pixel more."""
    colors, squares, weights = sums
    return (
        colors + weight[..., None] * change,
        squares + weight * _square(change),
        weights + weight,
    )


def _around(plane: Float[Array, "height width *channel"], reach: int, outside: float):
    """Each offset within `reach`, down and to the right, and the plane moved by it."""
    height, width, *channels = plane.shape
    padded = jnp.pad(
        plane, [(reach, reach)] * 2 + [(0, 0)] * len(channels), constant_values=outside
    )
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            rows, columns = slice(reach + down, None), slice(reach + right, None)
            yield down, right, padded[rows, columns][:height, :width]
