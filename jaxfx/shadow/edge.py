"""Percentage-closer filtering only where it matters."""

import functools as ft
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Num, UInt32

from jaxfx._checks import WholeNumber, is_concrete, option, whole_number
from jaxfx.shadow import _taps
from jaxfx.shadow._masked import find_mask, masked
from jaxfx.shadow._taps import Kernel
from jaxfx.shadow.receivers import Receivers


Edges = Literal["screen", "depth"]

# The share of edges at which a dilation that is left out is enough.
_USUAL = 0.75


class Candidates(NamedTuple):
    """What `edge_pcf` filters, and what that costs.

    - `where`: height width; the pixels that are filtered, B of I.
    - `comparisons`: a scalar count: `I + B * size**2` with `edges="screen"`; with `"depth"`
      I more, for the smallest and the largest texel are both compared.
    """

    where: Bool[Array, "height width"]
    comparisons: UInt32[Array, ""]


def edge_pcf(
    shadow_map: Num[ArrayLike, "rows columns"],
    receivers: Receivers,
    *,
    size: WholeNumber,
    bias: Float[ArrayLike, ""] | float | None = None,
    slope_bias: Float[ArrayLike, ""] | float | None = None,
    softness: Float[ArrayLike, ""] | float | None = None,
    kernel: Kernel = "box",
    edges: Edges = "depth",
    dilation: WholeNumber | None = None,
) -> Float[Array, "height width"]:
    """Percentage-closer filtering near the edges of shadows alone: O(I + B * size**2).

    With `edges="depth"`, the default, a pixel is filtered where the smallest and the largest of
    its texels, a running minimum and maximum of the map, are not both lit or both shadowed.
    Nothing is lost: the result is `pcf`'s, to the last bit with the box and no softness.

    With `edges="screen"`, the paper's, the edges of the hard shadow are found in the image and
    dilated; what they enclose is filtered, the rest is the hard shadow. Shadows that fall
    between pixels have no edge and are lost.

    **Arguments:**

    - `shadow_map`, `receivers`, `size`, `bias`, `slope_bias`, `softness`, `kernel`: as in
      `pcf`: height width, texels and scene units.
    - `edges`: which pixels are filtered.
    - `dilation`: static; pixels by which edges reach, of `edges="screen"` alone. Outside `jit`,
      `grad` and `vmap` it may be left out, and is then as many as the filter covers at three
      of four edge pixels. Where light grazes a surface it covers more, without limit.

    **Returns:** height width, in [0, 1], in the type of the receivers. Any number of pixels
    may need the filter; where none does, none is filtered. That is so on a CPU, where batches
    are done one by one. On an accelerator every pixel is filtered, which is quicker there, and
    the mask selects.

    **Raises:** `ValueError` as `pcf` does, for an unknown `edges`, a dilation that is not 1 or
    more, one with `edges="depth"`, or none with `edges="screen"` under a transform.

    **Gradient:** `pcf`'s in the pixels that are filtered, on a CPU at the cost of these; zero
    in the others: exact with `edges="depth"`, missing with `"screen"` where that misses. The
    mask is constant. Second derivatives cost a full filter.

    Source: Yu & Choi, an improved PCF technique for the generation of shadows, section 4;
    earlier, Uralsky 2005 (GPU Gems 2, chapter 17) and Evans et al. filter edges alone. Our
    own: the mask by depth, the compaction, the derivatives.
    """
    data = (shadow_map, receivers, bias, slope_bias, softness)
    data = _taps.checked("edge_pcf", *data, size=size, kernel=kernel)
    size = int(size)
    dilation = _reach("edge_pcf", edges, dilation, size, data)
    return _edge_pcf(size, kernel, edges, dilation, *_taps.without_gradient(kernel, data))


def candidates(
    shadow_map: Num[ArrayLike, "rows columns"],
    receivers: Receivers,
    *,
    size: WholeNumber,
    bias: Float[ArrayLike, ""] | float | None = None,
    slope_bias: Float[ArrayLike, ""] | float | None = None,
    softness: Float[ArrayLike, ""] | float | None = None,
    edges: Edges = "depth",
    dilation: WholeNumber | None = None,
) -> Candidates:
    """The pixels that `edge_pcf` filters, and the number of comparisons that it makes.

    With `edges="screen"` and `dilation=1` these are the edges themselves.

    **Arguments:** as in `edge_pcf`: height width, texels, scene units and pixels.

    **Returns:** `Candidates`.

    **Raises:** `ValueError` as `edge_pcf` does.

    **Gradient:** zero: these are not floats.

    Source: as `edge_pcf`'s.
    """
    data = (shadow_map, receivers, bias, slope_bias, softness)
    data = _taps.checked("candidates", *data, size=size)
    size = int(size)
    where = _candidates(size, edges, _reach("candidates", edges, dilation, size, data), *data)
    tests = where.size * (2 if edges == "depth" else 1)
    taps = jnp.sum(where, dtype=jnp.uint32) * size**2
    return Candidates(where, tests + taps)


def _reach(name: str, edges: Any, dilation: Any, size: int, data: Any) -> int:
    """The dilation, checked; found if it is left out; 0 where there is none."""
    option(f"{name}(edges=...)", edges, get_args(Edges))
    if edges == "depth":
        if dilation is not None:
            raise ValueError(
                f'`{name}(dilation=...)` must be left out with `edges="depth"`, which needs '
                f'none: `edges="screen"` dilates, got {dilation!r}.'
            )
        return 0
    if dilation is None:
        if not is_concrete(data):
            raise ValueError(
                f"`{name}(dilation=...)` must be given under `jit`, `grad` and `vmap`, where "
                "it can't be taken from the receivers: static, in pixels, got None."
            )
        dilation = usual_dilation(*data[:4], size=size)
    return whole_number(f"{name}(dilation=...)", dilation, expected="1 or more pixels")


def usual_dilation(
    shadow_map: Array, receivers: Receivers, bias: Array, slope_bias: Array, size: int
) -> int:
    """How many pixels a filter reaches at three of four edge pixels.

    A pixel's step in the map is at least the smallest singular value of the derivative of
    (u, v) in the picture. Where that jumps, at a silhouette, it is no smaller. Where light
    grazes, it tends to 0: what every edge needs is soon the whole picture.
    """
    where = _candidates(size, "screen", 1, shadow_map, receivers, bias, slope_bias, None)
    u, v, z = (np.asarray(each, np.float64) for each in receivers[:3])
    if min(u.shape) < 2:
        return max(u.shape)
    jacobian = np.stack([*np.gradient(u), *np.gradient(v)], axis=-1)
    at_edges = jacobian[np.asarray(where) & (z > 0)].reshape(-1, 2, 2)
    if len(at_edges) == 0:
        return 1
    step = np.quantile(np.linalg.svd(at_edges, compute_uv=False)[:, -1], 1 - _USUAL)
    return int(min(np.ceil((size // 2 + 1) / max(step, 1e-9)) + 1, max(u.shape)))


@ft.partial(jax.jit, static_argnums=(0, 1, 2))
def _candidates(size, edges, dilation, *data):
    return find_mask(size, edges, dilation, *jax.lax.stop_gradient(data))[1]


_edge_pcf = jax.jit(masked, static_argnums=(0, 1, 2, 3))
