"""Multi-pass depth of field within an error."""

import math
import statistics
import time
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike

from jaxfx._arguments import check_camera, check_lens
from jaxfx._checks import Number, as_numpy
from jaxfx.budget._plan import Plan, check_call, plan
from jaxfx.camera import PinholeCamera
from jaxfx.dof.accumulate import accumulate as passes
from jaxfx.lens import ThinLens


# Passes whose variance tells how many would do.
_PILOT = 16


class Passes(eqx.Module):
    """`dof.accumulate` of some passes."""

    samples: int = eqx.field(static=True)
    title: ClassVar[str] = "depth of field by passes"

    def __call__(self, render: Any, camera: Any, lens: Any) -> Any:
        """As the effect; the picture alone."""
        return passes(render, camera, lens, samples=self.samples, progress=False).image


def accumulate(
    render: Callable[[PinholeCamera], ArrayLike],
    camera: PinholeCamera,
    lens: ThinLens,
    *,
    max_error: Number,
) -> Plan:
    """The passes of `dof.accumulate` that bring it within an error of infinitely many.

    Sixteen passes are rendered, whose variance in each pixel, over the number of passes, is the
    squared error of the mean of as many points of the lens taken at random. Those of
    `dof.accumulate` are spread more evenly than that, and so err less. The sixteen are what it
    costs.

    **Arguments:**

    - `render`, `camera`, `lens`: as in `dof.accumulate`; pictures height width channel.
    - `max_error`: positive; root mean square, linear image units, over all pixels and channels.

    **Returns:** a `Plan`, to be called with `render, camera, lens`; it gives the picture. Its
    error is an estimate, and its time that of one pass, times their number.

    **Raises:** `ValueError` as `dof.accumulate`, for a `max_error` that is not positive or
    traced data.

    **Gradient:** that of `dof.accumulate`; none through the number of passes.

    Source: the variance of a mean; Cook, Porter & Carpenter 1984 sample the lens so.
    """
    check_camera("accumulate(camera)", camera, PinholeCamera)
    if not isinstance(lens, ThinLens):
        raise ValueError(f"`accumulate(lens)` must be a ThinLens, got {type(lens).__name__}.")
    check_lens("accumulate(lens)", lens)
    max_error = check_call("accumulate", max_error, (camera, lens))
    if max_error == 0:
        raise ValueError("`accumulate(max_error=...)` must be positive, got 0.")
    pictures, seconds = [], []

    def kept(eye: PinholeCamera) -> ArrayLike:
        started = time.perf_counter()
        picture = as_numpy("accumulate(render)", render(eye))
        pictures.append(picture.astype(np.float64))
        seconds.append(time.perf_counter() - started)
        return pictures[-1]

    passes(kept, camera, lens, samples=_PILOT, progress=False)
    variance = float(np.var(pictures, axis=0, ddof=1).mean())
    samples = max(1, math.ceil(variance / max_error**2))
    text = f"passes beyond {samples}, for the variance of one is {variance:.2g}."
    error = math.sqrt(variance / samples)
    one = statistics.median(seconds)
    return plan(Passes(samples), error, samples * one, float("nan"), [text])
