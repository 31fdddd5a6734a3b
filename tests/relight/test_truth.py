"""Against a path tracer: Mitsuba's light on the still life, every surface Lambert."""

import numpy as np
import pytest

from jaxfx import relight, scene


pytest.importorskip("mitsuba", reason="Mitsuba comes with the `bench` extra.")
import relight_truth as truth


def test_a_bounce_is_the_path_tracers_but_for_the_noise_of_both():
    size = (24, 32)
    mesh = scene.still_life()
    camera = scene.default_camera(mesh, height=size[0], width=size[1])
    gbuffer, light = truth.lambert(mesh, camera, size), truth.LIGHTS["directional"]
    transfer = scene.transfer(mesh, gbuffer, camera, points=512, rank=64)
    lit = truth.unshadowed(mesh, np.asarray(transfer.position, float), light)
    image = np.asarray(relight.indirect(gbuffer, transfer, [light], lit=[lit]))
    expected, noise = truth.bounced(mesh, camera, light, size, 128)
    error, size = (np.sqrt(np.mean(v**2)) for v in (image - expected, expected))
    assert np.sqrt(np.mean(noise**2)) < 0.2 * size
    assert error < 0.4 * size
    assert image.mean() == pytest.approx(expected.mean(), rel=0.12)
