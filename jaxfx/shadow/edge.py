"""Percentage-closer filtering near shadow edges alone."""

import functools as ft
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num, UInt32

from jaxfx._arrays import ArrayLike
from jaxfx._checks import WholeNumber, is_concrete, option, whole_number
from jaxfx._meshes import on_any_mesh
from jaxfx.shadow._at_edges import filtered_at_edges
from jaxfx.shadow._edges import find_edges
from jaxfx.shadow.arguments import filter_arguments
from jaxfx.shadow.compare import Kernel, without_gradient
from jaxfx.shadow.receivers import Receivers


Edges = Literal["screen", "depth"]

# The share of edge pixels at which the default dilation covers the filter's footprint. At 1 one
# pixel where light grazes a surface dilates over the whole image; below it, the penumbra is cut
# at the remaining pixels.
_COVERED_SHARE = 0.75


class Candidates(NamedTuple):
    """The pixels that `edge_pcf` filters, and the number of comparisons.

    - `where`: height width; true in the pixels that are filtered, B of I.
    - `comparisons`: a scalar count: `I + B * size**2` with `edges="screen"`; with `"depth"`
      I more, for the smallest and the largest texel are both compared.
    """

    where: Bool[Array, "height width"]
    comparisons: UInt32[Array, ""]


@on_any_mesh
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
    """`pcf` near the edges of shadows alone: O(I + B * size**2) for B of I pixels.

    By default the result is `pcf`'s, for less work. Use it wherever `pcf` would do.

    **Arguments:**

    - `shadow_map`, `receivers`, `size`, `bias`, `slope_bias`, `softness`, `kernel`: as in
      `pcf`: height width, texels and scene units.
    - `edges`: how the pixels to filter are found. `"depth"`: where the nearest and the farthest
      texel under the filter, a running minimum and maximum of the map, are not both lit or both
      in shadow. Nothing is lost: the result is `pcf`'s, to the last bit with the box and no
      softness. `"screen"`, the paper's: near the edges of the hard shadow in the image; the
      other pixels are the hard shadow. Shadows that fall between pixels have no edge and are
      lost.
    - `dilation`: static; pixels by which edges are dilated, of `edges="screen"` alone. Outside
      `jit`, `grad` and `vmap` it may be left out: then it is the 75th percentile of the
      filter's footprint at edge pixels. Where light grazes a surface the footprint grows
      without limit.

    **Returns:** height width, in [0, 1], in the type of the receivers. Any number of pixels may
    be filtered. On a CPU the others cost no filter, and batches are done one by one. On an
    accelerator every pixel is filtered, which is quicker there, and the result is selected.

    **Raises:** `ValueError` as `pcf` does, for an unknown `edges`, a dilation that is not 1 or
    more, one with `edges="depth"`, or none with `edges="screen"` under a transform.

    **Gradient:** `pcf`'s in the pixels that are filtered, on a CPU at the cost of these; zero
    in the others: exact with `edges="depth"`, missing with `"screen"` where that misses pixels.
    Which pixels are filtered is held. Second derivatives cost a full filter.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import OrthographicCamera, shadow
    >>> light_camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> wall = jnp.full((8, 8), 4.0)
    >>> receivers = shadow.receivers(wall, light_camera, light_camera)
    >>> shadow_map = wall.at[:, :4].set(2.0)
    >>> percent = 100 * shadow.edge_pcf(shadow_map, receivers, size=3)
    >>> print(percent[4, 2:6].round())
    [  0.  33.  67. 100.]

    Source: Yu & Choi, an improved PCF technique for the generation of shadows, section 4;
    earlier, Uralsky 2005 (GPU Gems 2, chapter 17) and Evans et al. filter edges alone. Our
    own: the edges by depth, the compaction, the derivatives.
    """
    arguments = (shadow_map, receivers, bias, slope_bias, softness)
    arguments = filter_arguments("edge_pcf", *arguments, size=size, kernel=kernel)
    size = int(size)
    dilation = _checked_dilation("edge_pcf", edges, dilation, size, arguments)
    arguments = without_gradient(kernel, arguments)
    return _edge_pcf(size, kernel, edges, dilation, *arguments)


@on_any_mesh
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

    For a look at its cost. With `edges="screen"` and `dilation=1` the pixels are those next to
    an edge of the hard shadow.

    **Arguments:** as in `edge_pcf`: height width, texels, scene units and pixels.

    **Returns:** `Candidates`.

    **Raises:** `ValueError` as `edge_pcf` does.

    **Gradient:** zero: these are not floats.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import OrthographicCamera, shadow
    >>> light_camera = OrthographicCamera(1.0, [4, 4], jnp.eye(4))
    >>> wall = jnp.full((8, 8), 4.0)
    >>> receivers = shadow.receivers(wall, light_camera, light_camera)
    >>> shadow_map = wall.at[:, :4].set(2.0)
    >>> print(shadow.candidates(shadow_map, receivers, size=3).where[4, 2:6])
    [False  True  True False]

    Source: as `edge_pcf`'s.
    """
    arguments = (shadow_map, receivers, bias, slope_bias, softness)
    arguments = filter_arguments("candidates", *arguments, size=size)
    size = int(size)
    dilation = _checked_dilation("candidates", edges, dilation, size, arguments)
    where = _find_edges(size, edges, dilation, *arguments)
    comparisons_to_find = where.size * (2 if edges == "depth" else 1)
    comparisons_to_filter = jnp.sum(where, dtype=jnp.uint32) * size**2
    return Candidates(where, comparisons_to_find + comparisons_to_filter)


def _checked_dilation(name: str, edges: Any, dilation: Any, size: int, arguments: Any) -> int:
    """The dilation in pixels, `usual_dilation` if it is left out; 0 with `edges="depth"`."""
    option(f"{name}(edges=...)", edges, get_args(Edges))
    if edges == "depth":
        if dilation is not None:
            raise ValueError(
                f'`{name}(dilation=...)` must be left out with `edges="depth"`, which needs '
                f'none: `edges="screen"` dilates, got {dilation!r}.'
            )
        return 0
    if dilation is None:
        if not is_concrete(arguments):
            raise ValueError(
                f"`{name}(dilation=...)` must be given under `jit`, `grad` and `vmap`, where "
                "it can't be taken from the receivers: static, in pixels, got None."
            )
        dilation = usual_dilation(*arguments[:4], size=size)
    return whole_number(f"{name}(dilation=...)", dilation, expected="1 or more pixels")


def usual_dilation(
    shadow_map: Array, receivers: Receivers, bias: Array, slope_bias: Array, size: int
) -> int:
    """The 75th percentile of the filter's footprint at shadow edges, in pixels of the image.

    From one pixel to the next, a receiver's position in the map moves by at least the smallest
    singular value of the Jacobian of (u, v). At silhouettes, where the position jumps, that is
    no smaller. Where light grazes a surface it tends to 0: to cover every edge would dilate
    over the whole image.
    """
    where = _find_edges(size, "screen", 1, shadow_map, receivers, bias, slope_bias, None)
    u, v, z = (np.asarray(field, np.float64) for field in receivers[:3])
    if min(u.shape) < 2:
        return max(u.shape)
    jacobian = np.stack([*np.gradient(u), *np.gradient(v)], axis=-1)
    at_edges = jacobian[np.asarray(where) & (z > 0)].reshape(-1, 2, 2)
    if len(at_edges) == 0:
        return 1
    least_steps = np.linalg.svd(at_edges, compute_uv=False)[:, -1]
    texels_per_pixel = np.quantile(least_steps, 1 - _COVERED_SHARE)
    pixels = np.ceil((size // 2 + 1) / max(texels_per_pixel, 1e-9)) + 1
    return int(min(pixels, max(u.shape)))


@ft.partial(jax.jit, static_argnums=(0, 1, 2))
def _find_edges(size, edges, dilation, *arguments):
    return find_edges(size, edges, dilation, *jax.lax.stop_gradient(arguments))[1]


_edge_pcf = jax.jit(filtered_at_edges, static_argnums=(0, 1, 2, 3))
