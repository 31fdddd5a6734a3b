"""Where shadow maps fail: what masks miss, what biases trade, what lies outside of the map."""

import functools as ft
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.scenes.shadow import (
    Still,
    acne_and_leaks,
    noise,
    plate,
    slats,
    steps,
    two_discs,
)
from jaxfx import OrthographicCamera, shadow
from tests.cases.registry import Found, case


HARD = "zero: the comparison is a step"


SIZES = {f"{size} texels": (size, np.float32) for size in (1, 3, 7, 15, 31)}
SIZES["5 texels, float64"] = (5, np.float64)


@case("shadow", {"pixels": 0.0}, SIZES, HARD)
def mask_by_depth(method):
    """Pixels of `edge_pcf(edges="depth")` of which any bit differs from `pcf`, of 16,000: four
    random maps with receivers in and about them, two biases. (Even sizes are a named error:
    tests/shadow/test_pcf.py.)"""
    size, dtype = SIZES[method]
    data = [steps(seed, dtype) for seed in (0, 1)]
    data += [noise(seed, (64, 80), (40, 50), dtype) for seed in (2, 3)]
    differing, visible = 0, None
    for each in data:
        for slope_bias in (0.0, 0.7):
            options = {"size": size, "bias": 0.013, "slope_bias": slope_bias}
            visible = np.asarray(shadow.edge_pcf(*each, edges="depth", **options))
            differing += int((visible != np.asarray(shadow.pcf(*each, **options))).sum())
    return Found({"pixels": float(differing)}, visible)


# Of `plate`: pixels a texel, the plate's width, by how much it is moved; and the dilation.
SCREENS: dict[str, tuple[float, int, float, int | None]] = {
    "0.25x": (0.25, 16, 0.0, None),
    "1x": (1.0, 16, 0.0, None),
    "8x": (8.0, 6, 0.0, None),
    "4x, dilation 1": (4.0, 4, 0.0, 1),
    "4x, dilation 4": (4.0, 4, 0.0, 4),
    "4x, dilation 16": (4.0, 4, 0.0, 16),
    "0.25x, 1 texel between pixels": (0.25, 1, 2.0, None),
    "8x, edges beyond the frame": (8.0, 16, 0.0, None),
}
MISSED = "missing where the mask misses; else zero, of a step"
MISSING = ("4x, dilation 1", "4x, dilation 4", *list(SCREENS)[-2:])


@case("shadow", {"share": 0.0}, SCREENS, {m: MISSED if m in MISSING else HARD for m in SCREENS})
def mask_by_screen(method):
    """The share of pixels where `edge_pcf(edges="screen")` differs from `pcf` at 7x7: the
    shadow of a plate, so many pixels to a texel, with the usual dilation or a given one."""
    magnification, width, moved, dilation = SCREENS[method]
    shadow_map, receivers = plate(magnification, width)
    receivers = receivers._replace(u=receivers.u + moved)
    data, options = (shadow_map, receivers), {"size": 7}
    screen = np.asarray(shadow.edge_pcf(*data, edges="screen", dilation=dilation, **options))
    differs = screen != np.asarray(shadow.pcf(*data, **options))
    return Found({"share": float(differs.mean())}, np.where(differs, np.nan, screen))


BIASES = {
    f"bias {bias:g}, slope {slope:g}": (bias, slope)
    for bias in (0.0, 0.01, 0.1, 0.5)
    for slope in (0.0, 0.5, 2.0)
}


@ft.cache
def _sunlit() -> tuple[Any, Any, Any]:
    """The still life under the sun: map and receivers; which points see it, which face it."""
    still = Still()
    return (still.under_the_sun(512), *still.truth(-Still.sun))


@case("shadow", {"acne": 0.005, "leaks": 0.04}, BIASES, HARD)
def bias_and_slope(method):
    """The still life, ten units across, with a map of 512 texels, against traced rays: the
    share of what is lit that is shown dark; and of what is dark, shown lit. In red, both."""
    bias, slope_bias = BIASES[method]
    data, clear, facing = _sunlit()
    visible = np.asarray(_hard()(*data, jnp.asarray(bias), jnp.asarray(slope_bias)))
    acne, leaks = acne_and_leaks(visible, clear, facing)
    wrong = facing & ((visible > 0) != clear)
    picture = np.where(wrong, np.nan, 0.15 + 0.85 * visible * facing)
    return Found({"acne": float(acne), "leaks": float(leaks)}, picture)


@ft.cache
def _hard() -> Any:
    return jax.jit(lambda *data: shadow.hard(*data[:2], bias=data[2], slope_bias=data[3]))


CAMERA = OrthographicCamera(2.0, [2.5, 2.5], np.eye(4))
FILTERS: dict[str, Any] = {
    "hard": shadow.hard,
    "prefiltered": ft.partial(shadow.prefiltered, size=3),
    "pcf": ft.partial(shadow.pcf, size=3),
    "pcf, soft Gaussian": ft.partial(shadow.pcf, size=3, kernel="gaussian", softness=0.3),
    "edge_pcf": ft.partial(shadow.edge_pcf, size=3, edges="depth"),
    "pcss": lambda *data: shadow.pcss(*data, CAMERA, size=3, light_size=0.1),
    "variance": ft.partial(shadow.variance, size=3),
    "variance, exponents 80 and 10": ft.partial(shadow.variance, size=3, exponents=(80, 10)),
}
SOFT = ("pcf, soft Gaussian", "pcss", "variance", "variance, exponents 80 and 10")


@case(
    "shadow",
    {"not lit": 0.0, "not dark": 1e-12, "spoilt": 0.0},
    FILTERS,
    {name: HARD for name in FILTERS if name not in SOFT}
    | {"pcss": "zero, of the comparisons; exact, of the penumbra"},
)
def outside_of_the_map(method):
    """Receivers beyond the map's borders, behind the light or not numbers, and those of an
    empty map, that are not fully lit; one below a wall, in the middle, that is lit; and how
    many pixels change, beyond what the filter reaches, with a texel that is not a number."""
    run = FILTERS[method]
    nan, inf = np.nan, np.inf
    points = [(-9, 2, 5), (99, 2, 5), (2, -9, 5), (2, 99, 5), (2, 2, -1), (2, 2, 0)]
    points += [(nan, 2, 5), (2, inf, 5), (2, 2, nan), (2, 2, inf), (2, nan, 5), (2.5, 2.5, 5)]
    u, v, z = np.array(points, float).T[:, :, None]
    seen = shadow.Receivers(*map(jnp.asarray, (u, v, z, 0 * u)))
    visible, empty = (np.asarray(run(np.full((5, 5), depth), seen)) for depth in (1.0, inf))
    broken = np.random.default_rng(0).uniform(1, 3, (5, 5))
    far = seen._replace(u=0 * seen.u + 1.0, v=0 * seen.v + 1.0, z=0 * seen.z + 2.0)
    before = np.asarray(run(broken, far))
    broken[4, 4] = nan
    figures = {
        "not lit": float((visible[:-1] != 1).sum() + (empty != 1).sum()),
        "not dark": float(abs(visible[-1, 0])),
        "spoilt": float((np.asarray(run(broken, far)) != before).sum()),
    }
    return Found(figures, np.reshape(visible, (3, 4)))


WARPS: dict[str, Any] = {"variance": None} | {
    f"variance, exponents {c} and {d}": (c, d) for c, d in ((20, 5), (40, 10), (80, 10))
}


@case("shadow", {"slats": 0.01, "still life": 0.01, "acne": 0.01, "off": None}, WARPS)
def occluders_over_one_another(method):
    """A filter of 9x9 where `pcf` of 11x11 finds no lit texel: the largest visibility below
    slats above a table, and in the still life under the sun; where it finds no dark one, the
    largest darkness; the root mean square distance to `pcf` of 9x9 in the picture."""
    off, leaks, acne, picture = 0.0, {}, 0.0, None
    for name, data in (("still life", _sunlit()[0]), ("slats", slats())):
        bias = {"bias": 0.02, "slope_bias": 5.0} if name == "still life" else {}
        picture = np.asarray(shadow.variance(*data, size=9, exponents=WARPS[method], **bias))
        reference, wide = (np.asarray(shadow.pcf(*data, size=n, **bias)) for n in (9, 11))
        leaks[name] = float(picture[wide == 0].max())
        acne = max(acne, float(1 - picture[wide == 1].min()))
        off = float(np.sqrt(np.mean((picture - reference) ** 2)))
    return Found(leaks | {"acne": acne, "off": off}, picture)


COUNTED = {
    f"{mask}, {size} texels": (mask, size) for size in (7, 21) for mask in ("screen", "depth")
}


@case("shadow", {"off": 0.0, "of pcf's": None}, COUNTED, "none: these are counts")
def comparisons(method):
    """The shadows of two discs, a pixel 0.9 texels wide: comparisons that are counted against
    I + B F^2, with one I more for the mask by depth; and their share of `pcf`'s, I F^2."""
    mask, size = COUNTED[method]
    shadow_map, fields = two_discs(size)
    found = shadow.candidates(shadow_map, shadow.Receivers(*fields), size=size, edges=mask)
    where = np.asarray(found.where)
    expected = (2 if mask == "depth" else 1) * where.size + where.sum() * size**2
    off = abs(int(found.comparisons) - int(expected))
    share = float(found.comparisons) / (where.size * size**2)
    return Found({"off": float(off), "of pcf's": share}, 1.0 * where)


@ft.cache
def _soft(kernel: str) -> tuple[Any, Any]:
    """A filter of map, receivers, bias and softness, and its derivative along a direction."""

    def run(*at):
        shadow_map, receivers, bias, softness = at
        options = {"bias": bias, "slope_bias": bias, "softness": softness}
        return shadow.pcf(shadow_map, receivers, size=3, kernel=kernel, **options)

    return jax.jit(run), jax.jit(lambda at, along: jax.jvp(run, at, along)[1])


@case(
    "shadow",
    {"gap": 1e-12, "gradient": 1e-4},
    ("no softness", "box", "tent", "gaussian"),
    {"no softness": f"{HARD}, the picture's jumps are missing"},
)
def softness_to_0(method):
    """The largest difference to the hard image at a softness of 1e-6; and how far the
    derivative of the whole image, in map, receivers, bias and softness, lies from the
    difference quotient at 0.03, 0.3 and 1, relative to that (in the bias, over 0.1, where there
    is no softness)."""
    shadow_map, receivers = jax.tree.map(jnp.asarray, noise())
    if method == "no softness":
        dark = lambda bias: shadow.pcf(shadow_map, receivers, size=3, bias=bias)
        quotient = float(jnp.sum(dark(0.1) - dark(0.0)))
        slope = float(jnp.sum(jax.jvp(dark, (0.05,), (1.0,))[1]))
        off = abs(0.1 * slope - quotient) / abs(quotient)
        return Found({"gradient": off}, dark(0.0))
    run, push = _soft(method)
    sharp = shadow.pcf(shadow_map, receivers, size=3, kernel=method, bias=0.05, slope_bias=0.05)
    bias, worst, rng = jnp.asarray(0.05), 0.0, np.random.default_rng(6)
    soft = run(shadow_map, receivers, bias, jnp.asarray(1e-6))
    for softness in (0.03, 0.3, 1.0):
        at = (shadow_map, receivers, bias, jnp.asarray(softness))
        along = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), at)
        ends = [
            jax.tree.map(lambda x, d, h=h: jnp.where(jnp.isinf(x), x, x + h * d), at, along)
            for h in (1e-7, -1e-7)
        ]
        ahead, behind = (run(*end) for end in ends)
        quotient = float(jnp.sum(ahead - behind)) / 2e-7
        worst = max(worst, abs(float(jnp.sum(push(at, along))) / quotient - 1))
    return Found({"gap": float(jnp.abs(soft - sharp).max()), "gradient": worst}, run(*at))
