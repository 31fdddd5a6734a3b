"""Shadow maps of the still life against shadow rays that Embree traces."""

import numpy as np
import pytest

from benchmarks.scenes.shadow import WHITE, Still, acne_and_leaks
from jaxfx import PointLight, shadow


pytest.importorskip("embreex", reason="the truth is traced by Embree")


@pytest.fixture(scope="module")
def stage():
    return Still()


@pytest.mark.full
def test_acne_falls_and_leaks_grow_with_both_biases(stage):
    """Ten units across, 512 texels. Half of all is acne without a bias."""
    data, truth = stage.under_the_sun(512), stage.truth(-Still.sun)
    grid = [
        [
            acne_and_leaks(shadow.hard(*data, bias=b, slope_bias=s), *truth)
            for s in (0.0, 0.5, 2.0)
        ]
        for b in (0.0, 0.01, 0.1, 0.5)
    ]
    acne, leaks = np.moveaxis(np.array(grid), -1, 0)
    for axis in (0, 1):
        assert (np.diff(acne, axis=axis) <= 0).all()
        assert (np.diff(leaks, axis=axis) >= 0).all()
    assert acne[0, 0] > 0.4
    # Half a texel of slope is all that a plane needs; a constant bias needs a tenth of a unit.
    assert acne[0, 1] < 0.005
    assert leaks[0, 1] < 0.04
    assert acne[1, 0] > 0.1
    assert acne[2, 0] < 0.005
    # Half a unit lets the light under what stands on the floor.
    assert leaks[3, 0] > 0.15


@pytest.mark.full
def test_a_finer_map_errs_less(stage):
    clear, facing = stage.truth(-Still.sun)
    wrong = []
    for map_size in (256, 512, 1024):
        visible = shadow.hard(*stage.under_the_sun(map_size), slope_bias=0.5)
        wrong.append(np.mean((np.asarray(visible) != clear)[facing]))
    assert wrong[1] < 0.7 * wrong[0]
    assert wrong[2] < 0.7 * wrong[1]
    assert wrong[2] < 0.004


@pytest.mark.full
def test_six_faces_about_a_lamp(stage):
    cameras = shadow.light_cameras(PointLight(Still.lamp, WHITE), map_size=256, margin=4)
    visible = shadow.hard(*stage.compared(cameras, 256), slope_bias=0.5)
    clear, facing = stage.from_position(Still.lamp)
    assert np.mean(clear[facing]) < 0.95
    assert np.mean((np.asarray(visible) != clear)[facing]) < 0.015


@pytest.mark.full
def test_a_square_lamps_penumbra(stage):
    """36 shadow rays a point; `pcss` halves the error of the hard shadow, `pcf` does not."""
    light_size = 0.2
    camera, data, share, penumbra = stage.under_a_square_lamp(512, light_size)
    assert np.sum(penumbra) > 300

    bias = {"bias": 0.02, "slope_bias": 2.0}
    soft = shadow.pcss(*data, camera, size=31, light_size=light_size, **bias)
    error = {
        name: np.abs(np.asarray(visible) - share)[penumbra].mean()
        for name, visible in {
            "hard": shadow.hard(*data, **bias),
            "pcf": shadow.pcf(*data, size=7, **bias),
            "pcss": soft,
        }.items()
    }
    assert error["pcss"] < 0.6 * error["hard"]
    assert error["pcss"] < 0.75 * error["pcf"]
    assert error["pcf"] > 0.6 * error["hard"]
