"""The first crossing of rays with a depth map."""

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import WholeNumber, option, parameter, whole_number
from jaxfx._meshes import on_any_mesh
from jaxfx._numerics import working_dtype
from jaxfx.reproject._crossings import coordinates
from jaxfx.reproject._hit import patch_point, texel_point
from jaxfx.reproject._searches import first_crossing
from jaxfx.reproject._traversal import LARGEST_SIDE
from jaxfx.reproject.arguments import Search, check_search


class Hit(NamedTuple):
    """Where rays meet a depth map.

    - `position`: ... 3, texels and depth; where a ray misses, its origin.
    - `mask`: ..., whether it hits.
    - `steps`: ..., an integer, the cells of the pyramid, or points of the ray, that were
      compared.
    - `exhausted`: ..., whether `max_steps` ended the search; such a ray counts as a miss.
    - `grazing`: ..., with "texel", whether the ray runs along the texel's top: the derivative
      of its time is then 0. With "bilinear", whether it misses the patch or meets it too
      obliquely: position and derivative are then those of "texel".
    """

    position: Float[Array, "*ray 3"]
    mask: Bool[Array, "*ray"]
    steps: Int[Array, "*ray"]
    exhausted: Bool[Array, "*ray"]
    grazing: Bool[Array, "*ray"]


@on_any_mesh
def intersect(
    depth: Num[ArrayLike, "height width"],
    origin: Float[ArrayLike, "*ray 3"],
    direction: Float[ArrayLike, "*ray 3"],
    *,
    search: Search = "pyramid",
    max_steps: WholeNumber | None = None,
    surface: Literal["texel", "bilinear"] = "texel",
) -> Hit:
    """The first crossing of each ray with a depth map, for own effects in image space.

    "pyramid" is exact: it finds what a comparison with every texel would find. The other
    searches are baselines that err.

    **Arguments:**

    - `depth`: height width, any measure that grows away from the viewer and in which rays are
      straight; at most 8192 x 8192. What is NaN, 0 or negative is missing, and is never hit;
      inf is never reached.
    - `origin`: ... 3, (x, y) in texels, pixel centres at +0.5, and depth. It may lie outside.
    - `direction`: ... 3, in the same units, of any length and sign; x, y or z may be 0.
    - `search`: "pyramid", "descent", "linear" or "relief", see below.
    - `max_steps`: static; "pyramid": a bound on each ray's steps, None for no bound;
      "descent": levels, None for all; "linear" and "relief": equal steps, None for 64.
    - `surface`: "texel" for the columns; "bilinear" moves each hit along its ray to the patch
      through the four texel centres around it, where that is within a texel and a half.

    **Returns:** a `Hit`, in the type of `depth` or of the rays, whichever is wider.

    **Raises:** `ValueError` for a wrong shape, a size over 8192, an unknown `search` or
    `surface`, or `max_steps` below 1.

    **Gradient:** exact for the point where a ray meets the column or the patch that it hits,
    with respect to `depth`, `origin` and `direction`; second derivatives are not. Missing:
    which texel is hit, what comes into sight or leaves it. Zero for a miss, but with respect to
    its origin. With a baseline search, the derivative is that of the texel that it returned.

    **Example:** a ray from above meets a step 1 high.

    >>> import numpy as np
    >>> from jaxfx import reproject
    >>> depth = np.full((8, 8), 2.0, np.float32)
    >>> depth[:, 4:] = 1.0
    >>> origin, direction = np.array([0.5, 3.5, 0.0]), np.array([4.0, 0.0, 1.0])
    >>> hit = reproject.intersect(depth, origin, direction)
    >>> bool(hit.mask), hit.position.tolist()
    (True, [4.5, 3.5, 1.0])

    Texel (j, i) is a column over [i, i + 1) x [j, j + 1) that begins at its depth and extends
    without end. The hit is the first t >= 0 at which origin + t direction lies inside the
    image and z(t) >= depth[floor y, floor x]: on a column's top, or through its side.

    "pyramid" traverses a minimum pyramid from cell to cell, down where a cell's depth is
    reached and up where the ray has gone far. "descent" goes from the root to a leaf and
    ignores the borders of cells: it passes occluders beside its path. "linear" takes equal
    steps, then one secant step; "relief" takes equal steps, then bisects the last: both step
    over whatever is thinner than a step.

    Source: Oh & Ki 2006, displacement mapping with an image pyramid, as used by Kim, Ki, Lee
    & Oh ("descent"); Musgrave 1991, grid tracing; Brawley & Tatarchuk 2004 ("linear");
    Policarpo, Oliveira & Comba 2005 ("relief"). The traversal of "pyramid" is our own.
    """
    depth, origin, direction = (
        parameter(f"intersect({name})", value, None)
        for name, value in (("depth", depth), ("origin", origin), ("direction", direction))
    )
    _check(depth, origin, direction, search, max_steps, surface)
    dtype = working_dtype(depth.dtype, origin.dtype, direction.dtype)
    depth, origin, direction = (x.astype(dtype) for x in (depth, origin, direction))
    steps = None if max_steps is None else int(max_steps)
    return _intersect(depth, origin, direction, search, steps, surface)


@eqx.filter_jit
def _intersect(depth, origin, direction, search, max_steps, surface) -> Hit:
    """`intersect` of checked arguments. The height field of the search is the depth itself."""
    height_field = jnp.where(depth > 0, depth, jnp.inf)
    batch = origin.shape[:-1]
    flat_origin, flat_direction = (coordinates(x.reshape(-1, 3)) for x in (origin, direction))
    hit = first_crossing(height_field, flat_origin, flat_direction, search, max_steps)
    if surface == "texel":
        point = texel_point(height_field, flat_origin, flat_direction, hit)
    else:
        point = patch_point(height_field, flat_origin, flat_direction, hit, None)
    position = jnp.stack(point.position, axis=-1).reshape(*batch, 3)
    return Hit(
        jnp.where(hit.mask.reshape(*batch, 1), position, origin),
        *(x.reshape(batch) for x in (hit.mask, hit.steps, hit.exhausted, point.grazing)),
    )


def _check(depth, origin, direction, search, max_steps, surface) -> None:
    """Raise `ValueError` for a wrong argument of `intersect`."""
    if depth.ndim != 2 or 0 in depth.shape or max(depth.shape) > LARGEST_SIDE:
        raise ValueError(
            "`intersect(depth)` must have shape (height, width), each from 1 to "
            f"{LARGEST_SIDE}, got {depth.shape}. Batches are made with `jax.vmap`."
        )
    for name, rays in (("origin", origin), ("direction", direction)):
        if rays.shape[-1:] != (3,):
            raise ValueError(f"`intersect({name})` must have shape (..., 3), got {rays.shape}.")
    if origin.shape != direction.shape:
        raise ValueError(
            f"`intersect(direction)` must have the origin's shape {origin.shape}, "
            f"got {direction.shape}."
        )
    check_search("intersect", search)
    option("intersect(surface=...)", surface, ("texel", "bilinear"))
    if max_steps is not None:
        name, expected = "intersect(max_steps=...)", "a positive integer or None"
        whole_number(name, max_steps, expected=expected)
