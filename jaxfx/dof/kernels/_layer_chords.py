"""The sums of `layered` by sprites of any convex shape, in plain loops that JAX differentiates.

Groups of slices are painted by spans (`_span_painter`), then composited slice by slice. The
loops' bodies are rematerialised: a reverse pass keeps the accumulator of each group and no row.
One program serves CPUs and accelerators.

What it does not do well: every row of the largest sprite is visited for every pixel in every
group that is not empty; a running sum in float32 leaves 1e-7 of a highlight along its row.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfx.dof.iris import Outline, cuts, span
from jaxfx.dof.kernels._compositing import allowance
from jaxfx.dof.kernels._slices import SLICES, Extent, Sheets, share_of
from jaxfx.dof.kernels._span_painter import filled
from jaxfx.dof.sprites import POINT_RADIUS


# Slices per group: 64 planes of RGB sums. More take memory; fewer visit all sprites more often.
_GROUP = 8


def composited(
    extent: Extent, sheets: Sheets, outline: Outline
) -> Float[Array, "twice_value height width"]:
    """As `_layers.composited`, by sprites of that outline, turned where they lie in front."""
    most = SLICES if extent.slices is None else extent.slices
    firsts = jnp.arange(-most, most + 1, _GROUP)
    height, width = (n - 2 * extent.reach for n in sheets.radius.shape[-2:])
    nothing = jnp.zeros((sheets.value.shape[1], height, width), sheets.value.dtype)
    state = nothing, nothing
    for number in range(len(sheets.radius)):
        sheet = jax.tree.map(lambda x, n=number: x[n], sheets)

        def add_group(state, first, sheet=sheet):
            beyond = sheet.place - first.astype(sheet.place.dtype)
            some = (sheet.value[-1] > 0) & (beyond > -1) & (beyond < _GROUP)
            arriving = jax.lax.cond(
                some.any(),
                lambda first: _arriving(extent, sheet, outline, first),
                lambda _: jnp.zeros((_GROUP, *nothing.shape), nothing.dtype),
                first,
            )
            return jax.lax.scan(_add_slice, state, arriving)

        state = jax.lax.scan(jax.checkpoint(add_group), state, firsts)[0]
    return jnp.concatenate(state)


def _add_slice(state, arrived):
    """Put what finds room of a slice into the lens, and the same weighted."""
    light, late = state
    allowed, weight, _ = allowance(arrived, light)
    added = allowed[None] * arrived
    return (light + added, late + weight[None] * added), None


def _arriving(
    extent: Extent, sheet: Sheets, outline: Outline, first: Int[Array, ""]
) -> Float[Array, "slice value height width"]:
    """Sums of the sprites of each slice of a group, per pixel of the frame."""
    far = extent.reach
    value, radius, (tilt_x, tilt_y), place = sheet
    radius = jnp.where(radius > 0, radius, POINT_RADIUS)
    values, *padded = value.shape
    height, width = (n - 2 * far for n in padded)
    side = jnp.where(place < 0, -1, 1).astype(place.dtype)
    value = jnp.where(value[-1:] > 0, value, 0)
    y = jnp.arange(padded[0])[:, None] - far
    x = jnp.arange(padded[1], dtype=place.dtype)[None] - far + 0.5
    whole = jnp.floor(place)
    number = whole.astype(int) - first
    # A sprite lies between two slices and is divided between them.
    parts = [(number, share_of(place - whole)), (number + 1, share_of(place - whole - 1))]
    cells = (_GROUP, height, width + 1)

    def add_row(steps, at_row):
        row = at_row.row
        center, half = span(outline, radius, side, at_row)
        facing = 1 + tilt_y * row.astype(place.dtype) + tilt_x * center
        center = center + tilt_x * half * half / 3
        there = (y + row >= 0) & (y + row < height)
        light = (facing[None] * value).reshape(values, -1).T
        if at_row.weight is not None:
            light = at_row.weight * light
        for edge, sign in ((center - half, 1), (center + half, -1)):
            # What begins before the frame is there from its first pixel on.
            end = jnp.clip(x + edge, 0, width)
            cell = jnp.floor(end)
            cut = (end - cell).reshape(-1, 1)
            step = sign * jnp.concatenate([light, cut * light], axis=1)
            for index, share in parts:
                inside = there & (index >= 0) & (index < _GROUP)
                at = (index * height + y + row) * (width + 1) + cell.astype(int)
                at = jnp.where(inside, at, _GROUP * height * (width + 1))
                steps = steps.at[at.reshape(-1)].add(share.reshape(-1, 1) * step, mode="drop")
        return steps, None

    steps = jnp.zeros((_GROUP * height * (width + 1), 2 * values), value.dtype)
    steps = jax.lax.scan(jax.checkpoint(add_row), steps, cuts(outline, far))[0]
    sums = filled(steps.reshape(*cells, 2 * values), axis=2)
    return jnp.moveaxis(sums[:, :, :width], -1, 1)
