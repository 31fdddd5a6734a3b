"""Cases in which fits fail: images that a model lacks, parameters that images do not tell."""

import functools as ft

import numpy as np

from jaxfx import DirectionalLight, ThinLens, blur, depth as depths, dof, fit, relight
from tests.cases import lit
from tests.cases.registry import Found, case


LOSSES = ("robust", "squares")
COUNT = 8
STACK_FOCI = (1.5, 1.9, 2.5, 3.6)


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


# Photographs of 40 x 56 pixels per case of a lens.
DOF_COUNT = 3
TRUE_LENS = ThinLens(0.3, 2.0, 60.0)
START_LENS = ThinLens(0.36, 2.2, 60.0)


def _room(seed):
    """A wall at 4 behind a slanted floor and a box at 1.2, with a texture of several scales."""
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[:40, :56]
    depth = np.minimum(4.0, 60 / (row + 10.0))
    depth = np.where((abs(row - 18) < 8) & (abs(column - 20) < 9), 1.2, depth)
    texture = sum(
        np.kron(rng.random((40 // n, 56 // n, 1)), np.ones((n, n, 1))) for n in (1, 2, 4)
    )
    return texture / 3, depth


def _blurred(change, loss, **options):
    """Over `DOF_COUNT` fits: the median of the aperture's relative error; the share of numbers
    outside of 1.96 stated errors; that of failures."""
    off, outside, failures = [], [], []
    reference = image = np.zeros((1, 1, 1))
    for seed in range(DOF_COUNT):
        reference, image, depth = change(seed)
        how = {"loss": loss, "throw": False, "max_coc": 10.0, "gamma": 1.0, **options}
        fitted = fit.dof(reference, image, depth, START_LENS, **how)
        off.append(abs(float(fitted.lens.aperture) / 0.3 - 1))
        for name, truth in (("aperture", 0.3), ("focus_distance", 2.0)):
            miss = abs(float(getattr(fitted.lens, name)) - truth)
            outside.append(miss > 1.96 * float(fitted.standard_errors[name]))
        failures.append(not fitted.success)
    figures = {
        "off": float(np.median(off)),
        "outside": float(np.mean(outside)),
        "failures": float(np.mean(failures)),
    }
    return Found(figures, np.clip(np.concatenate([image, reference], axis=1), 0, 1))


def _photograph(seed, image, depth, lens=TRUE_LENS):
    """The image through the lens, by `scatter`, with noise of half a percent."""
    drawn = np.asarray(dof.scatter(image, depth, lens, max_coc=16.0))
    return drawn + 0.005 * np.random.default_rng(seed).normal(size=drawn.shape)


DOF_ASKED: dict[str, float | None] = {"off": 0.03, "outside": 0.15, "failures": 0.0}


@case("fit", DOF_ASKED, LOSSES, NONE)
def a_lens_as_the_model_has_it(loss):
    """A lens 20 and 10 % off at the start, noise of half a percent; 3 images of 40 x 56: the
    median of the aperture's relative error; the share of apertures and focus distances outside
    of 1.96 stated errors; the share that is doubted."""

    def plain(seed):
        image, depth = _room(seed)
        return _photograph(seed, image, depth), image, depth

    return _blurred(plain, loss)


@case("fit", DOF_ASKED, LOSSES, NONE)
def a_lens_and_saturated_highlights(loss):
    """The same, with four lights of 50 x white, and the photograph clipped at 1."""

    def clipped(seed):
        image, depth = _room(seed)
        lights = np.random.default_rng(seed + 9).integers(0, image.size, 4)
        image.reshape(-1)[lights] = 50.0
        return np.minimum(_photograph(seed, image, depth), 1), image, depth

    return _blurred(clipped, loss)


@case("fit", DOF_ASKED, ("missing", "filled"), NONE)
def a_lens_and_depth_with_holes(holes):
    """The same, unclipped, a fifth of the depth missing in blocks of 4 x 4: left missing, and
    filled by `depth.fill` first."""

    def holed(seed):
        image, depth = _room(seed)
        blocks = np.random.default_rng(seed + 9).random((10, 14)) < 0.2
        known = np.where(np.kron(blocks, np.ones((4, 4))) > 0, 0.0, depth)
        if holes == "filled":
            known = np.asarray(depths.fill(known, image).depth)
        return _photograph(seed, image, depth), image, known

    return _blurred(holed, "robust")


@case("fit", DOF_ASKED | {"failures": None}, ("equal", "free"), NONE)
def a_lens_and_a_wrong_exposure(exposure):
    """The same, with all depth, a quarter brighter: with the exposure held equal, and found
    beside the lens; it need not be doubted."""

    def brighter(seed):
        image, depth = _room(seed)
        return 1.25 * _photograph(seed, image, depth), image, depth

    return _blurred(brighter, "robust", exposure=exposure)


@case("fit", {"successes": 0.0}, LOSSES, NONE)
def a_lens_that_cannot_be_seen(loss):
    """All in focus, and without texture: the share of either that is called a success."""
    successes = []
    image = reference = np.zeros((1, 1, 1))
    for seed in range(DOF_COUNT):
        image, depth = _room(seed)
        for flat in (image, np.full_like(image, 0.4)):
            at = np.full_like(depth, 2.0) if flat is image else depth
            reference = _photograph(seed, flat, at)
            how = {"loss": loss, "throw": False, "max_coc": 10.0}
            start = ThinLens(0.36, 2.6, 60.0)
            successes.append(fit.dof(reference, flat, at, start, **how).success)
    return Found(
        {"successes": float(np.mean(successes))},
        np.clip(np.concatenate([image, reference], axis=1), 0, 1),
    )


@case(
    "fit",
    {"off": 0.01, "untold": None, "told without texture": 0.01},
    ("focal_stack",),
    "none: a search stops at every step to report",
)
def a_focal_stack_of_half_an_even_wall(_):
    """Four images of a wall, noise of half a percent, whose right half has no texture: the
    median relative error of the depth where it is determined and there is texture, the share
    of that half where it is not, and the share of the even half that is called determined."""
    rng, size = np.random.default_rng(4), (40, 64)
    texture = np.kron(rng.random((20, 32, 3)), np.ones((2, 2, 1)))
    image = np.where(np.arange(64)[:, None] < 32, texture, 0.5)
    depth, lenses = np.full(size, 2.0), [ThinLens(0.2, z, 80.0) for z in STACK_FOCI]
    stack = [
        np.asarray(dof.scatter(image, depth, lens)) + 0.005 * rng.normal(size=image.shape)
        for lens in lenses
    ]
    options = {"min_depth": 1.2, "max_depth": 5.0, "max_steps": 4, "throw": False}
    found = fit.focal_stack(stack, lenses, **options)
    told = np.asarray(found.determined)
    # The largest circle of confusion is 3.6 pixels wide; a window about a pixel is as wide.
    textured, even = told[:, :24], told[:, 40:]
    off = np.abs(np.asarray(found.depth) / depth - 1)[:, :24][textured]
    figures = {
        "off": float(np.median(off)) if off.size else 1.0,
        "untold": float(np.mean(~textured)),
        "told without texture": float(np.mean(even)),
    }
    shown = np.where(told[..., None], np.asarray(found.depth)[..., None] / 4, 0)
    return Found(figures, np.concatenate([stack[1], shown * np.ones(3)], axis=0))


@case(
    "fit",
    {"successes": 0.0, "off": None, "off by more than a tenth": None},
    ("focal_stack",),
    "none: a search stops at every step to report",
)
def a_focal_stack_of_a_fence_before_a_smooth_wall(_):
    """Four images of bars, two pixels wide and a third as far as a wall whose colors vary over
    some 15 pixels: whether the fit calls itself a success, the median relative error of the
    depth, and the share of it that is more than a tenth off. Planes take the wall for the
    bars."""
    rng, size = np.random.default_rng(5), (48, 48)
    is_bar = np.broadcast_to(np.arange(48) % 12 < 2, size)
    wall = blur.gaussian(rng.random((*size, 3)), sigma=6.0)
    wall = np.asarray(0.5 + 0.15 * (wall - wall.mean()) / wall.std())
    bars = rng.random((*size, 3)) * [0.7, 0.3, 0.3] + [0.3, 0, 0]
    image, near, far = np.where(is_bar[..., None], bars, wall), 1.5, np.full(size, 4.5)
    depth, lenses = np.where(is_bar, near, far), [ThinLens(0.5, z, 80.0) for z in STACK_FOCI]
    stack = [dof.layered(image, depth, lens, behind=[(wall, far), None]) for lens in lenses]
    options = {"min_depth": 1.2, "max_depth": 6.0, "max_steps": 4, "throw": False}
    found = fit.focal_stack(stack, lenses, **options)
    off = np.abs(np.asarray(found.depth) / depth - 1)
    figures = {
        "successes": float(found.success),
        "off": float(np.median(off)),
        "off by more than a tenth": float(np.mean(off > 0.1)),
    }
    shown = np.asarray(found.depth)[..., None] / 6 * np.ones(3)
    return Found(figures, np.concatenate([stack[0], shown], axis=1))
