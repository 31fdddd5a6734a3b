"""One image over many devices: each computes some of its rows.

| I want | call |
|---|---|
| an effect of an image whose rows lie on several devices | `rows` |
| another view, whose rows several devices share out | `target_rows` |

A batch of images needs neither: `jit(vmap(effect))` of a batch that is sharded along its first
axis computes each image where it lies.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Shaped

from jaxfx._checks import WholeNumber, whole_number
from jaxfx.camera import Camera, PinholeCamera


__all__ = ["rows", "target_rows"]


class _Layout(NamedTuple):
    """Which rows of an image each device has and sees: numbers of rows, and of a first row.

    - `share`: the rows of each device; the last ones may have fewer, or none.
    - `halo`: the rows that each device gets from either neighbour.
    - `window`: the rows that each device sees, its own among them.
    - `starts`: of each device, where its window begins in the image.
    """

    share: int
    halo: int
    window: int
    starts: tuple[int, ...]


def rows(
    function: Callable[..., Any],
    devices: Mesh | AbstractMesh,
    *,
    axis: str | None = None,
    halo: WholeNumber,
    align: WholeNumber = 1,
) -> Callable[..., Any]:
    """An effect of images whose rows lie on several devices, as on one device.

    Each device computes its own rows and gets `halo` more on either side from its neighbours.
    Memory per device falls with the number of devices.

    **Arguments:**

    - `function`: of images. A pixel of its result may depend on pixels up to `halo`
      rows away and on no others, nor on the number of its row.
    - `devices`: a mesh, as `jax.make_mesh` makes it.
    - `axis`: static; the axis of the mesh over which rows are spread: its first by default.
    - `halo`: static; rows that a pixel sees beyond its own, on either side. For a method of
      `dof`, `max_coc / 2 + 2` rounded up, 4 more for `dof.gather`; for `blur.gaussian` half
      the taps of each pass; for `shadow.pcf` 0. That is `dof.layered` with `behind=None`; with
      a second layer it sees `1.5 * max_coc + 2` rows, and `7.5 * max_coc + 9` where it guesses
      one (`dof.peel`: at most three steps of each length of its search); 3 more with
      `mixed="split"`. With fewer rows it is another image near the edges of a share, which
      nothing reports.
    - `align`: static; rows are divided at multiples of it: 4 for `dof.gather`, whose
      low-resolution image has a row for 4.

    **Returns:** a function. Its positional arguments are images, or trees of them, of one
    height: their rows are spread. What has no rows goes by keyword and is on every device. Its
    results are images of that height. If it is a multiple of the number of devices (and of
    `align` on each), they are spread as well.

    **Raises:** `ValueError` for an axis that the mesh lacks or a negative `halo`; the function,
    for images without a common height, or a `halo` of more rows than a device has.

    **Gradient:** that of `function`, exact where that is, with respect to all arguments.

    **Example:**

    >>> import jax
    >>> import jax.numpy as jnp
    >>> from jaxfx import ThinLens, dof, sharding
    >>> image, depth = jnp.ones((8, 8, 3)), jnp.full((8, 8), 4.0)
    >>> lens = ThinLens(aperture=0.1, focus_distance=2.0, focal_pixels=100.0)
    >>> devices = jax.make_mesh((1,), ("rows",))
    >>> scatter = sharding.rows(dof.scatter, devices, halo=5)
    >>> jax.jit(lambda *images: scatter(*images, lens=lens, max_coc=6))(image, depth).shape
    (8, 8, 3)

    A device sees a window that ends where the image does, if it sees that far: so the effect
    treats the image's border itself. All windows have one size. At the image's border what is
    left of it is filled with rows that no result depends on.

    Source: halo exchange as any stencil code has it. Our own: the windows that keep an effect's
    own rule for borders.
    """
    count, axis = _devices("rows", devices, axis)
    halo = whole_number("rows(halo=...)", halo, lambda n: n >= 0, "a count of rows, 0 or more")
    align = whole_number("rows(align=...)", align)

    def call(*images: Any, **others: Any) -> Any:
        height = _height(images)
        if count == 1:
            return function(*images, **others)
        layout = _layout(height, count, halo, align)
        arrays, static = eqx.partition(others, eqx.is_array)

        def part(images, arrays):
            index = jax.lax.axis_index(axis)
            starts = jnp.asarray(layout.starts, jnp.int32)[index]
            own = index * layout.share - starts
            windows = jax.tree.map(lambda x: _window(x, layout, axis), images)
            # The last devices' shares end where the image does not any more.
            end = layout.window + count * layout.share - height
            cut = lambda x: jax.lax.dynamic_slice_in_dim(_filled(x, end), own, layout.share)
            return jax.tree.map(cut, function(*windows, **eqx.combine(arrays, static)))

        filled = jax.tree.map(lambda x: _filled(x, count * layout.share), images)
        spread = PartitionSpec(axis)
        divided = jax.shard_map(
            part, mesh=devices, in_specs=(spread, PartitionSpec()), out_specs=spread
        )
        results = divided(_placed(filled, devices, spread), arrays)
        return _cut(results, devices, height, count * layout.share)

    return call


def target_rows(
    function: Callable[..., Any],
    devices: Mesh | AbstractMesh,
    *,
    axis: str | None = None,
    height: WholeNumber,
) -> Callable[..., Any]:
    """A view from another camera, of which each device computes some rows.

    What it is computed from lies on every device: a ray may go anywhere.

    **Arguments:**

    - `function`: of a camera `target` and of the option `height`, how many rows of its image to
      compute, as `reproject.warp` is.
    - `devices`: a mesh, as `jax.make_mesh` makes it.
    - `axis`: static; the axis of the mesh over which rows are spread: its first by default.
    - `height`: static; of the whole result, in pixels.

    **Returns:** a function of `target`, and of whatever else `function` takes by keyword. Its
    results have `height` rows, spread over the devices if it is a multiple of their number.

    **Raises:** `ValueError` for an axis that the mesh lacks or a height that is not positive.

    **Gradient:** that of `function`, exact where that is, with respect to all arguments.

    **Example:**

    >>> import jax
    >>> import jax.numpy as jnp
    >>> from jaxfx import PinholeCamera, reproject, sharding
    >>> image, depth = jnp.ones((8, 8, 3)), jnp.full((8, 8), 4.0)
    >>> camera = PinholeCamera.from_fov(1.0, height=8, width=8)
    >>> devices = jax.make_mesh((1,), ("rows",))
    >>> warp = sharding.target_rows(reproject.warp, devices, height=8)
    >>> warp(camera, image=image, depth=depth, camera=camera, width=8)[0].shape
    (8, 8, 3)

    Source: our own.
    """
    count, axis = _devices("target_rows", devices, axis)
    height = whole_number("target_rows(height=...)", height)
    share = -(-height // count)

    def call(target: Camera, **others: Any) -> Any:
        if count == 1:
            return function(target=target, height=height, **others)
        arrays, static = eqx.partition((target, others), eqx.is_array)

        def part(arrays):
            target, others = eqx.combine(arrays, static)
            first = jax.lax.axis_index(axis) * share
            return function(target=_from_row(target, first), height=share, **others)

        replicated, spread = PartitionSpec(), PartitionSpec(axis)
        divided = jax.shard_map(part, mesh=devices, in_specs=replicated, out_specs=spread)
        return _cut(divided(arrays), devices, height, count * share)

    return call


def _devices(function: str, mesh: Mesh | AbstractMesh, axis: str | None) -> tuple[int, str]:
    """How many devices lie along the axis, and its name; or a `ValueError`."""
    names = tuple(mesh.axis_names)
    chosen = names[0] if axis is None else axis
    if chosen not in names:
        raise ValueError(
            f"`{function}(axis=...)` must be an axis of the mesh, {names}, got {chosen!r}."
        )
    return mesh.shape[chosen], chosen


def _height(images: Any) -> int:
    """The height of all images; or a `ValueError`."""
    shapes = [jnp.shape(leaf) for leaf in jax.tree.leaves(images)]
    heights = {shape[0] if shape else 0 for shape in shapes}
    if len(heights) != 1 or 0 in heights:
        raise ValueError(
            "`rows(function)(*images)` must be images of one height (what has no rows goes by "
            f"keyword), got the shapes {shapes}."
        )
    return heights.pop()


def _layout(height: int, count: int, halo: int, align: int) -> _Layout:
    """The rows of each device; or a `ValueError`."""
    share = -(-height // (count * align)) * align
    asked, halo = halo, -(-halo // align) * align
    # Of two devices the first may not see both borders of the image.
    most = min(share, height - share) if count == 2 else share
    if halo > most:
        raise ValueError(
            f"`rows(halo=...)` must be at most the rows of one device, {most} of the {height} "
            f"on {count} devices, got {asked}."
        )
    # Ends at the image's end must also lie at multiples of `align` from their start.
    window = share + 2 * halo
    window += (height - window) % align
    starts = []
    for device in range(count):
        first, last = device * share - halo, (device + 1) * share + halo
        starts.append(height - window if last > height else max(first, 0))
    return _Layout(share, halo, window, tuple(starts))


def _window(
    image: Shaped[Array, "share ..."], layout: _Layout, axis: str
) -> Shaped[Array, "window ..."]:
    """The rows that a device sees, of which it has its own and gets its neighbours'."""
    count, share, halo = len(layout.starts), layout.share, layout.halo
    offsets = [start - device * share for device, start in enumerate(layout.starts)]
    above = max(halo, -min(offsets))
    below = max(halo, max(offsets) + layout.window - share)
    # No result depends on what fills the window up; but it must be data: of other numbers the
    # derivative may not be finite, and 0 times that is NaN.
    repeated = lambda row, many: jnp.broadcast_to(row, (many, *image.shape[1:]))
    parts = [repeated(image[:1], above - halo), image, repeated(image[-1:], below - halo)]
    if halo:
        downwards = [(device, device + 1) for device in range(count - 1)]
        upwards = [(device + 1, device) for device in range(count - 1)]
        parts.insert(1, jax.lax.ppermute(image[-halo:], axis, downwards))
        parts.insert(3, jax.lax.ppermute(image[:halo], axis, upwards))
    first = jnp.asarray(offsets, jnp.int32)[jax.lax.axis_index(axis)] + above
    return jax.lax.dynamic_slice_in_dim(jnp.concatenate(parts), first, layout.window)


def _filled(image: Any, height: int) -> Array:
    """The image with its last row repeated up to a height."""
    image = jnp.asarray(image)
    missing = height - image.shape[0]
    if not missing:
        return image
    return jnp.pad(image, [(0, missing)] + [(0, 0)] * (image.ndim - 1), mode="edge")


def _cut(images: Any, mesh: Mesh | AbstractMesh, height: int, rows: int) -> Any:
    """The first rows of images that have `rows` of them."""
    if height == rows:
        return images
    # An explicit mesh cuts no axis that is spread.
    whole = _placed(images, mesh, PartitionSpec())
    return jax.tree.map(lambda image: image[:height], whole)


def _placed(arrays: Any, mesh: Mesh | AbstractMesh, spec: PartitionSpec) -> Any:
    """The arrays where a mesh of explicit axes asks for them; others find their place."""
    if AxisType.Explicit not in mesh.axis_types:
        return arrays
    return jax.sharding.reshard(arrays, NamedSharding(mesh, spec))


def _from_row(camera: Camera, first: Array) -> Camera:
    """The camera of the rows of its image from `first` on."""
    if isinstance(camera, PinholeCamera):
        matrix = camera.intrinsics
        # By the last row, not by the 1 in it: so all entries keep their derivatives.
        moved = matrix.at[1].add(-first.astype(matrix.dtype) * matrix[2])
        return eqx.tree_at(lambda c: c.intrinsics, camera, moved)
    center = camera.center.at[1].add(-first.astype(camera.center.dtype))
    return eqx.tree_at(lambda c: c.center, camera, center)
