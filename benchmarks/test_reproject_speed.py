"""The search for crossings against native code, in one run: 512 x 512 rays, float32.

`pytest --benchmark-only benchmarks/test_reproject_speed.py` prints each group with the
ratios to its quickest. The floor: some 7 to 21 steps a ray, each one read of the pyramid.
"""

import functools
import timeit

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.native import reproject as native_reproject
from benchmarks.scenes import reproject as cases
from benchmarks.scenes.reproject import fan, hills
from benchmarks.turns import in_turns
from jaxfx import PinholeCamera, ThinLens, dof, metrics, scene
from jaxfx._pyramid import minimum_pyramid
from jaxfx.reproject import intersect, warp


# Image widths that a ray crosses on its way through all of the depth.
SLANTS = {"slight": 0.1, "slanting": 0.5, "grazing": 2.0}


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
    depth, (origin, direction) = hills(512), fan(512, SLANTS[slant])
    if method == "native":
        build = jax.jit(minimum_pyramid)
        run(benchmark, lambda: native_reproject.walk(build(depth), origin, direction))
    else:
        ours = search(depth, origin, direction)
        run(benchmark, ours)
        times, steps = native_reproject.walk(
            minimum_pyramid(jnp.asarray(depth)), origin, direction
        )
        hit = ours()
        assert (np.asarray(hit.mask) == (times >= 0)).mean() > 0.9999
        benchmark.extra_info["steps"] = float(hit.steps.mean()), int(hit.steps.max())
        assert float(hit.steps.mean()) == pytest.approx(steps.mean(), rel=1e-3)


@pytest.mark.parametrize("slant", SLANTS)
def test_size(benchmark, slant):
    """The time of a ray from 256 to 2048, native code beside ours: `extra_info` has the ratios.

    The steps of a ray grow with the logarithm of the size.
    """
    benchmark.group = "nanoseconds a ray, one ray for each texel"
    sides, nanoseconds, steps = (256, 512, 1024, 2048), {}, {}

    def timed(who, side, function):
        times = [timeit.timeit(function, number=1) for _ in range(6 + 2048 // side)]
        nanoseconds[who, side] = 1e9 / side**2 * np.median(times[1:])

    for side in sides:
        ours = search(hills(side), *fan(side, SLANTS[slant]))
        steps[side] = float(ours().steps.mean())
        timed("ours", side, ours)
    # Afterwards, for its threads spin on and slow what comes next.
    for side in sides:
        pyramid, rays = minimum_pyramid(jnp.asarray(hills(side))), fan(side, SLANTS[slant])
        timed(
            "native",
            side,
            lambda pyramid=pyramid, rays=rays: native_reproject.walk(pyramid, *rays),
        )
    for who in ("ours", "native"):
        growth = nanoseconds[who, 2048] / nanoseconds[who, 256]
        benchmark.extra_info[f"{who}: growth"] = growth
        row = ", ".join(f"{nanoseconds[who, side]:.0f}" for side in steps)
        print(f"\n{slant}, {who}: {row} ns, x {growth:.2f}")
    print(f"steps x {steps[2048] / steps[256]:.2f}")
    run(benchmark, search(hills(2048), *fan(2048, SLANTS[slant])))


@pytest.mark.parametrize("method", ["pyramid", "descent", "linear", "relief"])
def test_methods(benchmark, method):
    benchmark.group = "256 x 256 rays, slanting, by method"
    run(benchmark, search(hills(256), *fan(256, SLANTS["slanting"]), search=method))


def test_a_batch(benchmark):
    """Four searches under `vmap`, to compare with four times one."""
    benchmark.group = "slanting rays, 256 x 256"
    depth, (origin, direction) = jnp.asarray(hills(256)), fan(256, SLANTS["slanting"])
    four = jnp.stack([jnp.asarray(origin)] * 4)
    many = jax.jit(jax.vmap(lambda o: intersect(depth, o, direction)))
    functions = {
        "one": search(depth, origin, direction),
        "four": lambda: jax.block_until_ready(many(four)),
    }
    in_turns(benchmark, functions)


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


@pytest.mark.parametrize("peer", ["warp", "backward", "mesh, made and traced", "mesh, traced"])
def test_peers(benchmark, peer):
    """The backward warp, which is told the target's depth; and Embree on the depth as a mesh.

    With each goes what it shows of the still life turned by 10 degrees.
    """
    benchmark.group = "the still life turned by 10 degrees, 256 x 256"
    source, photograph = cases.photographer(scene.still_life(), 256)
    image, depth = photograph(source)
    target = cases.orbit(source, 10, 2.8)
    truth, target_depth = photograph(target)
    mesh = cases.depth_mesh(depth, source)
    ours = jax.jit(lambda depth: warp(image, depth, source, target))
    told = jax.jit(lambda depth: cases.backward_warp(image, depth, source, target))
    trace = lambda mesh: cases.trace(mesh, image, source, target, depth.shape)
    function = {
        "warp": lambda: ours(depth),
        "backward": lambda: told(target_depth),
        "mesh, made and traced": lambda: trace(cases.depth_mesh(depth, source)),
        "mesh, traced": lambda: trace(mesh),
    }[peer]
    run(benchmark, lambda: jax.block_until_ready(function()))
    seen = cases.visible(depth, source, target, target_depth)
    benchmark.extra_info |= {
        k: float(v) for k, v in cases.scores(*function(), truth, seen).items()
    }


@pytest.mark.parametrize("method", ["scatter", "layered", "warp through 4 points", "16", "64"])
def test_depth_of_field(benchmark, method):
    """Looks through a lens by reprojecting one image, beside what is made for it.

    With each goes its PSNR to 256 pinhole images from all over the lens.
    """
    benchmark.group = "depth of field of the still life, 160 x 160"
    mesh, side = scene.still_life(), 160
    source, photograph = cases.photographer(mesh, side)
    image, depth = photograph(source)
    lens = ThinLens.from_camera(source, aperture=0.08, focus_distance=2.5)
    points = {"warp through 4 points": 4, "16": 16, "64": 64}
    look = jax.jit(lambda camera: warp(image, depth, source, camera)[0])
    many = functools.partial(dof.accumulate, camera=source, lens=lens, progress=False)
    function = {
        "scatter": jax.jit(lambda: dof.scatter(image, depth, lens, max_coc=16)),
        "layered": jax.jit(lambda: dof.layered(image, depth, lens, max_coc=16)),
    }.get(method) or (lambda: many(look, samples=points[method]).image)
    run(benchmark, lambda: jax.block_until_ready(function()))
    truth = many(lambda camera: photograph(camera)[0], samples=256)
    benchmark.extra_info["PSNR"] = float(metrics.psnr(function(), truth.image))
