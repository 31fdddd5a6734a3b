"""Relighting's times at 640 x 480 in float32, in one run.

`pytest --benchmark-only benchmarks/test_relight_speed.py` prints each group with its
medians, its spread and the ratios to its quickest.

The image that an edit is compared with is rendered again: Embree finds the surfaces and casts
a shadow ray from each towards each light, and every light is shaded.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes import relight as scenes
from benchmarks.turns import in_turns
from jaxfx import PointLight, Transfer, relight


SIZE = (480, 640)


def waited(function):
    return lambda: jax.block_until_ready(function())


def run(benchmark, function, rounds=9):
    benchmark.pedantic(waited(function), rounds=rounds, warmup_rounds=1)


def test_edit(benchmark):
    """Among 1, 10, 100 and 1000 lights, in turns: all run one program."""
    benchmark.group = "one edit and its picture, among 1, 10, 100 and 1000 lights"
    gbuffer, camera = scenes.cache(SIZE)
    other = scenes.lights(1, seed=1)[0]

    def edit(count):
        state = relight.start(gbuffer, camera, scenes.lights(count))
        return waited(lambda: state.edit(0, other).image)

    in_turns(benchmark, {f"{count} lights": edit(count) for count in (1, 10, 100, 1000)})


@pytest.mark.parametrize("shader", scenes.SHADERS)
def test_sliders(benchmark, shader):
    """A light of each kind added to a state without it, and edited; and their pictures."""
    benchmark.group = f"one light on a slider and its picture, {shader}"
    gbuffer, camera = scenes.cache_of(SIZE, shader)
    rest = relight.start(gbuffer, camera, scenes.lights(2))
    calls = {}
    for kind in scenes.KINDS:
        state = rest.add(scenes.light_of(kind, 0))
        turned = scenes.light_of(kind, 20)
        calls[f"{kind}, added"] = waited(lambda light=turned: rest.add(light).image)
        calls[f"{kind}, edited"] = waited(
            lambda state=state, light=turned: state.edit(2, light).image
        )
    in_turns(benchmark, calls)


def test_one_light_by_shader(benchmark):
    benchmark.group = "the picture under one point light, by shader"
    lamp = scenes.light_of("point", 0)

    def shade(shader):
        gbuffer, camera = scenes.cache_of(SIZE, shader)
        return waited(lambda: relight.shade(gbuffer, camera, lamp))

    in_turns(benchmark, {shader: shade(shader) for shader in scenes.SHADERS}, rounds=41)


@pytest.mark.parametrize("shader", ["Blinn", "GGX"])
def test_render_of_8(benchmark, shader):
    """One light and 8, in turns: of one, the surface is made as for 8."""
    benchmark.group = f"the picture under 1 and 8 point lights, {shader}"
    gbuffer, camera = scenes.cache_of(SIZE, shader)

    def render(count):
        lights = scenes.lights(count)
        return waited(lambda: relight.render(gbuffer, camera, lights))

    in_turns(benchmark, {f"{count} lights": render(count) for count in (1, 8)}, rounds=31)


@pytest.mark.parametrize("what", ["diffuse", "roughness of 10 lights"])
def test_paint(benchmark, what):
    benchmark.group = "another material and its picture"
    gbuffer, camera = scenes.cache(SIZE)
    state = relight.start(gbuffer, camera, scenes.lights(10))
    mask = gbuffer.depth < jnp.median(gbuffer.depth)
    new = {"diffuse": np.ones(3)} if what == "diffuse" else {"roughness": np.array(0.4)}
    run(benchmark, lambda: state.paint(mask, **new).image)


@pytest.mark.parametrize("rank", [16, 64, 256])
def test_indirect(benchmark, rank):
    """The product is what it is, whatever the numbers in it."""
    benchmark.group = "one bounce of a light from 1024 points, by rank"
    gbuffer, _ = scenes.cache(SIZE)
    rng = np.random.default_rng(0)
    some = lambda *shape: rng.standard_normal(shape, np.float32)
    transfer = Transfer(some(*SIZE, rank), some(rank, 1024), *(some(1024, 3) for _ in range(3)))
    light = scenes.lights(1)
    run(benchmark, lambda: relight.indirect(gbuffer, transfer, light))


@pytest.mark.parametrize("count", [1, 2, 4, 8])
def test_new_view(benchmark, count):
    """Synthesis, the holes' filling, and one light."""
    benchmark.group = "a new view and its picture, by the number of caches"
    target, depth, gbuffers, cameras = scenes.new_view(SIZE, count)
    light = scenes.lights(1)

    def view():
        found, views = relight.synthesize(gbuffers, cameras, target, depth=depth)
        return relight.render(relight.fill_holes(found, views)[0], target, light)

    run(benchmark, view)


@pytest.mark.parametrize("step", ["synthesize", "fill_holes", "choose", "render"])
def test_steps_of_a_new_view(benchmark, step):
    benchmark.group = "the steps of a new view from 4 caches"
    target, depth, gbuffers, cameras = scenes.new_view(SIZE, 4)
    view = lambda: relight.synthesize(gbuffers, cameras, target, depth=depth)
    found, views = view()
    light = scenes.lights(1)
    steps = {
        "synthesize": view,
        "fill_holes": lambda: relight.fill_holes(found, views),
        "choose": lambda: relight.choose(gbuffers, cameras, target, depth=depth, count=2),
        "render": lambda: relight.render(found, target, light),
    }
    run(benchmark, steps[step])


@pytest.mark.parametrize("count", [1, 10, 100])
@pytest.mark.parametrize("method", ["edit", "render anew"])
def test_against_rendering_anew(benchmark, method, count):
    benchmark.group = f"{count} lights with shadows"
    mesh, camera = scenes.view(SIZE)
    lights = scenes.lights(count)
    if method == "edit":
        gbuffer, _ = scenes.cache(SIZE)
        visible = [jnp.ones(SIZE, jnp.float32)] * count
        state = relight.start(gbuffer, camera, lights, visibilities=visible)
        run(benchmark, lambda: state.edit(0, lights[0], visible[0]).image)
    else:
        anew = lambda: scenes.rendered_anew(mesh, camera, lights, SIZE)
        rounds = 1 if count == 100 else 3
        benchmark.pedantic(waited(anew), rounds=rounds, warmup_rounds=int(count < 100))


@pytest.mark.parametrize("mode", ["value", "jvp", "grad"])
def test_derivatives_in_the_edited_light(benchmark, mode):
    benchmark.group = "derivatives of the picture's error in the edited light, 100 lights"
    gbuffer, camera = scenes.cache(SIZE)
    lights = scenes.lights(100)
    state = relight.start(gbuffer, camera, lights)
    loss = lambda light: jnp.sum((state.edit(0, light).image - 0.5) ** 2)
    ones = PointLight(jnp.ones(3, jnp.float32), jnp.ones(3, jnp.float32))
    function = {
        "value": jax.jit(loss),
        "jvp": jax.jit(lambda light: jax.jvp(loss, (light,), (ones,))),
        "grad": jax.jit(jax.grad(loss)),
    }[mode]
    run(benchmark, lambda: function(lights[0]))
