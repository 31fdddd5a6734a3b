# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Charts: one method against the other
#
# Every method of every effect, measured in one run on one machine. Left is cheap, up is exact.
# A method that no other beats in both is filled and on the grey *Pareto front*; the others are
# hollow, and are kept for comparison.

# %%
import functools
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display
from matplotlib_inline.backend_inline import set_matplotlib_formats

from jaxfx import ThinLens, dof, metrics, reproject, tradeoff


# The command that measured, whichever folder this runs in.
root = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "benchmarks").is_dir())
sys.path.append(str(root))
from benchmarks import atlas, atlas_cases


set_matplotlib_formats("png")
plt.rcParams["figure.dpi"] = 80
rows, machine = atlas.read_rows(root / "docs/atlas.csv"), (root / "docs/atlas.txt").read_text()


def show(*names):
    for name in names:
        figure = atlas.charts(rows, name.split("_")[0], machine.strip())[name]()
        display(figure)
        plt.close(figure)


show("dof_time_still_life", "dof_time_fence")

# %% [markdown]
# Depth of field, given an image and its depth; multi-pass alone sees the scene.
#
# - **Read along the front.** Each step up must be paid for. `blend` is the cheapest; the
#   programs of `scatter` are one method at several prices, in one row; `layered` with a second
#   layer of depth is as exact as some thirteen passes, for a tenth of their time, and with a
#   guess of that layer as some ten.
# - **The scenes disagree**, and the second is there for that. Behind a fence out of focus lies
#   what no single image holds: methods of one layer end within four decibels of one another,
#   and only a second layer or more passes get further.
# - **More effort is no less error** for `gather`: more taps draw the same wrong disc more
#   finely.
# - **A plan is a point that was chosen by probing**: its number is the error that it may make
#   against `scatter`, not against the multi-pass reference that the chart measures by.

# %%
show("dof_own", "dof_memory_still_life")

# %% [markdown]
# The same against the largest circle: who grows with its area, who with its radius, and who
# not at all. Lines that meet in the left image change places there. Memory is that of one
# compiled program beside its arguments and its image; of multi-pass, which is many programs
# and a renderer, it is not known, and the chart says so.

# %%
show("shadow_own", "relight_own")

# %% [markdown]
# - **Shadows** against 36 rays to a square lamp. A filter of fixed width is right at one
#   distance from what casts the shadow, so a wider one is a worse one here; `pcss`, whose
#   width follows the penumbra, is best at every size. What is masked (`edges by depth`) gives
#   the image of the full filter, to the last bit, for less time as the filter grows.
# - **Relighting**: an image of $n$ lights costs $n$; an edit of one of them costs the same
#   whatever $n$ is. 80 dB stands for that and more: here, for rounding.
#
# ## How it is measured
#
# For a method's image $\hat I$ and the reference $I$, over the pixels and channels that
# count,
#
# $$\text{RMSE} = \sqrt{\operatorname{mean}\,(\hat I - I)^2}, \qquad
# \text{PSNR} = -20 \log_{10} \text{RMSE}\ \text{dB}.$$
#
# Each method is compiled ahead of time, called once, then timed until it is waited for: the
# median of up to 11 calls or 0.4 seconds. The bar is from the quickest call to the slowest,
# about the median. $a$ beats $b$ if it is no slower and no less exact, and either quicker or
# more exact. Here is the whole of it on an image of random discs:

# %%
rng = np.random.default_rng(0)
y, x = np.mgrid[:128, :128] + 0.5
image, depth = np.full((128, 128, 3), 0.5, np.float32), np.full((128, 128), 4, np.float32)
for z in sorted(rng.uniform(1, 4, 12), reverse=True):
    inside = (x - rng.uniform(0, 128)) ** 2 + (y - rng.uniform(0, 128)) ** 2 < 18**2
    image[inside], depth[inside] = rng.random(3), z
lens = ThinLens(1.0, 2.0, 24.0)
data = jnp.asarray(image), jnp.asarray(depth), lens


def compiled(method, **options):
    program = jax.jit(lambda *data: method(*data, max_coc=24.0, **options)).lower(*data)
    return functools.partial(program.compile(), *data)


methods = {
    "scatter": compiled(dof.scatter),
    "separable": compiled(dof.separable),
    "blend": compiled(dof.blend),
    **{f"gather {taps}": compiled(dof.gather, taps=taps) for taps in (8, 32)},
}
reference = compiled(dof.layered)()
runs = [tradeoff.measure(methods, reference, progress=False) for _ in range(3)]
figure, axes = plt.subplots(1, 3, figsize=(12, 4), sharey=True, layout="constrained")
for ax, measurements in zip(axes, runs, strict=True):
    tradeoff.plot(measurements, ax, lines={"gather": ["gather 8", "gather 32"]})
display(figure)
plt.close(figure)
for times in zip(*runs, strict=True):
    seconds = [m.seconds for m in times]
    print(f"{times[0].name:10} medians differ by {max(seconds) / min(seconds) - 1:4.0%}")

# %% [markdown]
# Three runs, one after another: heights repeat to the last digit, times do not. Two points
# nearer than that, side by side, are not in an order.
#
# ## What such a chart cannot say
#
# **Which error.** The same images by three scores: here they agree on the order, and not on
# the distances.

# %%
inverse = 1 / depth
step = np.maximum(np.abs(np.diff(inverse, axis=0))[:, 1:], np.abs(np.diff(inverse, axis=1))[1:])
edges = np.zeros(depth.shape, bool)
edges[1:, 1:] = step > 0.02
print(f"{'':12}{'PSNR':>8}{'at edges':>10}{'SSIM':>8}")
for name, method in methods.items():
    blurred = method()
    at_edges = metrics.psnr(blurred, reference, mask=edges)
    print(
        f"{name:12}{float(metrics.psnr(blurred, reference)):8.1f}{float(at_edges):10.1f}"
        f"{float(metrics.ssim(blurred, reference)):8.3f}"
    )

# %% [markdown]
# **What was left out.** A warped image has holes, and says where. The chart counts them as
# right, so a method that draws less errs less. The share that each draws belongs beside it:

# %%
show("reproject_time_still_life")
case = atlas_cases.warped(atlas_cases.Point("still life", 96, 3))
images, depths, cameras, target, _ = case.data
for method in atlas_cases.SEARCHES:
    _, alpha = reproject.warp(images[0], depths[0], cameras[0], target, search=method)
    print(f"{method:8} draws {float(jnp.mean(alpha > 0)):4.0%}")

# %% [markdown]
# - **Another machine.** Ratios of times change with cores, caches and memory, and a GPU would
#   turn some of them round. The margin says where a chart is from; `python -m benchmarks.atlas`
#   draws it again in under ten minutes.
# - **Another scene.** Two were measured, one of them made to fail. Which is like yours is not
#   on the chart; `budget` asks your scene itself.
# - **The whole price.** Given images cost nothing here; compiling, which takes seconds, is
#   not in the time, and arguments and results are not in the memory.
# - **The gradient.** Some are exact, some lack what visibility has, two may be as quick
#   forward and not backward: each docstring's **Gradient** line, and the benchmarks, say that.
# - **The eye.** A decibel of noise and a decibel of a missing edge are one decibel.
