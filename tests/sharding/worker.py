"""A process with eight devices, which answers what effects are there, a line of JSON each.

`python -m tests.sharding.worker` reads lines `{"check": NAME, ...}` with that function's other
arguments. JAX counts its devices once, so that they can't be made in the process of the tests:
`XLA_FLAGS` makes them in this one.
"""

import functools
import json
import re
import sys
import traceback
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from jaxfx import PinholeCamera, ThinLens, blur, dof, reproject, shadow, sharding
from tests.helpers import quick
from tests.helpers.fits import FITS
from tests.test_transforms import CASES, FUNCTIONS


DEVICES = 8
COLLECTIVE = re.compile(
    r"\b(all-gather|all-reduce|all-to-all|collective-permute|reduce-scatter"
    r"|collective-broadcast)(?:-start)?\("
)


def collectives(compiled):
    """The names of the collectives in a compiled program, as often as they occur."""
    return COLLECTIVE.findall(compiled.as_text())


def error(found, expected):
    """The largest difference between two trees, against 1 or the expected value."""
    worst = 0.0
    for pair in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        x, y = (np.asarray(leaf).astype(float) for leaf in pair)
        np.testing.assert_array_equal(np.isfinite(x), np.isfinite(y))
        is_finite = np.isfinite(y)
        difference = np.abs(x - y, where=is_finite, out=np.zeros_like(y))
        scale = np.maximum(np.abs(y, where=is_finite, out=np.ones_like(y)), 1)
        worst = max(worst, float(np.max(difference / scale, initial=0)))
    return worst


def mesh_of(kind, shape=(DEVICES,), names=("batch",)):
    """A mesh of JAX's own default, whose axes are explicit, or of automatic axes."""
    types = {} if kind == "explicit" else {"axis_types": (AxisType.Auto,) * len(names)}
    mesh = jax.make_mesh(shape, names, **types)
    assert (AxisType.Explicit in mesh.axis_types) == (kind == "explicit")
    return mesh


@functools.lru_cache(maxsize=1)  # A case is asked for mesh after mesh.
def stacked(name, gradient, size):
    """A case as a function of one member and of a batch, its arguments, and its results.

    These are those of the function of a batch on one device, the members' results first.
    """
    cases = [CASES[name].split(eqx.is_array, size=size, seed=seed) for seed in range(DEVICES)]
    call = cases[0][0]

    def with_gradient(arguments):
        floats, others = eqx.partition(arguments, eqx.is_inexact_array)
        out, pull = jax.vjp(lambda floats: call(eqx.combine(floats, others)), floats)
        return out, pull(out)[0]

    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *(case[1] for case in cases))
    each = jax.vmap(with_gradient if gradient else call)

    def energy(floats, others):
        out = jax.vmap(call)(eqx.combine(floats, others))
        leaves = jax.tree.leaves(eqx.filter(out, eqx.is_inexact_array))
        return sum(jnp.sum(leaf**2) for leaf in leaves) / 2

    def both(batch):
        """The gradient of each member, and that of a sum over all members."""
        slope = jax.grad(energy) if gradient else lambda floats, others: ()
        return each(batch), slope(*eqx.partition(batch, eqx.is_inexact_array))

    expected = jax.jit(each)(batch)
    # The gradient of a sum has those of its members.
    return each, both, batch, (expected, expected[1] if gradient else ())


def batch(name, mesh, gradient=True, size=(9, 7), shape=(DEVICES,), names=("batch",)):
    """A batch of a case over eight devices against one device.

    On an explicit mesh the gradient of a sum over all members is tested as well, for a
    function with its default options.
    """
    each, both, batch, expected = stacked(name, gradient, tuple(size))
    if mesh == "explicit" and name in FUNCTIONS:
        return divided(both, batch, expected, mesh, shape, names)
    return divided(each, batch, expected[0], mesh, shape, names)


@functools.lru_cache(maxsize=1)
def frames(name):
    """A fit as a function of a batch of frames or starts, that batch, and what is found."""
    fitted, data = FITS[name](DEVICES)
    each = jax.vmap(lambda data: fitted(*data))
    return each, data, jax.jit(each)(data)


def fits(name, mesh):
    """A fit of each of eight frames or starts, over eight devices against one device."""
    return divided(*frames(name), mesh)


def divided(mapped, batch, expected, mesh, shape=(DEVICES,), names=("batch",)):
    """A function of a batch over eight devices against its results on one device.

    `mesh` is "explicit" or "auto", for `jit(vmap(f))`, or "shard_map".
    """
    devices, spec = mesh_of(mesh, shape, names), PartitionSpec(names[0])
    placed = jax.device_put(batch, NamedSharding(devices, spec))
    if mesh == "shard_map":
        mapped = jax.shard_map(mapped, mesh=devices, in_specs=spec, out_specs=spec)
    compiled = jax.jit(mapped).lower(placed).compile()
    found = compiled(placed)
    # What is 0 whatever the data are is computed of none, and lies anywhere.
    is_spread = all(
        leaf.sharding.spec[:1] == spec[:1] or not np.any(leaf)
        for leaf in jax.tree.leaves(found)
    )
    return {
        "error": error(found, expected),
        "collectives": collectives(compiled),
        "is_spread": is_spread,
    }


def picture(height, width=7):
    """An image, its depth and points in a light's space, in seeded random numbers."""
    rng = np.random.default_rng(3)
    image = rng.uniform(0.1, 1, (height, width, 3))
    depth = rng.uniform(1.1, 6, (height, width))
    places = rng.uniform(-2, 12, (2, height, width))
    seen = shadow.Receivers(*places, *rng.uniform(1.1, 4, (2, height, width)))
    return image, depth, seen


def _two_layers(image, depth, hidden, farther, lens):
    """`layered` with a second layer, whose rows are spread as well."""
    return dof.layered(image, depth, lens, max_coc=6.0, behind=(hidden, farther))


LENS = ThinLens(0.3, 2.5, 20.0)
MAP = np.random.default_rng(4).uniform(1.1, 4, (10, 10))
# The halo of each effect, where rows have to be divided, its images and what has no rows.
BY_ROWS = {
    "scatter": (5, 1, dof.scatter, 2, {"lens": LENS, "max_coc": 6.0}),
    "layered": (5, 1, dof.layered, 2, {"lens": LENS, "max_coc": 6.0, "behind": None}),
    "layered, two": (11, 1, _two_layers, 4, {"lens": LENS}),
    "layered, peel": (54, 1, dof.layered, 2, {"lens": LENS, "max_coc": 6.0}),
    "gather": (8, 4, dof.gather, 2, {"lens": LENS, "max_coc": 6.0}),
    "separable": (5, 1, dof.separable, 2, {"lens": LENS, "max_coc": 6.0}),
    "blur": (4, 1, blur.gaussian, 1, {"sigma": jnp.asarray(1.5), "taps": 9}),
    "pcf": (
        0,
        1,
        lambda seen, shadow_map: shadow.pcf(shadow_map, seen, size=3, bias=0.1),
        slice(2, 3),
        {"shadow_map": MAP},
    ),
}


def pulled_back(effect, static):
    """A program of images and other arrays: the effect, and the pull-back of its own result."""

    def call(images, arrays):
        run = lambda *data: effect(*data[0], **eqx.combine(data[1], static))
        out, pull = jax.vjp(run, images, arrays)
        return out, pull(out)

    return jax.jit(call)


@functools.lru_cache(maxsize=1)
def whole(name, height):
    """The images of a case of rows, its other arguments, and its result on one device."""
    _, _, effect, which, others = BY_ROWS[name]
    image, depth, seen = picture(height)
    given = image, depth, seen
    if which == 4:  # The second layer lies behind the first.
        given = image, depth, image[::-1], depth + 1 + depth[::-1]
    images = given[which if isinstance(which, slice) else slice(which)]
    arrays, static = eqx.partition(others, eqx.is_array)
    return images, arrays, static, pulled_back(effect, static)(images, arrays)


def rows(name, mesh, height, counts=False):
    """An effect of an image whose rows lie on eight devices, and its gradient."""
    halo, align, effect, *_ = BY_ROWS[name]
    images, arrays, static, expected = whole(name, height)
    devices = mesh_of(mesh)
    divided = sharding.rows(effect, devices, halo=halo, align=align)
    is_even = height % (DEVICES * align) == 0
    placed = images
    if is_even:
        placed = jax.device_put(images, NamedSharding(devices, PartitionSpec("batch")))
    compiled = pulled_back(divided, static).lower(placed, arrays).compile()
    found = compiled(placed, arrays)
    answer = {
        "error": error(found, expected),
        "is_spread": not is_even or found[0].sharding.spec[:1] == ("batch",),
    }
    if counts:
        values = lambda *images: divided(*images, **eqx.combine(arrays, static))
        answer["collectives"] = collectives(jax.jit(values).lower(*placed).compile())
    return answer


def target_rows(mesh, height):
    """`warp`, whose rows eight devices share out, and its gradient."""
    image, depth, _ = picture(9)
    camera = PinholeCamera.from_fov(1.0, height=9, width=7)
    pose = np.eye(4)
    pose[:3, 3] = 0.3, -0.2, 0.1
    target = PinholeCamera.from_fov(0.9, height=height, width=7, world_from_camera=pose)
    divided = sharding.target_rows(reproject.warp, mesh_of(mesh), height=height)

    def with_gradient(warp):
        def call(*data):
            def run(image, depth, camera, target):
                return warp(target=target, image=image, depth=depth, camera=camera, width=7)

            out, pull = jax.vjp(run, *data)
            return out, pull(out)

        return jax.jit(call)

    data = image, depth, camera, target
    single = with_gradient(functools.partial(reproject.warp, height=height))
    return {"error": error(with_gradient(divided)(*data), single(*data))}


def memory(count, side=8192):
    """Bytes of each device for `scatter` of a large image, as compiled."""
    devices = jax.make_mesh((count,), ("rows",), axis_types=(AxisType.Auto,))
    spread = NamedSharding(devices, PartitionSpec("rows"))
    shaped = lambda *shape: jax.ShapeDtypeStruct(shape, jnp.float32, sharding=spread)
    lens = jax.tree.map(lambda x: x.astype(jnp.float32), LENS)
    divided = sharding.rows(dof.scatter, devices, halo=10)
    call = lambda *images: divided(*images, lens=lens, max_coc=16.0)
    compiled = jax.jit(call).lower(shaped(side, side, 3), shaped(side, side)).compile()
    found = compiled.memory_analysis()
    names = ("argument", "output", "temp")
    return {name: getattr(found, f"{name}_size_in_bytes") for name in names}


def page():
    """What the page on many devices computes, block by block."""
    text = (Path(__file__).parents[2] / "docs" / "devices.md").read_text(encoding="utf-8")
    names: dict = {}
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        exec("\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)), names)
    step, frames, lens = names["step"], names["frames"], names["lens"]
    single = jax.tree.map(np.asarray, frames)
    losses = lambda lens: jax.vmap(names["loss"], (None, 0, 0, 0))(lens, *single, single[0])
    slope = jax.grad(lambda lens: losses(lens).sum())(lens)
    assert min(abs(leaf) for leaf in jax.tree.leaves(slope)) > 0
    program = step.lower(lens, *frames, frames[0]).compile()
    assert names["doubts"] == [""] * DEVICES
    np.testing.assert_allclose(names["found"].lens.aperture, 0.1, rtol=1e-2)
    whole = dof.scatter(names["image"], names["depth"], lens, max_coc=6.0)
    return {
        "error": error(
            [names["blurred"], names["same"], names["slope"], names["spread"], names["view"]],
            [
                *[jax.vmap(names["blur"])(*single)] * 2,
                slope,
                whole,
                names["image"],
            ],
        ),
        "collectives": collectives(program),
    }


CHECKS = {
    "page": page,
    "memory": memory,
    "batch": batch,
    "fits": fits,
    "rows": rows,
    "target_rows": target_rows,
}


def main():
    """Answer until the input ends."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_rank_promotion", "raise")
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    assert jax.device_count() == DEVICES
    with quick.quickly():
        for line in sys.stdin:
            asked = json.loads(line)
            try:
                answer = CHECKS[asked.pop("check")](**asked)
            except Exception:
                answer = {"failed": traceback.format_exc()}
            print("answer", json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
