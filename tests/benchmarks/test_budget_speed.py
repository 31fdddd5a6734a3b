"""Plans against the effects at full quality, in one run: the still life, 512 x 384, float32.

`pytest --benchmark-only tests/benchmarks/test_budget_speed.py` prints each group with the
ratio of the full effect to its plan at an error of 1e-2. The lens has circles up to 49 pixels
(wide) or 25 (narrow); the filter of the shadow is 9 x 9; of the 32 lights each is 0.7 times as
bright as the one before; of the eight sources some show next to nothing new.
"""

import functools

import jax
import numpy as np
import pytest
import relight_scenes

from jaxfx import DirectionalLight, ThinLens, budget, dof, relight, reproject, scene, shadow
from jaxfx.dof.scatter import largest_coc


SIZE, ERROR = (384, 512), 1e-2


@functools.cache
def lit():
    gbuffer, camera = relight_scenes.cache(SIZE)
    return gbuffer, camera, relight.render(gbuffer, camera, scene.default_lights(camera))


def of_lens(aperture):
    gbuffer, camera, image = lit()
    lens = ThinLens.from_camera(camera, aperture=aperture, focus_distance=2.8)
    data = (image, gbuffer.depth, lens)
    full = functools.partial(dof.scatter, max_coc=largest_coc("scatter", data[1], lens))
    return full, budget.dof(*data, max_error=ERROR), data


def of_shadow():
    gbuffer, camera, _ = lit()
    mesh = relight_scenes.view(SIZE)[0]
    light = DirectionalLight([0.4, -0.8, -0.6], [1, 1, 1])
    (at_light,) = shadow.light_cameras(
        light, map_size=1024, centre=(0.0, 1.0, -3.0), radius=6.0
    )
    shadow_map = scene.depth(mesh, at_light, height=1024, width=1024)
    data = (
        shadow_map,
        shadow.receivers(gbuffer.depth, camera, at_light, normal=gbuffer.normal),
    )
    how = {"size": 9, "bias": 0.01, "slope_bias": 4.5}
    full = functools.partial(shadow.pcf, **how)
    return full, budget.shadow(*data, **how, max_error=ERROR), data


def of_lights():
    gbuffer, camera, _ = lit()
    lights = [
        type(light)(light.position, light.color * 8 * np.float32(0.7**index))
        for index, light in enumerate(relight_scenes.lights(32))
    ]
    data = (gbuffer, camera, lights)
    return relight.render, budget.relight(*data, max_error=ERROR), data


def of_sources():
    target, _, caches, cameras = relight_scenes.new_view((192, 256), 8)
    images = [cache.diffuse for cache in caches]
    data = (images, [cache.depth for cache in caches], cameras, target)
    return reproject.blend, budget.reproject(*data, max_error=ERROR), data


CASES = {
    "wide lens": functools.partial(of_lens, 0.12),
    "narrow lens": functools.partial(of_lens, 0.06),
    "shadow": of_shadow,
    "lights": of_lights,
    "sources": of_sources,
}


@functools.cache
def case(name):
    return CASES[name]()


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("which", ["full", "plan"])
def test_plan(benchmark, name, which):
    benchmark.group = name
    full, plan, data = case(name)
    call = full if which == "full" else plan
    benchmark.extra_info["plan"] = str(plan)
    run = lambda: jax.block_until_ready(call(*data))
    benchmark.pedantic(run, rounds=7, warmup_rounds=1)
    first = lambda result: result[0] if isinstance(result, tuple) else result
    difference = np.asarray(first(plan(*data))) - np.asarray(first(full(*data)))
    assert np.sqrt(np.mean(difference**2)) <= ERROR
