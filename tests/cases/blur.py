"""Where the Gaussian blur fails: what is lost at borders, by rounding and for want of taps."""

import functools as ft
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage

from jaxfx import blur
from tests.cases.registry import Found, case


SAMPLINGS = ("discrete", "linear")
SIDE = 48


@ft.cache
def _program(sampling: Any, passes: int = 1, is_wide: bool = False) -> Any:
    """Of an image; and of sigma, if that is asked for."""
    call = ft.partial(blur.gaussian, taps=9, sampling=sampling, passes=passes)
    return jax.jit((lambda image, sigma: call(image, sigma=sigma)) if is_wide else call)


def _checks() -> np.ndarray:
    y, x = np.mgrid[: SIDE + 16, : SIDE + 16]
    return 0.5 + 0.5 * np.sin(0.35 * x[..., None]) * np.cos(
        0.5 * y[..., None] + 0.1 * x[..., None]
    )


@case("blur", {"lost": 1e-5}, (*SAMPLINGS, "divided by 4096"))
def darkening(method):
    """White, blurred nine times in float32, with weights of row 12 of Pascal's triangle without
    its outer two: what is lost if these are divided by the sum of the whole row."""
    white = np.ones((SIDE, SIDE, 1), np.float32)
    if method in SAMPLINGS:
        out = np.asarray(_program(method, 9)(white))
    else:
        weights, out = np.array([math.comb(12, i) for i in range(2, 11)]) / 4096, white
        for axis in 9 * (0, 1):
            out = scipy.ndimage.correlate1d(out, weights, axis=axis, mode="nearest")
    return Found({"lost": float(np.abs(out - 1).max())}, out)


@case("blur", {"steps of 1/255": 0.01}, ("float32", "8 bits"), {"8 bits": "zero: of rounding"})
def rounding(method):
    """A faint slope after nine passes, each rounded to 8 bits or not: the largest error."""
    slope = np.tile(np.linspace(0.10, 0.12, SIDE)[None, :, None], (SIDE, 1, 1))
    exact, out = np.asarray(_program("discrete", 9)(slope)), slope.astype(np.float32)
    if method == "8 bits":
        for _ in range(9):
            out = np.round(255 * np.asarray(_program("discrete")(out))) / 255
    else:
        out = np.asarray(_program("discrete", 9)(out))
    error = float(np.abs(out - exact).max())
    return Found({"steps of 1/255": 255 * error}, (out - 0.1) * 50)


@case(
    "blur",
    {"inside": 1e-12, "at the border": 0.01},
    SAMPLINGS,
    "exact, of the image whose border is repeated; biased, of what lies beyond it",
)
def borders(method):
    """Against the blur of an image that goes on: rms error in the four pixels about the frame,
    where its border is repeated instead, and the largest one elsewhere."""
    whole = _checks()
    error = np.asarray(_program(method)(whole[8:-8, 8:-8]))
    truth = np.asarray(_program(method)(whole))[8:-8, 8:-8]
    error, inside = error - truth, np.zeros((SIDE, SIDE), bool)
    inside[4:-4, 4:-4] = True
    rms = float(np.sqrt(np.mean(error[~inside] ** 2)))
    return Found(
        {"inside": float(np.abs(error[inside]).max()), "at the border": rms},
        10 * np.abs(error),
    )


@case("blur", {"change": 0.0, "gradient": 0.0}, SAMPLINGS, "zero in sigma: the limit, exact")
def sigma_to_0(method):
    """For sigmas of 0, 1e-30, 1e-3 and 0.02: the largest change of the image, which is to be
    left alone, and the largest derivative."""
    image = jnp.asarray(_checks()[8:-8, 8:-8])
    wide = _program(method, is_wide=True)
    both = jax.jit(lambda s: jax.jvp(lambda s: wide(image, s), (s,), (jnp.ones_like(s),)))
    change, slope, out = 0.0, 0.0, image
    for sigma in (0.0, 1e-30, 1e-3, 0.02):
        out, pushed = both(jnp.asarray(sigma))
        change = max(change, float(jnp.abs(out - image).max()))
        slope = max(slope, float(jnp.abs(pushed).max()))
    return Found({"change": change, "gradient": slope}, out)


SIGMAS = (1.35, 1.8, 4.0, 1000.0)


@case(
    "blur",
    {"too narrow": 0.03},
    tuple(f"sigma {sigma:g}" for sigma in SIGMAS),
    {f"sigma {sigma:g}": "biased: of the blur that the taps hold" for sigma in SIGMAS[1:]},
)
def too_few_taps(method):
    """A point under nine taps: by how much its spread falls short of sigma. A sigma of 1.8, a
    fifth of the taps, is the limit that the docstring names; more tends to a box."""
    sigma, offset = float(method.split()[1]), np.arange(SIDE) - SIDE // 2
    point = np.zeros((SIDE, SIDE, 1))
    point[SIDE // 2, SIDE // 2] = 1
    out = np.asarray(_program("discrete", is_wide=True)(point, jnp.asarray(sigma)))[..., 0]
    spread = float(np.sum(out.sum(axis=0) * offset**2)) ** 0.5
    return Found({"too narrow": 1 - spread / sigma}, out[16:-16, 16:-16] / out.max())


@case("blur", {"reach": 4.0, "other channels": 0.0}, SAMPLINGS)
def bad_pixel(method):
    """A NaN or an infinite pixel in the middle, in a corner or at a side: how far it spoils
    others, in pixels along an axis, with nine taps; how many of another channel."""
    reach, others, out = 0.0, 0, np.zeros(0)
    y, x = np.mgrid[:SIDE, :SIDE]
    for at in ((0, 0), (3, SIDE - 1), (20, 22)):
        for value in (np.nan, np.inf):
            image = np.repeat(_checks()[8:-8, 8:-8], 2, axis=-1)
            image[*at, 1] = value
            out = np.asarray(_program(method)(image))
            bad = ~np.isfinite(out)
            far = np.maximum(abs(y - at[0]), abs(x - at[1]))[bad[..., 1]]
            reach, others = max(reach, float(far.max())), others + int(bad[..., 0].sum())
    return Found(
        {"reach": reach, "other channels": float(others)}, np.where(bad, np.nan, out)[..., 1]
    )
