"""The search for crossings against native code, in one run: 512 x 512 rays, float32.

`pytest --benchmark-only tests/benchmarks/test_reproject_speed.py` prints each group with the
ratios to its quickest. The floor: some 17 to 23 steps a ray, each one read of the pyramid.
"""

import jax
import jax.numpy as jnp
import native_reproject
import numpy as np
import pytest

from jaxfx import PinholeCamera, scene
from jaxfx._pyramid import minimum_pyramid
from jaxfx.reproject import intersect, warp


# Image widths that a ray crosses on its way through all of the depth.
SLANTS = {"slight": 0.1, "slanting": 0.5, "grazing": 2.0}


def hills(side):
    """Smooth hills with forty discs before them."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:side, :side] / side
    depth = 0.6 + 0.15 * np.sin(9 * x + 3 * y) * np.cos(7 * y - x)
    depth += 0.05 * np.sin(40 * x) * np.sin(37 * y)
    for _ in range(40):
        cx, cy, radius = rng.random(3) * [1, 1, 0.06]
        depth[(x - cx) ** 2 + (y - cy) ** 2 < radius**2] = rng.uniform(0.2, 0.5)
    return depth.astype(np.float32)


def rays(side, slant):
    """A fan of rays that slant to one side and begin inside the image."""
    y, x = np.mgrid[:side, :side] + 0.5
    across = side * slant * np.array([np.cos(0.3), np.sin(0.3)])
    fan = 0.2 * (np.stack([x, y], axis=-1) - side / 2)
    direction = np.concatenate([across + fan, np.ones((side, side, 1))], axis=-1).reshape(-1, 3)
    start = np.stack([x, y], axis=-1).reshape(-1, 2) - direction[:, :2] / 2
    edge = np.where(direction[:, :2] > 0, 0, side)
    enter = np.maximum((edge - start) / direction[:, :2], 0).max(axis=1, keepdims=True)
    start = np.clip(start + enter * direction[:, :2], 0, side - 1e-3)
    origin = np.concatenate([start, enter], axis=1)
    return origin.astype(np.float32), direction.astype(np.float32)


def run(benchmark, function):
    benchmark.pedantic(function, rounds=7, warmup_rounds=1)


def search(depth, origin, direction, **options):
    """The compiled search, its arguments on the device."""
    arguments = [jnp.asarray(x) for x in (depth, origin, direction)]
    program = jax.jit(lambda *x: intersect(*x, **options)).lower(*arguments).compile()
    return lambda: jax.block_until_ready(program(*arguments))


@pytest.mark.parametrize("slant", SLANTS)
@pytest.mark.parametrize("method", ["native", "pyramid"])
def test_native(benchmark, method, slant):
    benchmark.group = f"512 x 512 rays, {slant}"
    depth, (origin, direction) = hills(512), rays(512, SLANTS[slant])
    if method == "native":
        build = jax.jit(minimum_pyramid)
        run(benchmark, lambda: native_reproject.walk(build(depth), origin, direction))
    else:
        ours = search(depth, origin, direction)
        run(benchmark, ours)
        times, steps = native_reproject.walk(minimum_pyramid(depth), origin, direction)
        hit = ours()
        assert (np.asarray(hit.mask) == (times >= 0)).mean() > 0.9999
        benchmark.extra_info["steps"] = float(hit.steps.mean()), int(hit.steps.max())
        assert float(hit.steps.mean()) == pytest.approx(steps.mean(), rel=1e-3)


@pytest.mark.parametrize("side", [256, 512, 1024, 2048])
def test_size(benchmark, side):
    """The time of a ray from 256 to 2048: divide by the rays."""
    benchmark.group = "slanting rays, one for each texel"
    run(benchmark, search(hills(side), *rays(side, SLANTS["slanting"])))


@pytest.mark.parametrize("method", ["pyramid", "descent", "linear", "relief"])
def test_methods(benchmark, method):
    benchmark.group = "256 x 256 rays, slanting, by method"
    run(benchmark, search(hills(256), *rays(256, SLANTS["slanting"]), method=method))


def test_a_batch(benchmark):
    """Four searches under `vmap`, to compare with four times one of 256."""
    benchmark.group = "slanting rays, one for each texel"
    depth, (origin, direction) = jnp.asarray(hills(256)), rays(256, SLANTS["slanting"])
    four = jnp.stack([jnp.asarray(origin)] * 4)
    many = jax.jit(jax.vmap(lambda o: intersect(depth, o, direction)))
    run(benchmark, lambda: jax.block_until_ready(many(four)))


def still_life(side):
    life = scene.still_life()
    eye = scene.default_camera(life, height=side, width=side)
    depth = scene.depth(life, eye, height=side, width=side)
    pose = jnp.asarray(eye.world_from_camera)
    return depth, eye, PinholeCamera(eye.intrinsics, pose.at[0, 3].add(0.3))


@pytest.mark.parametrize("mode", ["forward", "jvp", "grad"])
def test_warp(benchmark, mode):
    benchmark.group = "the still life from the side, 256 x 256"
    depth, source, target = still_life(256)
    image = jnp.asarray(np.random.default_rng(0).random((256, 256, 3)), jnp.float32)

    def loss(shift):
        pose = target.world_from_camera.at[:3, 3].add(shift)
        drawn, _ = warp(image, depth, source, PinholeCamera(target.intrinsics, pose))
        return jnp.sum(drawn**2)

    function = {
        "forward": jax.jit(loss),
        "jvp": jax.jit(lambda shift: jax.jvp(loss, (shift,), (jnp.ones(3),))),
        "grad": jax.jit(jax.grad(loss)),
    }[mode]
    run(benchmark, lambda: jax.block_until_ready(function(jnp.zeros(3))))


@pytest.mark.parametrize("peer", ["warp", "build and trace", "trace"])
def test_embree(benchmark, peer):
    """The exact peer: the depth map as a mesh of two triangles a texel, traced."""
    benchmark.group = "the still life from the side, 256 x 256, by mesh"
    depth, source, target = still_life(256)
    if peer == "warp":
        image = jnp.zeros((256, 256, 3), jnp.float32)
        program = jax.jit(lambda depth: warp(image, depth, source, target))
        run(benchmark, lambda: jax.block_until_ready(program(depth)))
        return
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    y, x = np.mgrid[:256, :256] + 0.5
    pixels = jnp.asarray(np.stack([x, y], axis=-1), jnp.float32)
    origins = np.asarray(target.unproject(pixels, jnp.zeros((256, 256)))).reshape(-1, 3)
    ends = np.asarray(target.unproject(pixels, jnp.ones((256, 256)))).reshape(-1, 3)

    def build():
        points = np.asarray(source.unproject(pixels, depth), np.float32)
        a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, :-1], points[1:, 1:]
        triangles = np.stack([a, c, b, b, c, d], axis=2).reshape(-1, 3, 3)
        mesh = EmbreeScene(robust=True)
        TriangleMesh(mesh, np.ascontiguousarray(triangles))
        return mesh

    trace = lambda mesh: mesh.run(np.ascontiguousarray(origins), ends - origins)
    mesh = build()
    run(benchmark, (lambda: trace(build())) if peer != "trace" else (lambda: trace(mesh)))
