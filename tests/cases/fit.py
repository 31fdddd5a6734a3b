"""Cases in which fits fail: images that the model of lights lacks, lights that are as one."""

import functools as ft

import numpy as np

from jaxfx import DirectionalLight, fit, relight
from tests.cases import lit
from tests.cases.registry import Found, case


LOSSES = ("robust", "squares")
COUNT = 8


def _lit(change, loss, **options):
    """Over `COUNT` fits: the median of the largest error of a position or direction, in scene
    units and radians; the share of numbers outside of 1.96 stated errors; that of failures."""
    off, outside, failures = [], [], []
    image = weight = np.zeros((1, 1, 3))
    for seed in range(COUNT):
        image, truth, start = change(seed)
        how = {"loss": loss, "throw": False, **options}
        found = fit.lights(image, lit.cache(), lit.CAMERA, start, **how)
        pairs = lit.misses(found, truth)
        geometry = [v[0] for (_, name), v in pairs.items() if name != "color"]
        off.append(max(np.linalg.norm(miss) for miss in geometry))
        miss, error = (np.concatenate(each) for each in zip(*pairs.values(), strict=True))
        outside.append(np.mean(np.abs(miss) > 1.96 * error))
        failures.append(not found.success)
        weight = np.asarray(found.weights)[..., None] * np.ones(3)
    figures = {
        "off": float(np.median(off)),
        "outside": float(np.mean(outside)),
        "failures": float(np.mean(failures)),
    }
    return Found(figures, np.concatenate([np.clip(image / 3, 0, 1), weight], axis=1))


ASKED: dict[str, float | None] = {"off": 0.02, "outside": 0.15, "failures": 0.0}
NONE = "none: a search stops at every step to report"


@case("fit", ASKED, LOSSES, NONE)
def lights_as_the_model_has_them(loss):
    """A sun and a lamp 10 degrees and a quarter unit off at the start, noise of 1 %; 8 images
    of 32 x 32: the median of the largest error of a position (scene units) or direction
    (radians); the share of numbers outside of 1.96 stated errors; the share that is doubted."""
    return _lit(ft.partial(lit.problem, spheres=0), loss)


@case("fit", ASKED, LOSSES, NONE)
def lights_and_shadows_that_the_model_lacks(loss):
    """The same, three spheres before each light."""
    return _lit(lit.problem, loss)


@case("fit", ASKED, LOSSES, NONE)
def lights_and_saturated_highlights(loss):
    """The same without spheres, clipped above the brightness that a tenth of the values
    exceed."""

    def clipped(seed):
        image, truth, start = lit.problem(seed, spheres=0)
        return np.minimum(image, np.quantile(image, 0.9)), truth, start

    return _lit(clipped, loss)


@case("fit", ASKED | {"failures": None}, LOSSES, NONE)
def lights_in_a_picture_of_wrong_exposure(loss):
    """The same, unclipped and a quarter brighter, with the true colours given and not sought:
    no lights explain it; it need not be doubted."""

    def brighter(seed):
        image, truth, start = lit.problem(seed, spheres=0)
        fields = [
            vars(each) | {"color": true.color} for each, true in zip(start, truth, strict=True)
        ]
        start = [type(each)(**own) for each, own in zip(start, fields, strict=True)]
        return 1.25 * image, truth, start

    return _lit(brighter, loss, parameters=("position", "direction"))


@case("fit", {"successes": 0.0, "finite": 0.0}, LOSSES, NONE)
def lights_that_cannot_be_told_apart(loss):
    """Two suns half a degree apart, 10 degrees apart at the start, noise of 1 %; 8 images:
    the share that is called a success, and that of colours with a finite stated error."""
    successes, finite = [], []
    truth = [DirectionalLight([0.3, y, 1.0], np.ones(3)) for y in (0.2, 0.21)]
    image = clean = np.asarray(relight.render(lit.cache(), lit.CAMERA, truth))
    for seed in range(COUNT):
        grain = np.random.default_rng(seed).normal(size=clean.shape)
        image = clean + 0.01 * np.sqrt(np.mean(clean**2)) * grain
        start = [DirectionalLight([x, 0.2, 1.0], np.ones(3)) for x in (0.2, 0.4)]
        how = {"loss": loss, "throw": False}
        found = fit.lights(image, lit.cache(), lit.CAMERA, start, **how)
        successes.append(found.success)
        finite += [np.isfinite(each["color"]).all() for each in found.standard_errors]
    figures = {"successes": float(np.mean(successes)), "finite": float(np.mean(finite))}
    return Found(figures, np.clip(image / 3, 0, 1))
