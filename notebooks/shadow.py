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
# # Shadow maps, filtered only where it matters
#
# A shadow map keeps the depth $z_l$ that a light sees through each texel. A visible point, at
# depth $z_c$ from the light, is lit where $z_l \ge z_c - \text{bias}$. One comparison is
# aliased. Percentage-closer filtering (PCF) averages the comparisons of $n \times n$ texels;
# but in most pixels all of them agree.

# %%
import csv
import sys
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib_inline.backend_inline import set_matplotlib_formats

from jaxfx import AmbientLight, DirectionalLight, PointLight, fit, io, relight, scene, shadow


# The scenes that the tests and benchmarks use, whichever folder this runs in.
root = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "benchmarks").is_dir())
sys.path.append(str(root))
from benchmarks.scenes import shadow as shadow_scenes


set_matplotlib_formats("jpeg", pil_kwargs={"quality": 80})
plt.rcParams |= {"figure.dpi": 80, "font.size": 9, "axes.grid": True, "grid.alpha": 0.3}


def show_titled(titled, columns, width=10.0, **options):
    rows = -(-len(titled) // columns)
    size = (width, width / columns * rows * 1.08)
    _, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, (title, image) in zip(axes.flat, titled.items(), strict=False):
        ax.imshow(image, **options)
        ax.set_title(title)
    plt.show()


still = shadow_scenes.Still(192)
data, (clear, facing) = still.under_the_sun(512), still.truth(-still.sun)
sun = DirectionalLight(still.sun, [0.8, 0.76, 0.7])
gbuffer = scene.gbuffer(still.mesh, still.eye, height=192, width=192, backend="embree")
lit = np.asarray(relight.render(gbuffer, still.eye, [sun]))
dark = np.asarray(relight.render(gbuffer, still.eye, [AmbientLight([0.2, 0.21, 0.24])]))


def shaded(visible, mark=None):
    image = io.srgb_from_linear(np.clip(dark + np.asarray(visible)[..., None] * lit, 0, 1))
    if mark is None:
        return image
    grey = 0.4 + 0.6 * image.mean(axis=-1, keepdims=True)
    return np.where(np.asarray(mark)[..., None], [0.85, 0.1, 0.1], grey)


SIZE = 7
bias = {"bias": 0.005, "slope_bias": SIZE / 2}
hard, full = shadow.hard(*data, **bias), shadow.pcf(*data, size=SIZE, **bias)
edges, dilated = (
    shadow.candidates(*data, size=SIZE, edges="screen", dilation=d, **bias).where
    for d in (1, SIZE // 2 + 1)
)
exact = shadow.candidates(*data, size=SIZE, **bias)
show_titled(
    {
        "one comparison": shaded(hard),
        "depths filtered, then compared:\nthe wrong order": shaded(
            shadow.prefiltered(*data, size=SIZE, **bias)
        ),
        "compared, then filtered: PCF": shaded(full),
        'edges="screen", its edges': shaded(hard, edges),
        f"dilated by {SIZE // 2 + 1}": shaded(hard, dilated),
        'edges="depth"': shaded(hard, exact.where),
    },
    3,
)

# %% [markdown]
# - `edges="depth"`, the default, asks the smallest and the largest texel under the filter, a
#   running minimum and maximum of the map. If both say the same, all do. It can't miss: the
#   result is `pcf`'s to the last bit.
# - `edges="screen"` (Yu & Choi) filters near the edges of the hard shadow.
#
# Of $I$ pixels $B$ are filtered: $I + BF$ comparisons instead of $IF$, $F = n^2$; the mask by
# depth makes $I$ more.

# %%
masked = shadow.edge_pcf(*data, size=SIZE, **bias)
print(f"bits that differ: {int(jnp.sum(masked != full))}")
for name, mask, tests in (("depth", exact.where, 2), ("screen", dilated, 1)):
    comparisons = tests * mask.size + int(mask.sum()) * SIZE**2
    share = comparisons / (mask.size * SIZE**2)
    print(
        f"{name:7} filters {float(mask.mean()):5.1%}, {comparisons:,} comparisons: {share:.0%}"
    )
assert int(exact.comparisons) == 2 * exact.where.size + int(exact.where.sum()) * SIZE**2

# %% [markdown]
# ## Time against the size of the filter
#
# $512^2$ receivers, float32, 3 to 5 % of them in a penumbra. The times were measured on two
# idle cores by `benchmarks/shadow_growth.py` and are read from its file: here, beside
# other work, they would be noise.

# %%
times = {}
with open(root / "docs/shadow_growth.csv") as file:
    for row in csv.DictReader(file):
        times.setdefault(row["method"], {})[int(row["size"])] = float(row["milliseconds"])
figure, ax = plt.subplots(figsize=(7, 3.6), layout="constrained")
for method, by_size in times.items():
    style = ".--" if method == "native pcf" else ".-"
    ax.loglog(by_size.keys(), by_size.values(), style, label=method)
ax.set(xlabel="size of the filter, texels", ylabel="milliseconds")
ax.minorticks_off()
ax.set_xticks(list(times["pcf"]), labels=list(times["pcf"]))
ax.legend(ncols=2)
plt.show()
for name in ("screen mask", "depth mask", "variance"):
    faster = [size for size, t in times[name].items() if t < times["pcf"][size]]
    ratios = ", ".join(f"{times['pcf'][n] / times[name][n]:.1f} at {n}" for n in (3, 7, 21, 31))
    print(f"{name:11} below pcf from {min(faster)} x {min(faster)} on; times as fast: {ratios}")

# %% [markdown]
# ## Against shadow rays
#
# Embree traces one ray from each point to the light: a sun, and a point light with its six
# maps. The mean error of visibility, over surfaces that the light does not graze, by the side
# of a map and by the bias. Filters need more bias, $n/2$ texels of slope, which is their
# default, and blur what is sharp here: their error is larger.

# %%
still = shadow_scenes.Still()
sides = (128, 256, 512, 1024)
clear, facing = still.truth(-still.sun)
maps = {side: still.under_the_sun(side) for side in sides}


def about_the_lamp(side):
    faces = shadow.light_cameras(PointLight(still.lamp, [1, 1, 1]), map_size=side, margin=4)
    return still.compared(faces, side)


lights = {
    "sun": ((clear, facing), maps),
    "point light": (
        still.from_position(still.lamp),
        {side: about_the_lamp(side) for side in sides},
    ),
}
filters = {"hard": 1, "pcf 3 x 3": 3, "pcf 7 x 7": 7}
constants = np.geomspace(1e-3, 1, 13)
figure, axes = plt.subplots(2, 2, figsize=(9.5, 6), layout="constrained", sharey=True)
for (left, right), (light, ((seen, facing_it), by_side)) in zip(
    axes, lights.items(), strict=True
):

    def error(visible, seen=seen, facing_it=facing_it):
        return float(np.abs(np.asarray(visible) - seen)[facing_it].mean())

    for name, size in filters.items():
        half = size / 2
        errors = [
            error(shadow.pcf(*case, size=size, slope_bias=half)) for case in by_side.values()
        ]
        left.loglog(sides, errors, ".-", label=name)
        errors = [error(shadow.pcf(*by_side[512], size=size, bias=b)) for b in constants]
        right.loglog(constants, errors, ".-")
        right.axhline(
            error(shadow.pcf(*by_side[512], size=size, slope_bias=half)),
            color="0.6",
            linestyle=":",
        )
    left.set(xlabel="side of a map, texels", ylabel=f"mean error, {light}")
    left.minorticks_off()
    left.set_xticks(sides, labels=sides)
    right.set(xlabel="constant bias, units (dotted: half a filter of slope)")
axes[0, 0].legend()
plt.show()

# %% [markdown]
# Acne, what is lit and shown dark, against leaks, what is dark and shown lit, for both biases:
# `hard`, 512 texels. Half a texel of slope is all that a plane needs. A constant that does as
# well lets the light under what stands on the floor.

# %%
constants, slopes = [0, 0.003, 0.01, 0.03, 0.1, 0.3, 1], [0, 0.125, 0.25, 0.5, 1, 2, 4]
grid = [
    [
        shadow_scenes.acne_and_leaks(
            shadow.hard(*maps[512], bias=float(b), slope_bias=float(s)), clear, facing
        )
        for b in constants
    ]
    for s in slopes
]
figure, axes = plt.subplots(1, 2, figsize=(9.5, 3.8), layout="constrained")
for ax, rates, title in zip(axes, np.moveaxis(grid, -1, 0), ("acne", "leaks"), strict=True):
    ax.imshow(np.sqrt(rates), origin="lower", cmap="magma", vmax=0.7)
    for (j, i), rate in np.ndenumerate(rates):
        color = "white" if rate < 0.2 else "black"
        ax.text(i, j, f"{rate:.1%}", ha="center", va="center", fontsize=7, color=color)
    ax.set_xticks(range(len(constants)), labels=constants)
    ax.set_yticks(range(len(slopes)), labels=slopes)
    ax.set(title=title, xlabel="constant bias, units", ylabel="slope bias, texels")
    ax.grid(False)
plt.show()

# %% [markdown]
# A square lamp, 0.2 units wide: 36 rays per point. The error in its penumbra. PCF blurs
# everywhere alike, and no size is right; `pcss` looks for what blocks and filters as wide as
# the penumbra is; `variance` costs the same at any size, and leaks.

# %%
camera, lamp, share, penumbra = still.under_a_square_lamp(512, 0.2)
both = {"bias": 0.02, "slope_bias": 2.0}
error = lambda visible: float(np.abs(np.asarray(visible) - share)[penumbra].mean())
sizes = (1, 3, 7, 15)
peers = {
    "pcf": lambda n: shadow.pcf(*lamp, size=n, **both),
    "variance": lambda n: shadow.variance(*lamp, size=n, **both),
    "pcss": lambda n: shadow.pcss(*lamp, camera, size=n, light_size=0.2, **both),
}
figure, ax = plt.subplots(figsize=(6, 3), layout="constrained")
for name, filtered in peers.items():
    ax.plot(sizes, [error(filtered(n)) for n in sizes], ".-", label=name)
ax.set(xlabel="size, texels", ylabel="mean error in the penumbra", ylim=(0, None))
ax.legend()
plt.show()

# %% [markdown]
# ## What the screen mask misses
#
# A plate four texels wide, at several magnifications (pixels per texel), a 7 x 7 filter: the
# share of the penumbra that is left hard, against the dilation. Edges have to reach half a
# filter as the image shows it, so that one dilation does not serve two magnifications.

# %%
figure, ax = plt.subplots(figsize=(6, 3), layout="constrained")
reaches = (1, 2, 4, 8, 16, 32)
for magnification in (0.25, 0.5, 1, 2, 4, 8):
    case = shadow_scenes.plate(magnification, 4)
    sharp, soft = shadow.hard(*case), shadow.pcf(*case, size=SIZE)
    soft_pixels = np.asarray(soft != sharp)
    masks = (shadow.candidates(*case, size=SIZE, edges="screen", dilation=r) for r in reaches)
    missed = [np.mean(~np.asarray(mask.where)[soft_pixels]) for mask in masks]
    ax.semilogx(reaches, missed, ".-", label=f"{magnification}")
ax.set(xlabel="dilation, pixels", ylabel="share missed")
ax.minorticks_off()
ax.set_xticks(reaches, labels=reaches)
ax.legend(title="pixels a texel", ncols=2)
plt.show()

# %% [markdown]
# Wires of one texel, seen at four texels per pixel. Where the texel that a pixel reads is no
# wire there is no edge, and the screen mask loses the shadow, whatever the dilation. The mask
# by depth does not.

# %%
y, x = np.mgrid[:256, :256]
wires = (np.abs(x - 100 - 0.004 * y) < 0.5) | (np.abs(y - 0.25 * x - 90) < 0.5)
wires |= np.abs(np.hypot(x - 170, y - 80) - 40) < 0.5
far = np.where(wires, 2.0, 5.0)
u, v = np.meshgrid(*[4 * (np.arange(64) + 0.5)] * 2)
seen = shadow.Receivers(*map(jnp.asarray, (u + 0.25, v + 0.25, np.full_like(u, 4.0), 0 * u)))
show_titled(
    {
        "one comparison": shadow.hard(far, seen),
        "pcf 7 x 7": shadow.pcf(far, seen, size=SIZE),
        'edges="screen"': shadow.edge_pcf(far, seen, size=SIZE, edges="screen", dilation=1),
        'edges="depth"': shadow.edge_pcf(far, seen, size=SIZE),
    },
    4,
    cmap="gray",
    vmin=0,
    vmax=1,
)

# %% [markdown]
# ## Why a search needs softness
#
# Boxes from above: only their shadow tells where the sun is. The loss is the mean squared
# difference from the true visibility, with the map rendered again at every angle. From afar
# every loss leans towards the sun. Close up the hard one is a staircase, with a step for each
# pixel that flips: its derivative is zero wherever it has one, and a search has nothing to
# follow. A soft one has a derivative. Its small bumps are those of the maps: within a round of
# the search one map serves, whose shadow moves smoothly.

# %%
boxes = shadow_scenes.Boxes()
true_shadow = boxes.in_sun(boxes.sun)
loss = lambda visible: float(jnp.mean((visible - true_shadow) ** 2))


def hard_loss(direction):
    map_, light_camera = boxes.seen_from(direction, 32.0)
    points = shadow.receivers(
        boxes.gbuffer.depth, boxes.eye, light_camera, normal=boxes.gbuffer.normal
    )
    return loss(shadow.hard(map_, points, slope_bias=1.0))


def soft_loss(direction, scale):
    seen = boxes.seen_from(direction, scale)
    moving = shadow.MovingShadow(*seen, boxes.gbuffer, boxes.eye, softness=1 / scale)
    return loss(moving(DirectionalLight(direction, [1.0, 1.0, 1.0])))


figure, (far, near) = plt.subplots(1, 2, figsize=(9.5, 3.2), layout="constrained")
curves = {"hard": hard_loss} | {
    f"soft over 1/{scale:.0f} unit": lambda direction, scale=scale: soft_loss(direction, scale)
    for scale in boxes.scales[:3]
}
for color, (label, curve) in zip(("k", "C0", "C1", "C2"), curves.items(), strict=True):
    for ax, angles in ((far, np.linspace(-30, 30, 25)), (near, np.linspace(-0.6, 0.6, 31))):
        losses = [curve(boxes.turned(np.radians(angle), 0.4)) for angle in angles]
        losses = np.array(losses) / (1 if ax is far else np.mean(losses))
        ax.plot(angles, losses, ".-" if label == "hard" else "-", color=color, label=label)
far.set(xlabel="degrees from the sun", ylabel="loss", yscale="log")
near.set(xlabel="degrees from the sun", ylabel="loss over its mean")
far.legend()
plt.show()

# %% [markdown]
# `fit.lights` goes through these from coarse to fine, with a new map each round, from 15
# degrees away:

# %%
start = (
    AmbientLight([1.0, 1.0, 1.0]),
    DirectionalLight(boxes.turned(np.radians(15), 0.4), [1.0] * 3),
)
fitted = fit.lights(
    boxes.photograph(),
    boxes.gbuffer,
    boxes.eye,
    start,
    visibilities=boxes.shadows,
    rounds=len(boxes.scales),
    loss="squares",
    progress=False,
)
print(
    f"{boxes.miss(start[1]):.0f} degrees at first, {boxes.miss(fitted.lights[1]):.2f} at last"
)

# %% [markdown]
# ## What it cannot do
#
# - A map knows depths at its texels' centres. What is thinner than a texel is there or not;
#   what stands on a floor loses its shadow's foot to any bias.
# - PCF blurs all edges alike. `pcss` takes the mean blocker for all of them: where blockers lie
#   over one another it leaks, and a penumbra wider than its filter is cut.
# - `variance` leaks light where occluders lie over one another.
# - The screen mask loses shadows between pixels, and one dilation serves the whole image:
#   where light grazes a surface a filter covers ever more pixels.
# - The mask by depth reads the whole map: with few receivers and a large map, filter
#   everywhere.
# - No gradient knows that an occluder's outline moves with the light or the mesh. For a light,
#   render the map again between steps, as `fit.lights` does.
