"""Collectives, the bytes that they move, and memory per device, by the number of devices.

`python -m benchmarks.collectives` compiles each pattern of `docs/devices.md` for 1, 2, 4 and 8
devices of one CPU and prints a table: collectives of the compiled program, the bytes that they
move per device, and the bytes of each device's arguments, result and temporary memory. Nothing
is run: these are counts, not times.
"""

import math
import os
import re


os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=8"

import jax
import jax.numpy as jnp
from jax.sharding import NamedSharding, PartitionSpec

from jaxfx import PinholeCamera, ThinLens, dof, reproject, sharding


COUNTS = (1, 2, 4, 8)
FRAMES, SIDE = 8, 64
COLLECTIVE = re.compile(
    r"= (?P<result>\(?[^=]*?) (?P<name>all-gather|all-reduce|all-to-all|collective-permute"
    r"|reduce-scatter|collective-broadcast)(?:-start)?\("
)
SHAPE = re.compile(r"\b[a-z]+(?P<bits>\d+)\[(?P<sizes>[\d,]*)\]")
LENS = ThinLens(0.1, 2.0, 100.0)


def moved(text):
    """The names of the collectives of a compiled program, and the bytes of their results."""
    names, total = [], 0
    for found in COLLECTIVE.finditer(text):
        names.append(found["name"])
        for shape in SHAPE.finditer(found["result"]):
            sizes = [int(size) for size in shape["sizes"].split(",") if size]
            total += math.prod(sizes) * int(shape["bits"]) // 8
    return names, total


def gradient(function):
    """The gradient of the sum of squares of an effect of an image and its depth."""
    energy = lambda image, depth: jnp.sum(function(image, depth) ** 2)
    return jax.grad(energy, (0, 1))


def patterns(devices):
    """For each pattern a function, and the shapes of its sharded arguments."""
    blurred = lambda image, depth: dof.scatter(image, depth, LENS, max_coc=16.0)
    batch = (FRAMES, SIDE, SIDE, 3), (FRAMES, SIDE, SIDE)
    rows = (8 * SIDE, SIDE, 3), (8 * SIDE, SIDE)
    everywhere, spread = PartitionSpec(), PartitionSpec("devices")

    def step(image, depth):
        def loss(lens):
            blurred = lambda image, depth: dof.scatter(image, depth, lens, max_coc=16.0)
            each = jax.vmap(blurred)
            return jnp.sum((each(image, depth) - image) ** 2)

        lens = jax.lax.pcast(LENS, "devices", to="varying")
        slopes = jnp.stack(jax.tree.leaves(jax.grad(loss)(lens)))
        return jax.lax.psum(slopes, "devices")

    fitted = jax.shard_map(step, mesh=devices, in_specs=spread, out_specs=everywhere)
    scatter = sharding.rows(dof.scatter, devices, halo=10)
    by_rows = lambda image, depth: scatter(image, depth, lens=LENS, max_coc=16.0)
    warp = sharding.target_rows(reproject.warp, devices, height=8 * SIDE)
    camera = PinholeCamera.from_fov(1.0, height=8 * SIDE, width=SIDE)
    warped = lambda image, depth: warp(
        camera, image=image, depth=depth, camera=camera, width=SIDE
    )
    return {
        "a batch, values": (jax.vmap(blurred), batch, spread),
        "a batch, gradients": (jax.vmap(gradient(blurred)), batch, spread),
        "one lens of all frames, a step": (fitted, batch, spread),
        "rows of `dof.scatter`, values": (by_rows, rows, spread),
        "rows of `dof.scatter`, gradients": (gradient(by_rows), rows, spread),
        "target rows of `reproject.warp`": (warped, rows, everywhere),
    }


def main():
    """Print the table."""
    print("| pattern | devices | collectives | bytes moved | arguments | result | temporary |")
    print("|---|---:|---|---:|---:|---:|---:|")
    for count in COUNTS:
        devices = jax.make_mesh((count,), ("devices",), devices=jax.devices()[:count])
        for name, (function, shapes, spec) in patterns(devices).items():
            placed = NamedSharding(devices, spec)
            data = [
                jax.ShapeDtypeStruct(shape, jnp.float32, sharding=placed) for shape in shapes
            ]
            compiled = jax.jit(function).lower(*data).compile()
            names, total = moved(compiled.as_text())
            told = ", ".join(f"{names.count(n)} {n}" for n in sorted({*names})) or "none"
            used = compiled.memory_analysis()
            assert used
            sizes = (
                used.argument_size_in_bytes,
                used.output_size_in_bytes,
                used.temp_size_in_bytes,
            )
            cells = (name, count, told, total, *sizes)
            print("|", " | ".join(map(str, cells)), "|", flush=True)


if __name__ == "__main__":
    main()
