"""Truth, result, stated error, ratio and seconds of `fit.lights`, for `docs/fits.md`.

`python -m benchmarks.fit_lights` prints it: the images of `tests/cases/lit.py`, a sun and a
lamp in each, clean, with noise, clipped, and with shadows that the model lacks. Seconds are
those of a second call, the median of five.
"""

import time

import jax
import numpy as np

from jaxfx import fit
from tests.cases import lit


def scenes(seed):
    """For one pair of lights: names of images, the images, the lights and their start."""
    clean, truth, start = lit.problem(seed, spheres=0, noise=0)
    yield "clean", clean, truth, start
    yield "noise of 3 %", lit.problem(seed, spheres=0, noise=0.03)[0], truth, start
    clipped = np.minimum(clean, np.quantile(clean, 0.9))
    yield "a tenth clipped", clipped, truth, start
    for loss in ("", ", squares"):
        shadowed, truth, start = lit.problem(seed, noise=0.01)
        yield f"shadows lacking, noise of 1 %{loss}", shadowed, truth, start


def found(name, image, start):
    loss = "squares" if name.endswith("squares") else "robust"
    how = {"loss": loss, "throw": False}
    return jax.block_until_ready(fit.lights(image, lit.cache(), lit.CAMERA, start, **how))


def seconds(name, image, start):
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        found(name, image, start)
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def shown(numbers):
    return ", ".join(f"{number:.4f}" for number in np.ravel(numbers))


def main():
    jax.config.update("jax_enable_x64", True)
    print("| image | parameter | truth | found | stated error | error / stated | success | s |")
    print("|---|---|---|---|---|---|---|---:|")
    for name, image, truth, start in scenes(0):
        result, took = found(name, image, start), seconds(name, image, start)
        for (index, field), (miss, error) in lit.misses(result, truth).items():
            kind = ("sun", "lamp")[index]
            ends = [np.asarray(getattr(each[index], field)) for each in (truth, result.lights)]
            if field == "direction":
                ends = [end / np.linalg.norm(end) for end in ends]
            ratio = np.max(np.abs(miss) / error)
            print(
                f"| {name} | {kind}, {field} | {shown(ends[0])} | {shown(ends[1])} "
                f"| {shown(error)} | {ratio:.2f} | {result.success} | {took:.2f} |"
            )


if __name__ == "__main__":
    main()
