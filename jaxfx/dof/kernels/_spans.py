"""Scatter by spans: small sprites by `tiles`, all others painted row by row.

The leak rejection couples source and destination, and yet spans carry it exactly. It reads
`1 - sharp_q * clip01((C_p - C_q) / epsilon)`, and `sharp_q` is 0 from `C_q = 2 epsilon` on: so
where `C_p >= 3 epsilon` the clamp is 1 wherever it matters, and the factor is `1 - sharp_q`
whatever the source, a weight on the finished sum. Sources below 3 epsilon go by `tiles`, which
then reach 1.5 epsilon only. Foreground sources have no factor at all. The cost is pixels times
(epsilon squared + radius).

A running sum rounds what it carries: values that are large beside what a pixel sums to go by
`tiles` as well.

What it does not do well: below a radius of about eight, `tiles` are quicker.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfx._numerics import clip01
from jaxfx._xla import sum_planes
from jaxfx.dof.kernels import _tiles
from jaxfx.dof.kernels._adjoint import Program, with_adjoint
from jaxfx.dof.kernels._paint import paint, read_back
from jaxfx.dof.kernels._taps import Planes, inside, to_planes
from jaxfx.dof.sprites import POINT_RADIUS, Sprites


# From this many epsilons on, the leak rejection no longer depends on the source.
_UNCOUPLED = 3.0
# A value this many times what a pixel usually sums to would leave 1e-6 of that along its row.
_HIGHLIGHT = 16.0


def spans(sprites: Sprites, reach: int) -> Float[Array, "height width value"]:
    """The sums over all sprites that reach at most `reach` pixels along an axis."""
    return jnp.moveaxis(_sums(reach, to_planes(sprites)), 0, -1)


def _parts(
    planes: Planes,
) -> tuple[Bool[Array, "height width"], Planes, list[Float[Array, "height width"]]]:
    """Which sprites go by tiles; those; the radii of the others before and behind the focus."""
    value, radius, leak, coc = planes
    direct = (coc < _UNCOUPLED) | _too_bright(value, radius)
    near = Planes(
        jnp.where(direct[None], value, 0), jnp.where(direct, radius, POINT_RADIUS), leak, coc
    )
    layers = [jnp.where(~direct & layer, radius, 0) for layer in (leak < 0, leak >= 0)]
    return direct, near, layers


def _too_bright(
    value: Float[Array, "value height width"], radius: Float[Array, "height width"]
) -> Bool[Array, "height width"]:
    """Where a value is far above what a pixel sums to, the brightest pixels left aside."""
    size = jnp.abs(value).max(axis=0)
    total = jnp.pi * radius * radius * size
    usual = jnp.mean(total)
    for _ in range(3):
        usual = jnp.mean(jnp.minimum(total, usual))
    return size > _HIGHLIGHT * usual


def _forward(reach: int, planes: Planes) -> Float[Array, "value height width"]:
    _, near, (before, behind) = _parts(planes)
    value, blurred = planes.value, clip01(planes.coc - 1)
    sums = blurred[None] * paint(reach, value, behind)
    sums = sums + paint(reach, value, before)
    return sums + _tiles.forward(reach, near)


def _tangent(reach: int, planes: Planes, dot: Planes) -> Float[Array, "value height width"]:
    direct, near, (before, behind) = _parts(planes)
    value, blurred = planes.value, clip01(planes.coc - 1)
    dots = dot.value, dot.radius
    sums = blurred[None] * paint(reach, value, behind, dots)
    blurred_dot = inside(planes.coc - 1) * dot.coc
    sums = sums + blurred_dot[None] * paint(reach, value, behind)
    sums = sums + paint(reach, value, before, dots)
    near_dot = dot._replace(
        value=jnp.where(direct[None], dot.value, 0), radius=jnp.where(direct, dot.radius, 0)
    )
    return sums + _tiles.tangent(reach, near, near_dot)


def _adjoint(reach: int, planes: Planes, bar: Float[Array, "value height width"]) -> Planes:
    # One after the other, each adding to what the last one left: so they share their memory.
    direct, near, (before, behind) = _parts(planes)
    value, blurred = planes.value, clip01(planes.coc - 1)
    near_bar = _tiles.adjoint(reach, near, bar)
    blurred_bar = sum_planes(bar * paint(reach, value, behind))
    bars = (
        jnp.where(direct[None], near_bar.value, 0),
        jnp.where(direct, near_bar.radius, 0),
    )
    bars = read_back(reach, value, before, bar, bars)
    bars = read_back(reach, value, behind, bar, bars, blurred)
    coc_bar = near_bar.coc + inside(planes.coc - 1) * blurred_bar
    return Planes(*bars, near_bar.leak, coc_bar)


SPANS = Program(_forward, _tangent, _adjoint)
_sums = with_adjoint(*SPANS, _tiles.plain)
