"""The composed example, in this process, at a tiny size and from one frame buffer."""

import importlib.util
import json
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image


SCRIPT = Path(__file__).parents[2] / "examples" / "pipeline.py"
FILES = {"stages.png", "derivatives.png", "fit.png", "report.json"}
SIZE = 36, 64


@pytest.fixture(scope="module")
def example():
    """The module with one frame buffer, few programs, a smaller search and start's error."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SCRIPT.parent)
        spec = importlib.util.spec_from_file_location("pipeline", SCRIPT)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    module.CACHES = module.CACHES[:1]
    module.ROUNDS = module.ROUNDS[1], module.ROUNDS[-1], module.ROUNDS[-1]
    module.OFF = module.OFF / 2
    module.draw = module.whole_image
    module.reverse = lambda *rest: 2 * module._pipeline.equations(*module.forward(*rest))[1]
    return module


@pytest.fixture(scope="module")
def run(example):
    def main(*arguments):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["pipeline.py", *map(str, arguments)])
            example.main()

    return main


@pytest.fixture(scope="module")
def out(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pipeline")
    size = "--height", SIZE[0], "--map-size", SIZE[1]
    run(*size, "--steps", 6, "--noise", 0.001, "--out", folder)
    return folder


@pytest.fixture(scope="module")
def report(out):
    return json.loads((out / "report.json").read_text())


def test_it_writes_figures_and_a_report(out, report):
    assert {path.name for path in out.iterdir()} == FILES
    for name in FILES - {"report.json"}:
        with Image.open(out / name) as picture:
            assert np.asarray(picture).std() > 20
    assert all(value > 0 for value in report["milliseconds"].values())


def test_the_search_goes_towards_camera_and_light(report):
    """The lens, whose circles are three pixels wide here, is lost in what these leave."""
    start, found, least = map(report["errors"].get, ("start", "found 0", "if noise"))
    for name in list(start)[:4]:
        assert least[name] < found[name] < 0.7 * start[name], name
    assert report["searches"]["found 0"]["rms"] < 0.02


def test_the_search_finds_the_lens_where_camera_and_light_are_right(example, out):
    mesh, stage, truth = example.set_stage(None, *SIZE)
    numbers, noise = jnp.asarray(truth), 0.001
    target = example.draw(numbers, stage, mesh.cast(stage.light(numbers)))
    target = target + np.random.default_rng(0).normal(0, noise, target.shape)
    start = truth + example.OFF * (np.arange(13) > 10)
    found, went, _ = example.search(mesh, stage, start, target, 6)
    begun, ended = (
        example.sizes(each - truth, truth)["aperture, %"] for each in (start, found)
    )
    assert ended < 0.4 * begun
    assert went["rms"] < noise


def test_light_and_lens_have_true_derivatives(example, out):
    """Against differences of the whole image; the camera's miss silhouettes."""
    mesh, stage, truth = example.set_stage(None, *SIZE)
    truth = jnp.asarray(truth)
    cast = mesh.cast(stage.light(truth))
    nothing = jnp.zeros((*stage.shape, 3))
    _, found = example.forward(truth, stage, cast, nothing, jnp.asarray(0.0))
    for index in (6, 9, 11, 12):
        step = jnp.zeros(13).at[index].set(1e-4)
        more, less = (example.draw(truth + sign * step, stage, cast) for sign in (1, -1))
        quotient = (more - less) / 2e-4
        error = jnp.mean((found[..., index] - quotient) ** 2) / jnp.mean(quotient**2)
        assert jnp.sqrt(error) < 0.02, example.NAMES[index]


def test_a_scene_that_will_not_do_is_one_line(run, tmp_path):
    with pytest.raises(SystemExit, match=r"pipeline.py: error: .*must be a file") as caught:
        run("--scene", "missing.obj", "--out", tmp_path)
    assert "\n" not in caught.value.code


def test_a_number_out_of_range_is_refused(run, capsys):
    with pytest.raises(SystemExit):
        run("--height", 4)
    assert "error: --height must be at least 24, got 4" in capsys.readouterr().err
