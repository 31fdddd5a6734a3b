"""The filter of `edge_pcf` in the pixels of its mask, and its derivatives there.

A CPU collects the pixels of the mask and filters no others. An accelerator filters every pixel
and selects: there the filter is one launch, and collecting pixels takes hundreds.

Derivatives are with respect to three groups of floats: the padded map's texels; the float
fields of the places (threshold, dx, dy); the softness. The tangent of a group is None where it
has none, and then costs nothing.
"""

import functools as ft
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from jaxfx._linear import linear
from jaxfx._platform import by_platform, one_by_one_on_cpu
from jaxfx.shadow._compact import fold
from jaxfx.shadow._edges import find_edges
from jaxfx.shadow.compare import (
    Places,
    filtered,
    find_places,
    mean_comparison,
    pad_map,
)
from jaxfx.shadow.receivers import Receivers


@ft.partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2, 3))
def filtered_at_edges(size, kernel, edges, dilation, *data):
    """`pcf` in the pixels of the mask, the visibility of `find_edges` in the others.

    `data` are the five arrays of `filter_arguments`.
    """
    options = (size, kernel, edges, dilation)

    @one_by_one_on_cpu
    def run(*data):
        masked, full = ft.partial(_masked, *options), ft.partial(_full, *options)
        return by_platform(*data, cpu=masked, accelerator=full)

    return run(*data)


def _masked(size, kernel, edges, dilation, shadow_map, receivers, bias, slope_bias, softness):
    """`filtered_at_edges`: the filter runs in the pixels of the mask alone."""
    data = (shadow_map, receivers, bias, slope_bias, softness)
    texels, mask, outside = find_edges(size, edges, dilation, *data)
    flat = jax.tree.map(jnp.ravel, receivers)

    def fetch(pixels):
        chunk = Receivers(*(field[pixels] for field in flat))
        shape, dtype = shadow_map.shape, texels.dtype
        return find_places(chunk, bias, slope_bias, shape, size, dtype)

    def step(visibility, pixels, places: Any):
        chunk = mean_comparison(texels, places, softness, size, kernel)
        return _put(visibility, pixels, chunk)

    result = fold(mask.reshape(-1), outside.reshape(-1), fetch, step)
    return result.reshape(mask.shape).astype(receivers.z.dtype)


def _full(size, kernel, edges, dilation, *data):
    """`filtered_at_edges`: the filter runs in every pixel, the mask selects."""
    result = filtered(*data, size, kernel)
    if edges == "depth":
        return result  # Outside of that mask the two agree.
    _, mask, hard = find_edges(size, edges, dilation, *data)
    return jnp.where(mask, result, hard.astype(result.dtype))


def _filtered_at_edges_jvp(size, kernel, edges, dilation, primals, tangents):
    shadow_map, softness = primals[0], primals[4]
    texels, mask, _ = find_edges(size, edges, dilation, *jax.lax.stop_gradient(primals))
    dtype = texels.dtype

    def place(receivers, bias, slope_bias):
        places = find_places(receivers, bias, slope_bias, shadow_map.shape, size, dtype)
        return tuple(places[2:]), places[:2]

    place_dots = tuple(map(_instantiated, tangents[1:4]))
    floats, floats_dot, index = jax.jvp(place, primals[1:4], place_dots, has_aux=True)
    texels_dot = softness_dot = None
    if not isinstance(tangents[0], SymbolicZero):
        pad = ft.partial(pad_map, size=size, dtype=dtype)
        texels_dot = jax.jvp(pad, (shadow_map,), (tangents[0],))[1]
    if softness is not None:
        softness, dot = softness.astype(dtype), tangents[4]
        softness_dot = None if isinstance(dot, SymbolicZero) else dot.astype(dtype)

    fixed = (mask, index, (texels, floats, softness))
    dots = (texels_dot, floats_dot, softness_dot)
    moves = tuple(dot is not None for dot in dots)

    def on_each_platform(masked, full):
        masked, full = (ft.partial(rule, size, kernel, moves) for rule in (masked, full))
        chosen = lambda *data: by_platform(*data, cpu=masked, accelerator=full)
        return ft.partial(one_by_one_on_cpu(chosen), *fixed)

    push = on_each_platform(_push_masked, _push_full)
    pull = on_each_platform(_pull_masked, _pull_full)
    plain = ft.partial(_push_full, size, kernel, moves, *fixed)
    out = linear(push, pull, plain, dots)
    value = filtered_at_edges(size, kernel, edges, dilation, *primals)
    return value, out.astype(value.dtype)


filtered_at_edges.defjvp(_filtered_at_edges_jvp, symbolic_zeros=True)


def _instantiated(tangents: Any) -> Any:
    """The tangents, arrays of 0 in place of symbolic zeros."""
    is_zero = lambda dot: isinstance(dot, SymbolicZero)
    fill = lambda dot: jnp.zeros(dot.shape, dot.dtype) if is_zero(dot) else dot
    return jax.tree.map(fill, tangents, is_leaf=is_zero)


def _as_function(size, kernel, moves, index, at):
    """`mean_comparison` as a function of the groups that have a tangent; and those groups.

    `at` holds all three groups, `moves` says which have a tangent; the others are None.
    """

    def function(moving):
        texels, floats, softness = (
            held if moved is None else moved for moved, held in zip(moving, at, strict=True)
        )
        return mean_comparison(texels, Places(*index, *floats), softness, size, kernel)

    return function, tuple(
        group if is_moved else None for group, is_moved in zip(at, moves, strict=True)
    )


def _push_masked(size, kernel, moves, mask, index, at, dots):
    """The tangent of `mean_comparison` in the pixels of the mask, 0 in the others."""
    flat = jax.tree.map(jnp.ravel, (index, at[1], dots[1]))

    def step(out, pixels, chunk):
        index, floats, floats_dot = chunk
        function, here = _as_function(size, kernel, moves, index, (at[0], floats, at[2]))
        chunk_dots = ((dots[0], floats_dot, dots[2]),)
        return _put(out, pixels, jax.jvp(function, (here,), chunk_dots)[1])

    zero = jnp.zeros(mask.size, at[0].dtype)
    return fold(mask.reshape(-1), zero, _fetch(flat), step).reshape(mask.shape)


def _pull_masked(size, kernel, moves, mask, index, at, bar):
    """The transpose of `_push_masked`."""
    flat = jax.tree.map(jnp.ravel, (index, at[1], bar))

    def step(bars, pixels, chunk):
        index, floats, bar = chunk
        function, here = _as_function(size, kernel, moves, index, (at[0], floats, at[2]))
        ((texels, floats, softness),) = jax.vjp(function, here)[1](
            jnp.where(pixels < mask.size, bar, 0)
        )
        floats = jax.tree.map(lambda image, new: _put(image, pixels, new), bars[1], floats)
        texels, softness = jax.tree.map(jnp.add, (bars[0], bars[2]), (texels, softness))
        return texels, floats, softness

    moving = _as_function(size, kernel, moves, index, at)[1]
    zeros = jax.tree.map(jnp.zeros_like, moving)
    flat_zeros = zeros[0], jax.tree.map(jnp.ravel, zeros[1]), zeros[2]
    texels, floats, softness = fold(mask.reshape(-1), flat_zeros, _fetch(flat), step)
    return texels, jax.tree.map(lambda image: image.reshape(mask.shape), floats), softness


def _push_full(size, kernel, moves, mask, index, at, dots):
    """`_push_masked`: the tangent in every pixel, the mask selects."""
    function, here = _as_function(size, kernel, moves, index, at)
    return jnp.where(mask, jax.jvp(function, (here,), (dots,))[1], 0)


def _pull_full(size, kernel, moves, mask, index, at, bar):
    """The transpose of `_push_full`."""
    function, here = _as_function(size, kernel, moves, index, at)
    return jax.vjp(function, here)[1](jnp.where(mask, bar, 0))[0]


def _fetch(flat):
    """A function that reads flat images at some pixels."""
    return lambda pixels: jax.tree.map(lambda image: image[pixels], flat)


def _put(image, pixels, new):
    """The flat image with `new` at some pixels; those past its end are dropped."""
    return image.at[pixels].set(new, mode="drop", unique_indices=True)
