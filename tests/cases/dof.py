"""Where depth of field fails, and how far off each method is."""

import itertools

import jax.numpy as jnp
import numpy as np

from benchmarks.scenes.dof import (
    CAMERA,
    FLAT,
    LENS,
    METHODS,
    MIDDLE,
    RADIUS,
    SIZE,
    blurred,
    derivative,
    in_float32,
    off_quotients,
    random_picture,
    scenes,
)
from jaxfx import ThinLens
from tests.cases.registry import Found, case


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _seen(method: str, name: str) -> Found:
    """A method, or the reference, in one of the scenes; at worst, where there are several."""
    found, image = [], None
    for scene in scenes()[name]:
        data = (*scene.through(CAMERA), scene.lens)
        is_truth = method == "accumulate"
        image = np.asarray(scene.accumulated() if is_truth else blurred(method)(*data))
        error = image[MIDDLE, :, 0] - scene.truth
        band = error[scene.counted]
        figures = {"rms in the band": _rms(band), "rms of all": _rms(error)}
        if name == "slanted plane":
            figures["step"] = float(np.abs(np.diff(band)).max())
        if not is_truth:
            along = (jnp.zeros((SIZE, SIZE)), scene.lens.aperture, jnp.zeros(()))
            slope = derivative(method, *data, along)[MIDDLE, :, 0] - scene.slope
            figures["bias"] = _rms(slope[scene.counted])
            figures["gradient"] = off_quotients(method, *data)["gradient"]
        found.append(figures)
    return Found({name: max(each[name] for each in found) for name in found[0]}, image)


# What derivatives lack, against the truth and against the method's own difference quotients.
RIGHT_AND_BELOW = "biased at the focus: the slopes between pixels are those right and below"
KINKS = {"gather": RIGHT_AND_BELOW}
LEAKS = "biased: what leaks in moves with the lens"
OUTLINE = "missing: the outline, cut out, does not move"
ONE_LAYER = "biased: what the lens sees past the edge is not in the image"
GUESSED = "biased: what the lens sees past the edge is guessed"

ASKED = {"rms in the band": 0.02, "rms of all": None, "bias": None, "gradient": 1e-4}
REFERENCE = {"accumulate": "missing: of a rasteriser's image, whose edges do not move"}


@case("dof", {"float32": 1e-5, "float64": 1e-12}, METHODS)
def constant_image(method):
    """A constant image over any depth, of which some is infinite or next to the lens:
    the largest error."""
    image, depth = random_picture()
    data = np.full_like(image, 0.7), depth
    single, double = blurred(method)(*in_float32(*data), LENS), blurred(method)(*data, LENS)
    error = lambda out: float(np.abs(np.asarray(out) - 0.7).max())
    return Found({"float32": error(single), "float64": error(double)}, single)


@case(
    "dof",
    ASKED | {"rms in the band": 0.01, "step": 0.01},
    (*METHODS, *REFERENCE),
    KINKS | REFERENCE,
)
def slanted_plane(method):
    """An opaque plane through focus, whose colour is linear: no band may show, that is, no step
    of the error from pixel to pixel."""
    return _seen(method, "slanted plane")


@case(
    "dof",
    {"energy": 1e-5, "centroid": 1e-3, "second moment": 0.05},
    (*METHODS, "scatter, indicator"),
)
def single_bright_pixel(method):
    """The worst energy and centroid, in pixels, of discs of radius 0.3 to 5.9, and the second
    moment of one of 4.5, relative to the disc's. (Of `scatter` to a radius of 40 in
    tests/dof/test_scatter.py.)"""
    image, offset, found = np.zeros((SIZE, SIZE, 1)), np.arange(SIZE) - MIDDLE, []
    image[MIDDLE, MIDDLE] = 1
    for radius in (0.3, 0.5, 1.0, 1.49, 2.7, 5.9, 4.5):
        spread = blurred(method)(image, FLAT, ThinLens(1.0, 1.0, 2 * radius))
        spread = np.asarray(spread)[..., 0]
        centroid = np.hypot((spread * offset).sum(), (spread * offset[:, None]).sum())
        found.append((float(abs(spread.sum() - 1)), float(centroid)))
    second = (spread * (offset**2 + offset[:, None] ** 2)).sum() / spread.sum()
    energy, centroid = np.max(found, axis=0)
    moment = abs(second / (radius**2 / 2) - 1)
    figures = {"energy": energy, "centroid": centroid, "second moment": moment}
    return Found(figures, spread[8:-8, 8:-8] / spread.max())


@case(
    "dof",
    {"jump": 0.6, "unevenness": 2.0},
    (*METHODS, "scatter, indicator"),
    {"scatter, indicator": "missing: a pixel comes in whole; almost everywhere zero"},
)
def radius_from_0_to_2(method):
    """In steps of 0.05: the largest change of a step over that of one twice as long, a half for
    a slope and 1 for a jump; and over the mean change."""
    image, _ = random_picture()
    radii = np.arange(0, 2.025, 0.05)
    lenses = [ThinLens(1.0, 1.0, 2 * r + 1e-9) for r in radii]
    images = [np.asarray(blurred(method)(image, FLAT, lens)) for lens in lenses]
    change = lambda pair: float(np.abs(pair[1] - pair[0]).max())
    steps = [change(pair) for pair in itertools.pairwise(images)]
    strides = [change(pair) for pair in zip(images, images[2:], strict=False)]
    figures = {"jump": max(steps) / max(strides), "unevenness": max(steps) / np.mean(steps)}
    return Found(figures, images[-1] * 4)


@case(
    "dof",
    ASKED,
    (*METHODS, "scatter, gamma 1", "scatter, gamma 3", *REFERENCE),
    dict.fromkeys((*METHODS, "scatter, gamma 1", "scatter, gamma 3"), ONE_LAYER)
    | dict.fromkeys(("anisotropic_diffusion", "implicit_diffusion"), OUTLINE)
    | {"layered": GUESSED}
    | REFERENCE,
)
def blurred_foreground(method):
    """White, near and blurred, before black in focus: rms error in the band of one radius about
    the edge and in the whole row; bias, the error of the derivative in the aperture's
    logarithm; how far derivatives lie outside both difference quotients."""
    return _seen(method, "blurred foreground")


@case(
    "dof",
    ASKED | {"rms in the band": 0.01},
    (*METHODS, "scatter, epsilon 0", "scatter, epsilon 40", *REFERENCE),
    dict.fromkeys(("blend", "gather", "scatter, epsilon 40"), LEAKS) | REFERENCE,
)
def sharp_foreground(method):
    """White, near and in focus, before black that is blurred: what leaks, against epsilon."""
    return _seen(method, "sharp foreground")


THIN = dict.fromkeys(("blend", "gather"), LEAKS) | REFERENCE


@case("dof", ASKED | {"rms in the band": 0.01}, (*METHODS, *REFERENCE), THIN)
def thin_bar(method):
    """Dim bars of 1, 2 and 3 pixels in focus before a bright field: the worst of them."""
    return _seen(method, "thin bar")


@case("dof", {"dim pixels": 1e-3}, (*METHODS, "scatter, spans"))
def highlight(method):
    """Of 1e2, 1e4 and 1e6 in float32: the worst relative error of pixels below 0.2."""
    image, depth = random_picture()
    image, worst, single = image.copy(), 0.0, None
    for peak in (1e2, 1e4, 1e6):
        image[20, 24] = peak
        exact = np.asarray(blurred(method.partition(",")[0])(image, depth, LENS))
        single = np.asarray(blurred(method)(*in_float32(image, depth), LENS))
        worst = max(worst, float(np.abs(single / exact - 1)[exact < 0.2].max()))
    return Found({"dim pixels": worst}, 4 * single)


@case(
    "dof",
    {"not finite": 0.0, "reach, colour": RADIUS + 1.5, "reach, depth": RADIUS + 1.5}
    | {"aperture 0": 1e-6},
    METHODS,
)
def bad_input(method):
    """Values that are not finite for depths of 0, 1e-30 and 1e30; how far, in pixels, a NaN of
    the image or of the depth spoils others with a radius of 5.9; the largest change without
    an aperture. (Sizes from 1x1 on: tests/test_transforms.py; a focus distance that is not
    positive is a named error: tests/test_lens.py.)"""
    image, depth = random_picture()
    program, wrong = blurred(method), 0
    for z in (0.0, 1e-30, 1e30):
        spiked = depth.copy()
        spiked[::7, ::5] = z
        wrong += int((~np.isfinite(program(image, spiked, LENS))).sum())
    figures = {"not finite": float(wrong)}
    hurt, holed, lens = image.copy(), FLAT.copy(), ThinLens(1.0, 1.0, 2 * RADIUS)
    hurt[MIDDLE, MIDDLE] = holed[MIDDLE, MIDDLE] = np.nan
    for name, data in (("colour", (hurt, FLAT)), ("depth", (image, holed))):
        spoiled = np.asarray(program(*data, lens))[..., 0]
        row, column = np.nonzero(np.isnan(spoiled))
        far = np.hypot(row - MIDDLE, column - MIDDLE)
        figures[f"reach, {name}"] = float(far.max(initial=0.0))
    still = np.asarray(program(image, depth, ThinLens(0.0, 2.5, 60.0)))
    figures["aperture 0"] = float(np.abs(still - image).max())
    return Found(figures, 4 * spoiled)


@case(
    "dof",
    {"gradient": 1e-4, "not finite": 0.0},
    (*METHODS, "scatter, gamma 50", "scatter, epsilon 0"),
    KINKS,
)
def gradient(method):
    """With pixels at the focus plane, next to the lens, at infinity and clamped: how far
    derivatives in aperture, focus and depth lie outside both one-sided difference quotients,
    over the largest; how many are not finite."""
    image, depth = random_picture()
    return Found(
        off_quotients(method, image, depth, LENS), 4 * blurred(method)(image, depth, LENS)
    )


@case(
    "dof",
    {"jump": 1e-6},
    (*METHODS, "depth_sorted, all"),
    {"depth_sorted, all": "missing: of the order, where the result jumps"},
)
def ambiguous_order(method):
    """Behind a blurred grey half, black and white pixels in turn whose depths change places by
    1e-9: the largest change. A method that sorts jumps, unless its order is soft."""
    row, column = np.indices((SIZE, SIZE))
    turn, images = (-1.0) ** (row + column), []
    image = np.where(column < MIDDLE, 0.5, turn > 0)[..., None]
    for sign in (-1, 1):
        depth = np.where(column < MIDDLE, 1.2, 2.0 + sign * 1e-9 * turn)
        images.append(np.asarray(blurred(method)(image, depth, ThinLens(0.3, 4.0, 66.0))))
    return Found({"jump": float(np.abs(images[1] - images[0]).max())}, images[1])
