"""Every effect on whatever accelerator JAX finds, beside native CUDA and the CPU's values.

`python -m benchmarks.devices --out devices.json` measures in under four minutes, prints a table
and writes the same as JSON. Without an accelerator it ends with a message, unless `--cpu` is
given: then every row runs on the CPU, at the size of `--side`.

Milliseconds are wall-clock times of blocked calls: the median of at least five and their range.
Compilation is listed apart. `floor` is the least time of a kernel: every input read once and
every output written once, at the card's bandwidth, or the arithmetic of all taps at its speed,
whichever is longer; GB/s are those bytes over the time. `differs` is the share of values that
differ from the CPU's by more than a thousandth of the largest.

The native kernels of scatter are its sums alone: they are given sprites, not pixels.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jaxtyping import Array, Float

from benchmarks.native import cuda
from benchmarks.scenes.discs import two_discs
from jaxfx import GBuffer, PinholeCamera, PointLight, ThinLens, dof, relight, reproject, shadow
from jaxfx._pyramid import minimum_pyramid
from jaxfx.dof.arguments import pixels
from jaxfx.dof.kernels import TILES, to_planes
from jaxfx.dof.scatter import to_sprites
from jaxfx.dof.sprites import reach
from jaxfx.fit._descent import _begin, _default_solver, _Objective, _step


# Bytes and float32 operations per second, by the beginning of a card's name.
CARDS = {
    "NVIDIA H200": (4.8e12, 60e12),
    "NVIDIA H100": (3.35e12, 60e12),
    "NVIDIA A100": (2.0e12, 19e12),
    "NVIDIA L4": (0.3e12, 30e12),
}
# Operations of one tap of scatter, over its four planes.
TAP = 20
# Seconds after which no further row is started.
SECONDS = 225.0


class Row(NamedTuple):
    """An effect as a function of arrays, its data, and the operations that any kernel needs."""

    function: Callable[..., Any]
    data: tuple[Any, ...]
    operations: float = 0.0


def squared(function):
    """The gradient of the sum of squares in all arguments."""
    loss = lambda *data: jnp.sum(function(*data) ** 2)
    return lambda *data: jax.grad(loss, tuple(range(len(data))))(*data)


def depth_of_field(side):
    """The methods of depth of field, on two discs before a wall."""
    rows = {}
    for radius in (8, 32):
        data, room = _discs(side, radius), 2.0 * radius
        scatter = lambda *data, room=room: dof.scatter(*data, gamma=2.0, max_coc=room)
        layered = lambda *data, room=room: dof.layered(*data, max_coc=room, behind=None)
        taps = TAP * side**2 * (2 * radius + 1) ** 2
        rows[f"scatter, radius {radius}"] = Row(scatter, data, taps)
        rows[f"scatter, gradient, radius {radius}"] = Row(squared(scatter), data, 3 * taps)
        rows[f"layered, radius {radius}"] = Row(layered, data, taps)
        if radius == 8:
            four = tuple(jnp.stack([x] * 4) for x in data[:2])
            batch = jax.vmap(scatter, (0, 0, None))
            rows["scatter, batch of 4, radius 8"] = Row(batch, (*four, data[2]), 4 * taps)
            rows["layered, gradient, radius 8"] = Row(squared(layered), data, 3 * taps)
    data = _discs(side, 8)
    for name in ("depth_sorted", "gather", "separable", "anisotropic_diffusion"):
        method = lambda *data, name=name: getattr(dof, name)(*data, max_coc=16.0)
        rows[f"{name}, radius 8"] = Row(method, data)
    implicit = lambda *data: dof.implicit_diffusion(*data, max_coc=16.0)
    return rows | {"implicit_diffusion, radius 8": Row(implicit, data)}


def wide(side):
    """An image of 1920 x 1080, at a radius of 16."""
    height, width = 1080 * side // 512, 1920 * side // 512
    image, depth, lens = two_discs(max(height, width), 16)
    scatter = lambda *data: dof.scatter(*data, gamma=2.0, max_coc=32.0)
    data = (
        jnp.asarray(image[:height, :width]),
        jnp.asarray(depth[:height, :width]),
        _traced(lens),
    )
    return {
        f"scatter, {width} x {height}, radius 16": Row(
            scatter, data, TAP * height * width * 33**2
        )
    }


def reprojection(side):
    """A relief from the side, from one image and from eight."""
    images, depths, cameras = map(
        list, zip(*(_view(side, 0.1 * k) for k in range(8)), strict=True)
    )
    target = _view(side, 0.25)[2]
    return {
        "warp": Row(reproject.warp, (images[0], depths[0], cameras[0], target)),
        "blend of 8 sources": Row(reproject.blend, (images, depths, cameras, target)),
    }


def shadows(side):
    """Two discs over a floor, filtered."""
    data = _shadow(side)
    camera = PinholeCamera.from_fov(0.8, height=side, width=side)
    options = {"size": 7, "bias": 0.05}
    pcf = lambda *data: shadow.pcf(*data, **options)
    edge = lambda *data: shadow.edge_pcf(*data, edges="depth", **options)
    soft = lambda *data: shadow.pcss(*data, light_size=0.2, **options)
    return {
        "pcf 7 x 7": Row(pcf, data, 2 * 49 * side**2),
        "edge_pcf 7 x 7": Row(edge, data),
        "pcss 7 x 7": Row(soft, (*data, camera)),
    }


def lighting(side):
    """A relief under eight lights, an edit of one, and a new view from four caches."""
    gbuffers, cameras = map(list, zip(*(_cache(side, 0.1 * k) for k in range(4)), strict=True))
    lights = [_light(k) for k in range(8)]
    state = relight.start(gbuffers[0], cameras[0], lights)
    edit = lambda state, light: state.edit(0, light).image
    _, depth, target = _view(side, 0.15)

    def view(gbuffers, cameras, target, depth):
        found, views = relight.synthesize(gbuffers, cameras, target, depth=depth)
        return relight.fill_holes(found, views)[0]

    return {
        "render of 8 lights": Row(relight.render, (gbuffers[0], cameras[0], lights)),
        "one edit of 8 lights": Row(edit, (state, _light(9))),
        "synthesize from 4 caches, filled": Row(view, (gbuffers, cameras, target, depth)),
    }


class Misfit(eqx.Module):
    """The difference between an image by scatter and another one, as a function of the lens."""

    reference: Float[Array, "height width channel"]
    image: Float[Array, "height width channel"]
    depth: Float[Array, "height width"]

    def __call__(self, unknowns: dict[str, Any]) -> Float[Array, "height width channel"]:
        values = dict(unknowns)
        lens = ThinLens(values.pop("aperture"), values.pop("focus_distance"), 16 / 0.375)
        picture = dof.scatter(self.image, self.depth, lens, max_coc=16.0, **values)
        return (picture - self.reference).astype(float)  # as `fit.dof` has it


def fitting(side):
    """One Levenberg-Marquardt step of `fit.dof` in all of its four parameters."""
    image, depth, lens = _discs(side, 8)
    reference = dof.scatter(image, depth, lens, gamma=2.0, max_coc=16.0)
    solver = _default_solver()
    start = {"aperture": 0.9, "focus_distance": 2.1, "gamma": 1.5, "epsilon": 1.5}

    def step(misfit, unknowns):
        objective = _Objective(misfit, False)
        return _step(solver, objective, unknowns, _begin(solver, objective, unknowns))[:3]

    data = Misfit(reference, image, depth), jax.tree.map(jnp.asarray, start)
    return {"fit.dof, one step in 4 parameters": Row(step, data)}


GROUPS = (depth_of_field, wide, reprojection, shadows, lighting, fitting)


def _discs(side, radius):
    image, depth, lens = two_discs(side, radius)
    return jnp.asarray(image), jnp.asarray(depth), _traced(lens)


def _traced(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)


def _view(side, right):
    """A wavy relief, its depth, and the camera `right` of its middle that sees it."""
    y, x = np.mgrid[:side, :side].astype(np.float32) / side
    depth = 4 + 0.3 * np.sin(9 * x + 3 * right) + 0.2 * np.cos(11 * y) - (abs(x - 0.5) < 0.1)
    image = np.stack([x, y, 0.5 + 0.5 * np.sin(40 * x * y)], axis=-1)
    eye = np.array([right, 0.0, 0.0])
    size = {"height": side, "width": side}
    camera = PinholeCamera.look_at(
        eye, eye + np.array([0, 0, 1]), up=[0, -1, 0], fov_y=0.8, **size
    )
    return jnp.asarray(image, jnp.float32), jnp.asarray(depth, jnp.float32), _traced(camera)


def _cache(side, right):
    image, depth, camera = _view(side, right)
    slope = jnp.stack([jnp.gradient(depth, axis=1), jnp.gradient(depth, axis=0)], axis=-1)
    normal = jnp.concatenate([slope * side / 8, -jnp.ones_like(depth[..., None])], axis=-1)
    normal = normal / jnp.linalg.norm(normal, axis=-1, keepdims=True)
    shader = jnp.full(depth.shape, 2, jnp.int32)
    fields = {"ambient": image, "diffuse": image, "specular": image, "normal": normal}
    return GBuffer(
        color=image, shader=shader, depth=depth, roughness=0.5 + 0 * depth, **fields
    ), camera


def _light(k):
    angle = 0.7 * k
    return _traced(PointLight(np.array([np.cos(angle), np.sin(angle), 0.5]), np.full(3, 0.5)))


def _shadow(side):
    """A map of two discs over a floor at 5, and receivers on the floor, seen turned."""
    y, x = np.mgrid[:side, :side] + 0.5
    shadow_map = np.full((side, side), 5.0)
    for cx, cy, radius, depth in ((0.3, 0.35, 0.13, 2.0), (0.68, 0.62, 0.16, 3.0)):
        shadow_map[np.hypot(x / side - cx, y / side - cy) < radius] = depth
    c, s = 0.9 * np.cos(0.2), 0.9 * np.sin(0.2)
    u, v = c * (x - side / 2) - s * (y - side / 2), s * (x - side / 2) + c * (y - side / 2)
    fields = u + side / 2, v + side / 2, np.full_like(u, 5.0), 0 * u
    receivers = shadow.Receivers(*(jnp.asarray(each, jnp.float32) for each in fields))
    return jnp.asarray(shadow_map, jnp.float32), receivers


def measured(row, device):
    """Seconds to compile, milliseconds of every call, and what it gives as NumPy arrays."""
    data = jax.device_put(row.data, device)
    start = time.perf_counter()
    compiled = jax.jit(row.function).lower(*data).compile()
    seconds = time.perf_counter() - start
    call = lambda: jax.block_until_ready(compiled(*data))
    out = [np.asarray(leaf) for leaf in jax.tree.leaves(call())]
    return seconds, timed(call), out


def timed(call):
    """Milliseconds of at least five calls; more while a second and a half is not over."""
    call()
    times, begin = [], time.perf_counter()
    while len(times) < 5 or (len(times) < 50 and time.perf_counter() - begin < 1.5):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    return times


def share_that_differs(found, expected):
    """Of all numbers, those that are further apart than a thousandth of the largest."""
    differs = total = 0
    for pair in zip(found, expected, strict=True):
        one, other = (np.asarray(each, np.float64) for each in pair)
        largest = np.abs(other[np.isfinite(other)]).max(initial=0)
        same = (one == other) | (np.isnan(one) & np.isnan(other))
        with np.errstate(invalid="ignore"):
            same |= np.abs(one - other) <= 1e-3 * largest
        differs, total = differs + np.sum(~same), total + same.size
    return float(differs / total)


def summary(times):
    """The median and the range."""
    return {"ms": statistics.median(times), "range_ms": [min(times), max(times)]}


def record(name, row, device, cpu):
    """One line of the table."""
    seconds, times, out = measured(row, device)
    moved = sum(x.nbytes for x in jax.tree.leaves(row.data)) + sum(x.nbytes for x in out)
    found = {"effect": name, "compile_s": seconds, **summary(times), "bytes": moved}
    found["gb_per_s"] = moved / found["ms"] / 1e6
    speeds = [v for k, v in CARDS.items() if device.device_kind.startswith(k)]
    if speeds:
        bandwidth, flops = speeds[0]
        found["floor_ms"] = 1e3 * max(moved / bandwidth, row.operations / flops)
    if device != cpu:
        expected = measured_value(row, cpu)
        found["differs"] = share_that_differs(out, expected)
    return found


def measured_value(row, device):
    """The result of one call of a row on another device."""
    out = jax.jit(row.function)(*jax.device_put(row.data, device))
    return [np.asarray(leaf) for leaf in jax.tree.leaves(out)]


def native_rows(side):
    """The same sums by native CUDA: each a name, what it stands beside, and how it is made."""
    rows = []
    for radius in (8, 32):
        for bar in (False, True):
            what = "scatter, gradient" if bar else "scatter"
            make = lambda cupy, module, r=radius, bar=bar: _native_sums(
                cupy, module, side, r, bar
            )
            rows.append((f"{what}, radius {radius}", make))
    rows.append(("pcf 7 x 7", lambda cupy, module: _native_pcf(cupy, module, side)))
    rows.append(("walk of the warp's pyramid", lambda *with_: _native_walk(*with_, side)))
    return rows


def _native_sums(cupy, module, side, radius, bar):
    image, depth, lens = _discs(side, radius)
    seen, room = pixels(image, depth, lens), 2.0 * radius
    gamma, epsilon = jnp.float32(2), jnp.float32(2)
    sprites = to_sprites(seen.image, seen.depth, lens, gamma, epsilon, room, seen.missing)
    planes, far = to_planes(sprites), reach(room)
    weight = jnp.sin(jnp.arange(planes.value.size, dtype=jnp.float32)).reshape(
        planes.value.shape
    )
    on_card = [cupy.asarray(np.ascontiguousarray(x)) for x in (*planes, weight)]
    call, out = cuda.sums(cupy, module, on_card[:4], far, on_card[4] if bar else None)
    ours = TILES.adjoint(far, planes, weight) if bar else [TILES.forward(far, planes)]
    return call, out, ours


def _native_pcf(cupy, module, side):
    shadow_map, receivers = _shadow(side)
    given = [cupy.asarray(np.asarray(x)) for x in (shadow_map, *receivers[:3])]
    lit, sizes = (
        cupy.empty_like(given[1]),
        (np.float32(0.05), *map(np.int32, (side,) * 4 + (7,))),
    )
    call = lambda: cuda.launch(module, "pcf", cuda.grid_of(side, side), (lit, *given, *sizes))
    return call, [lit], [shadow.pcf(shadow_map, receivers, size=7, bias=0.05)]


def _native_walk(cupy, module, side):
    """The rays of the row "warp": those of a view from the side, in pixels of the first."""
    depth = _view(side, 0.0)[1]
    pyramid = minimum_pyramid(depth)
    x, y = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5)
    near = float(depth.min()) - 0.1
    origins = np.stack([x, y, np.full_like(x, near)], -1).reshape(-1, 3)
    directions = np.tile([0.06 * side, 0.01 * side, 1.0], (side**2, 1))
    columns = [shape[1] for shape in pyramid.shapes]
    data = [np.asarray(pyramid.values), np.int32(pyramid.offsets), np.int32(columns)]
    data += [origins.astype(np.float32), directions.astype(np.float32)]
    given = [cupy.asarray(x) for x in data]
    times = cupy.empty(side**2, np.float32)
    sizes = map(np.int32, (len(columns), side, side, side**2))
    arguments = (times, *given, *sizes)
    call = lambda: cuda.launch(module, "walk", (-(-(side**2) // 256),), arguments)
    return call, [times], None


def beside_native(rows, side):
    """Milliseconds of native CUDA and the ratio of ours to them; or why there are none."""
    if (cupy := cuda.cupy()) is None:
        return "CuPy is not there: no native CUDA was measured."
    module, found = cupy.RawModule(code=cuda.SOURCE), []
    ours_ms = {row["effect"]: row["ms"] for row in rows if "ms" in row}
    for name, make in native_rows(side):
        call, out, ours = make(cupy, module)

        def waited(call=call):
            call()
            cupy.cuda.Device().synchronize()

        row = {"effect": name, **summary(timed(waited))}
        if ours is not None:
            row["differs"] = share_that_differs([cupy.asnumpy(x) for x in out], ours)
        if name in ours_ms:
            row["ratio"] = ours_ms[name] / row["ms"]
        found.append(row)
    return found


def table(rows):
    """Lines for people."""
    head = ("ms", 9), ("range", 18), ("GB/s", 8), ("floor", 8), ("compiled, s", 13)
    yield "".join([f"{'effect':36}", *(f"{t:>{n}}" for t, n in (*head, ("differs", 10)))])
    number = lambda row, key, form: format(row[key], form) if key in row else ""
    for row in rows:
        if "ms" not in row:
            yield f"{row['effect']:36}{row['fault']}"
            continue
        low, high = row["range_ms"]
        yield (
            f"{row['effect']:36}{row['ms']:9.3f}{f'{low:.3f}-{high:.3f}':>18}"
            f"{number(row, 'gb_per_s', '8.1f'):>8}{number(row, 'floor_ms', '8.3f'):>8}"
            f"{number(row, 'compile_s', '13.1f'):>13}{number(row, 'differs', '10.1e'):>10}"
            + (f"   {row['ratio']:.1f} times native" if "ratio" in row else "")
        )


def accelerator():
    """The first device that is no CPU, or None."""
    return next((device for device in jax.devices() if device.platform != "cpu"), None)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="where the JSON goes")
    parser.add_argument("--side", type=int, default=512, help="of the pictures, in pixels")
    parser.add_argument(
        "--cpu", action="store_true", help="run on the CPU, to test this script"
    )
    parser.add_argument("--only", help="the rows whose name holds this")
    options = parser.parse_args(arguments)
    cpu = jax.devices("cpu")[0]
    device = cpu if options.cpu else accelerator()
    if device is None:
        print("JAX found no accelerator: nothing was measured. --cpu tests the script.")
        return None
    begin, rows = time.perf_counter(), []
    with jax.default_device(cpu):
        cases = {k: v for group in GROUPS for k, v in group(options.side).items()}
    for name, row in cases.items():
        if options.only and options.only not in name:
            continue
        if time.perf_counter() - begin > SECONDS:
            rows.append({"effect": name, "fault": "not reached in time"})
            continue
        try:
            rows.append(record(name, row, device, cpu))
        except Exception as fault:  # one effect that fails does not hide the others
            rows.append({"effect": name, "fault": f"{type(fault).__name__}: {fault}"[:200]})
        print(*list(table(rows[-1:]))[1:], flush=True)
    native = [] if options.cpu else beside_native(rows, options.side)
    seconds = time.perf_counter() - begin
    found = {
        "card": device.device_kind,
        "jax": jax.__version__,
        "jaxlib": jaxlib.__version__,
        "side": options.side,
        "seconds": seconds,
        "rows": rows,
        "native": native,
    }
    print(
        f"\n{device.device_kind}, jax {jax.__version__}, {seconds:.0f} s in all",
        *table(rows),
        sep="\n",
    )
    print("\nnative CUDA", *([native] if isinstance(native, str) else table(native)), sep="\n")
    if options.out:
        options.out.write_text(json.dumps(found, indent=1))
    return found


if __name__ == "__main__":
    main()
