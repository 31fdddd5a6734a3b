"""The composed example, in this process, at a tiny size and from one frame buffer."""

import functools
import importlib.util
import json
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from PIL import Image


SCRIPT = Path(__file__).parents[2] / "examples" / "pipeline.py"
FILES = {"stages.png", "derivatives.png", "fit.png", "report.json"}


@pytest.fixture(scope="module")
def example():
    """The module with one frame buffer, and all of its pictures from one compiled program."""
    spec = importlib.util.spec_from_file_location("pipeline", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.CACHES = module.CACHES[:1]
    module.draw = lambda *arguments: module.derivatives(*arguments)[0]
    module.search = functools.partial(gauss_newton, module)
    # At this size a smaller aperture would start with no blur at all.
    start = module.start_of
    wider = np.log(1.3 / 0.6)
    module.start_of = lambda truth: start(truth)._replace(
        aperture=start(truth).aperture + wider
    )
    yield module
    module.plt.close("all")


def gauss_newton(module, unknowns, stage, cast, target, sigma, pull, steps):
    """As `search`, by NumPy and undamped."""
    flat, unravel = ravel_pytree(unknowns)
    for _ in range(steps):
        image, jacobian = module.derivatives(unravel(flat), stage, cast)
        smooth = lambda image: np.ravel(module.smoothed(image, sigma))
        columns = [
            smooth(column)
            for leaf in jacobian
            for column in np.moveaxis(np.reshape(leaf, (*image.shape, -1)), -1, 0)
        ]
        step = np.linalg.lstsq(np.stack(columns, axis=1), smooth(target - image))[0]
        flat = flat + step
    return unravel(flat), steps


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
    run("--height", 24, "--map-size", 32, "--rounds", 2, "--steps", 3, "--out", folder)
    return folder


def test_it_writes_figures_and_a_report(out):
    assert {path.name for path in out.iterdir()} == FILES
    for name in FILES - {"report.json"}:
        with Image.open(out / name) as picture:
            assert np.asarray(picture).std() > 20


def test_the_fit_goes_towards_the_truth(out):
    """In camera and light: at this size the lens' circles are two pixels wide."""
    report = json.loads((out / "report.json").read_text())
    truth, start, found = (report["parameters"][name] for name in ("truth", "start", "found"))
    away = lambda values, name: np.linalg.norm(np.subtract(values[name], truth[name]))
    for name in ("eye", "light direction", "light color"):
        assert away(found, name) < away(start, name), name
    assert report["rms"]["rounds"][-1] < 0.9 * report["rms"]["start"]
    assert all(value > 0 for value in report["milliseconds"].values())


def test_light_and_lens_have_true_derivatives(example, out):
    """Against differences of the whole picture; the camera's miss silhouettes."""
    mesh, stage, truth = example.set_stage(None, 24, 32)
    cast = mesh.cast(stage.light(truth))
    _, found = example.derivatives(truth, stage, cast)
    for name, index in (("tilt", 0), ("color", 1), ("aperture", ()), ("focus", ())):
        step = 1e-4 * jnp.zeros_like(getattr(truth, name)).at[index].set(1)
        moved = [
            example.draw(
                truth._replace(**{name: getattr(truth, name) + sign * step}), stage, cast
            )
            for sign in (1, -1)
        ]
        quotient = (moved[0] - moved[1]) / 2e-4
        derivative = getattr(found, name)[(..., index)] if index != () else getattr(found, name)
        error = jnp.sqrt(jnp.mean((derivative - quotient) ** 2) / jnp.mean(quotient**2))
        assert error < 0.02, name


def test_a_scene_that_will_not_do_is_one_line(run, tmp_path):
    with pytest.raises(SystemExit, match=r"pipeline.py: error: .*must be a file") as caught:
        run("--scene", "missing.obj", "--out", tmp_path)
    assert "\n" not in caught.value.code


def test_a_number_out_of_range_is_refused(run, capsys):
    with pytest.raises(SystemExit):
        run("--height", 4)
    assert "error: --height must be at least 24, got 4" in capsys.readouterr().err
