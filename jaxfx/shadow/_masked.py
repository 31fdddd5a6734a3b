"""A filter's work in some pixels of many, and the derivatives of those alone.

A CPU collects these pixels and filters no others. An accelerator filters every pixel and
selects: there the filter is one launch, and to collect pixels takes hundreds.
"""

import functools as ft
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from jaxfx._linear import linear
from jaxfx._platform import by_platform, one_by_one_on_cpu
from jaxfx.shadow import _taps
from jaxfx.shadow._compact import fold
from jaxfx.shadow._taps import Places
from jaxfx.shadow._windows import extremes, unions
from jaxfx.shadow.pcf import average, filtered
from jaxfx.shadow.receivers import Receivers


def find_mask(size, mask, dilation, shadow_map, receivers, bias, slope_bias, softness):
    """The padded map, the mask, and what the pixels outside of it are."""
    dtype = _taps.common_dtype(shadow_map, receivers)
    texels = _taps.pad_map(shadow_map, size, dtype)
    places = _taps.find_places(receivers, bias, slope_bias, shadow_map.shape, size, dtype)
    if mask == "screen":
        hard = average(texels, places, None, 1, "box")
        return texels, _near_edges(hard, dilation), hard
    windows, reach = extremes(texels, size), size // 2
    index = (places.row - reach) * windows[0].shape[1] + (places.column - reach)
    smallest, largest = (
        each.reshape(-1).at[index].get(mode="promise_in_bounds") for each in windows
    )
    if softness is None:
        all_lit, any_lit = smallest >= places.threshold, largest >= places.threshold
    else:
        half = _taps.half_width(softness, dtype)
        all_lit = smallest - places.threshold >= half
        any_lit = largest - places.threshold > -half
    value = (all_lit.astype(dtype) + any_lit.astype(dtype)) / 2
    return texels, value == 0.5, value


def _near_edges(
    hard: Float[Array, "height width"], dilation: int
) -> Bool[Array, "height width"]:
    lit, dark = jnp.uint8(1), jnp.uint8(2)
    padded = jnp.pad(jnp.where(hard > 0, lit, dark), dilation)
    return unions(padded, 2 * dilation + 1) == lit | dark


@ft.partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2, 3))
def masked(size, kernel, mask, dilation, *data):
    """`pcf` of checked arguments in the pixels of the mask, the comparison in the others."""
    options = (size, kernel, mask, dilation)

    @one_by_one_on_cpu
    def run(*data):
        some, every = ft.partial(_some, *options), ft.partial(_every, *options)
        return by_platform(*data, cpu=some, accelerator=every)

    return run(*data)


def _some(size, kernel, mask, dilation, shadow_map, receivers, bias, slope_bias, softness):
    """`masked`, by the filter in the pixels of the mask alone."""
    data = (shadow_map, receivers, bias, slope_bias, softness)
    texels, where, value = find_mask(size, mask, dilation, *data)
    flat = jax.tree.map(jnp.ravel, receivers)

    def fetch(pixels):
        chunk = Receivers(*(each[pixels] for each in flat))
        shape, dtype = shadow_map.shape, texels.dtype
        return _taps.find_places(chunk, bias, slope_bias, shape, size, dtype)

    def step(value, pixels, places: Any):
        return _put(value, pixels, average(texels, places, softness, size, kernel))

    result = fold(where.reshape(-1), value.reshape(-1), fetch, step)
    return result.reshape(where.shape).astype(receivers.z.dtype)


def _every(size, kernel, mask, dilation, *data):
    """`masked`, by the filter in every pixel. Outside of the mask by depth its values agree."""
    value = filtered(*data, size, kernel)
    if mask == "depth":
        return value
    _, where, hard = find_mask(size, mask, dilation, *data)
    return jnp.where(where, value, hard.astype(value.dtype))


def _masked_jvp(size, kernel, mask, dilation, primals, tangents):
    shadow_map, softness = primals[0], primals[4]
    texels, where, _ = find_mask(size, mask, dilation, *jax.lax.stop_gradient(primals))
    dtype = texels.dtype

    def place(receivers, bias, slope_bias):
        shape = shadow_map.shape
        found = _taps.find_places(receivers, bias, slope_bias, shape, size, dtype)
        return tuple(found[2:]), found[:2]

    dots = tuple(map(_instantiated, tangents[1:4]))
    floats, floats_dot, index = jax.jvp(place, primals[1:4], dots, has_aux=True)
    # What has no tangent costs nothing: the map, above all.
    texels_dot = softness_dot = None
    if not isinstance(tangents[0], SymbolicZero):
        pad = ft.partial(_taps.pad_map, size=size, dtype=dtype)
        texels_dot = jax.jvp(pad, (shadow_map,), (tangents[0],))[1]
    if softness is not None:
        softness, dot = softness.astype(dtype), tangents[4]
        softness_dot = None if isinstance(dot, SymbolicZero) else dot.astype(dtype)

    fixed, dots = (
        (where, index, (texels, floats, softness)),
        (texels_dot, floats_dot, softness_dot),
    )
    moves = tuple(dot is not None for dot in dots)

    def ways(some, every):
        some, every = (ft.partial(each, size, kernel, moves) for each in (some, every))
        chosen = lambda *data: by_platform(*data, cpu=some, accelerator=every)
        return ft.partial(one_by_one_on_cpu(chosen), *fixed)

    push, pull = ways(_push, _push_every), ways(_pull, _pull_every)
    plain = ft.partial(_push_every, size, kernel, moves, *fixed)
    out = linear(push, pull, plain, dots)
    value = masked(size, kernel, mask, dilation, *primals)
    return value, out.astype(value.dtype)


masked.defjvp(_masked_jvp, symbolic_zeros=True)


def _instantiated(tangents: Any) -> Any:
    is_zero = lambda dot: isinstance(dot, SymbolicZero)
    fill = lambda dot: jnp.zeros(dot.shape, dot.dtype) if is_zero(dot) else dot
    return jax.tree.map(fill, tangents, is_leaf=is_zero)


def _average_of(size, kernel, moves, index, at):
    """`average` as a function of what moves of (texels, floats of places, softness); that."""

    def f(moving):
        texels, floats, softness = (
            b if a is None else a for a, b in zip(moving, at, strict=True)
        )
        return average(texels, Places(*index, *floats), softness, size, kernel)

    return f, tuple(
        each if is_moved else None for each, is_moved in zip(at, moves, strict=True)
    )


def _push(size, kernel, moves, where, index, at, dots):
    """The tangent of `average` in the pixels of the mask, 0 in the others."""
    flat = jax.tree.map(jnp.ravel, (index, at[1], dots[1]))

    def step(out, pixels, chunk):
        index, floats, floats_dot = chunk
        f, here = _average_of(size, kernel, moves, index, (at[0], floats, at[2]))
        return _put(out, pixels, jax.jvp(f, (here,), ((dots[0], floats_dot, dots[2]),))[1])

    zero = jnp.zeros(where.size, at[0].dtype)
    return fold(where.reshape(-1), zero, _fetch(flat), step).reshape(where.shape)


def _pull(size, kernel, moves, where, index, at, bar):
    """The transpose of `_push`."""
    flat = jax.tree.map(jnp.ravel, (index, at[1], bar))

    def step(bars, pixels, chunk):
        index, floats, bar = chunk
        f, here = _average_of(size, kernel, moves, index, (at[0], floats, at[2]))
        ((texels, floats, softness),) = jax.vjp(f, here)[1](
            jnp.where(pixels < where.size, bar, 0)
        )
        floats = jax.tree.map(lambda image, new: _put(image, pixels, new), bars[1], floats)
        texels, softness = jax.tree.map(jnp.add, (bars[0], bars[2]), (texels, softness))
        return texels, floats, softness

    moving = _average_of(size, kernel, moves, index, at)[1]
    zeros = jax.tree.map(jnp.zeros_like, moving)
    flat_zeros = zeros[0], jax.tree.map(jnp.ravel, zeros[1]), zeros[2]
    texels, floats, softness = fold(where.reshape(-1), flat_zeros, _fetch(flat), step)
    return texels, jax.tree.map(lambda image: image.reshape(where.shape), floats), softness


def _push_every(size, kernel, moves, where, index, at, dots):
    """`_push` by the tangent in every pixel."""
    f, here = _average_of(size, kernel, moves, index, at)
    return jnp.where(where, jax.jvp(f, (here,), (dots,))[1], 0)


def _pull_every(size, kernel, moves, where, index, at, bar):
    """The transpose of `_push_every`."""
    f, here = _average_of(size, kernel, moves, index, at)
    return jax.vjp(f, here)[1](jnp.where(where, bar, 0))[0]


def _fetch(flat):
    return lambda pixels: jax.tree.map(lambda image: image[pixels], flat)


def _put(image, pixels, new):
    return image.at[pixels].set(new, mode="drop", unique_indices=True)
