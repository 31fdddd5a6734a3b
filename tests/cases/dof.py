"""Where depth of field fails, and how far off each method is."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from benchmarks.scenes.dof import (
    CAMERA,
    FLAT,
    LENS,
    MAX_COC,
    METHODS,
    MIDDLE,
    RADIUS,
    SIZE,
    blurred,
    covered,
    derivative,
    in_float32,
    off_quotients,
    random_picture,
    scenes,
)
from jaxfx import ThinLens, dof
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


# A lens in focus at depth 1 and one at 2, with circles of twice the radius at the other.
NEAR_FOCUS, FAR_FOCUS = (ThinLens(1.0, focus, 4 * RADIUS) for focus in (1.0, 2.0))


@case(
    "dof",
    {"rms in the band": 0.02},
    ("scatter", "layered, one layer", "layered", "layered, true second"),
    {"layered": GUESSED, "layered, true second": "exact"}
    | dict.fromkeys(("scatter", "layered, one layer"), ONE_LAYER),
)
def hidden_stripe(method):
    """White, near and blurred, before black in focus with a bright stripe, all of which it
    hides: rms error in the band of one radius about the edge. No guess knows of the stripe."""
    x = np.arange(SIZE) + 0.5 - MIDDLE
    wall = np.where((x > -4) & (x < -1), 0.8, 0.0)
    hides = covered(x, RADIUS)  # Of a pixel's lens.
    truth = hides + (1 - hides) * wall
    row = lambda values: np.broadcast_to(values, (SIZE, SIZE))
    image, depth = row(np.where(x < 0, 1.0, wall))[..., None], row(np.where(x < 0, 1.0, 2.0))
    second = row(wall)[..., None], row(np.where(x < 0, 2.0, np.inf))
    behind = {"layered, one layer": None, "layered, true second": second}
    if method in behind:
        options = {"max_coc": MAX_COC, "behind": behind[method]}
        seen = jax.jit(lambda *data: dof.layered(*data, **options))(image, depth, FAR_FOCUS)
    else:
        seen = blurred(method)(image, depth, FAR_FOCUS)
    error = np.asarray(seen)[MIDDLE, :, 0] - truth
    return Found({"rms in the band": _rms(error[np.abs(x) < RADIUS + 1])}, seen)


@case(
    "dof",
    {"rms on the outline": 0.04},
    (*METHODS, "layered, split"),
    {"layered, split": "biased: colours are parted by an estimate"},
)
def mixed_pixels(method):
    """A dark bar in focus, antialiased, whose outline's pixels are half of a striped wall,
    which is blurred: rms error of those pixels. Each shows its own stripe: dots along the
    outline."""
    x, y = np.arange(SIZE), np.arange(SIZE) + 0.5 - MIDDLE
    share = np.clip(np.minimum(x + 1 - 18.5, 22.5 - x), 0, 1)
    stripes = np.where(np.arange(-40, SIZE + 40) % 4 < 2, 0.65, 0.95)
    weight = np.diff(1 - covered(np.arange(-40.5, 41), RADIUS))
    wall = np.convolve(stripes, weight, mode="same")[40:-40]
    mixed = lambda wall: 0.05 * share + wall[:, None] * (1 - share)
    image, truth = mixed(stripes[40:-40])[..., None], mixed(wall)
    depth = np.broadcast_to(np.where(share > 0, 1.0, 2.0), (SIZE, SIZE))
    seen = np.asarray(blurred(method)(image, depth, NEAR_FOCUS))
    error = (seen[..., 0] - truth)[np.abs(y) < 8][:, share == 0.5]
    return Found({"rms on the outline": _rms(error)}, seen)


@case(
    "dof",
    {"elsewhere": 0.05, "energy": 1e-5},
    (*METHODS, "scatter, hexagon", "layered, hexagon"),
)
def light_through_six_blades(method):
    """A light of 50 times white, whose disc is a hexagon: the share of the light that lies
    elsewhere, beside exact areas, and the error of its energy."""
    lens, image = ThinLens(1.0, 1.0, 2 * RADIUS), np.zeros((SIZE, SIZE, 1))
    image[MIDDLE, MIDDLE] = 50
    # Points of each pixel that lie within all six sides.
    fine = (np.arange(SIZE * 32) + 0.5) / 32 - MIDDLE - 0.5
    sides = 0.3 + np.pi / 6 + np.arange(6) * np.pi / 3
    apothem = RADIUS * np.cos(np.pi / 6)
    within = np.ones((fine.size, fine.size), bool)
    for side in sides:
        within &= fine * np.cos(side) + fine[:, None] * np.sin(side) < apothem
    truth = within.reshape(SIZE, 32, SIZE, 32).mean(axis=(1, 3))
    name, _, shape = method.partition(", ")
    if shape:
        call = getattr(dof, name)
        iris = dof.Iris(6, rotation=0.3)
        blur = jax.jit(lambda *data: call(*data, iris=iris, max_coc=MAX_COC))
        seen = blur(image, FLAT, lens)
    else:
        seen = blurred(method)(image, FLAT, lens)
    seen = np.asarray(seen)[..., 0] / 50
    off = np.abs(seen - truth / truth.sum()).sum() / 2
    figures = {"elsewhere": float(off), "energy": float(abs(seen.sum() - 1))}
    return Found(figures, seen[8:-8, 8:-8] / seen.max())


@case(
    "dof",
    {"rms in the border": 0.02},
    (*METHODS, "layered, reflect", "layered, margin", "scatter, margin"),
)
def beyond_the_frame(method):
    """A blurred plane with waves that go on beyond the frame: rms error in the border of one
    radius, by the closed form of a disc's blur. One image does not hold what lies there."""
    beyond, wave = 8, 0.35
    x = np.arange(-beyond, SIZE + beyond) + 0.5
    size = SIZE + 2 * beyond
    waves = np.broadcast_to(0.5 + 0.4 * np.sin(wave * x), (size, size))[..., None]
    shrunk = 2 * scipy.special.j1(wave * RADIUS) / (wave * RADIUS)
    truth = 0.5 + 0.4 * shrunk * np.sin(wave * x[beyond:-beyond])
    lens, name = ThinLens(1.0, 1.0, 2 * RADIUS), method.partition(", ")[0]
    if method.endswith("margin"):
        call, depth = getattr(dof, name), np.full((size, size), FLAT[0, 0])
        options = {"max_coc": MAX_COC, "margin": beyond}
        seen = jax.jit(lambda *data: call(*data, **options))(waves, depth, lens)
    else:
        inner = waves[beyond:-beyond, beyond:-beyond]
        seen = blurred(method)(inner, FLAT, lens)
    error = np.asarray(seen)[MIDDLE, :, 0] - truth
    return Found({"rms in the border": _rms(np.r_[error[:6], error[-6:]])}, seen)
