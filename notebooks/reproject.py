# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Reprojection: one image with its depth, from other cameras
#
# An image, its depth and its camera go in, and another camera:
# `warp(image, depth, source, target)`. Each pixel of the target sends its ray through the
# source's depth map, and reads the image where it meets a surface. Above what it shows, with
# hatching where it knows nothing; below the scene rendered again.

# %%
import functools
import sys
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib_inline.backend_inline import set_matplotlib_formats

from jaxfx import ThinLens, dof, io, metrics, reproject, scene, tradeoff
from jaxfx._pyramid import minimum_pyramid
from jaxfx.reproject import _crossings, _traversal


sys.path.append("..")
from benchmarks.scenes import reproject as cases


plt.rcParams["figure.dpi"] = 80
set_matplotlib_formats("jpeg", pil_kwargs={"quality": 85})
SIDE, DISTANCE = 160, 2.8

source, photograph = cases.photographer(scene.still_life(), SIDE)
image, depth = photograph(source)
warped = jax.jit(lambda target: reproject.warp(image, depth, source, target))


def hatched(drawn, alpha):
    stripes = np.add.outer(*map(np.arange, alpha.shape)) // 3 % 2 * 0.04 + 0.01
    return np.where(np.asarray(alpha)[..., None] > 0, drawn, stripes[..., None])


def show(ax, image, title=""):
    screen = io.srgb_from_linear(np.clip(np.asarray(image), 0, 1))
    ax.imshow(screen, interpolation="nearest")
    ax.set_title(title, fontsize=9)
    ax.set_axis_off()


turns = (-5, 0, 5, 10, 20, 40)
views = {degrees: cases.orbit(source, degrees, DISTANCE) for degrees in turns}
truths = {degrees: photograph(view) for degrees, view in views.items()}
figure, axes = plt.subplots(2, len(turns), figsize=(10.5, 3.7), layout="constrained")
for column, (degrees, view) in enumerate(views.items()):
    show(axes[0, column], hatched(*warped(view)), f"{degrees}°")
    show(axes[1, column], truths[degrees][0])
plt.show()

# %% [markdown]
# ## The search
#
# In $(x, y, -1/z)$ of the source a line stays a line, so that a ray is
# $o + t\,d$, clipped to the source's frustum. Texel $(j, i)$ is a column that begins at its
# depth and has no end, and the hit is the first
#
# $$t \ge 0 \quad\text{with}\quad z(t) \ge D[\lfloor y(t) \rfloor, \lfloor x(t) \rfloor].$$
#
# A pyramid holds the least depth of $2\times2$ texels, of those, and so on: no cell is farther
# than anything below it, and a ray nearer than a cell's depth passes the whole cell in a step.

# %%
pyramid = minimum_pyramid(jnp.asarray(depth))
figure, axes = plt.subplots(1, 7, figsize=(13, 2.1), layout="constrained")
for level, ax in enumerate(axes):
    ax.imshow(1 / np.asarray(pyramid.level(level)), cmap="magma", vmin=0, vmax=0.8)
    height, width = pyramid.shapes[level]
    ax.set_title(f"level {level}: {height} x {width}", fontsize=9)
    ax.set_axis_off()
plt.show()

# %% [markdown]
# One ray, step by step. A bar is the cell that it looks at: as wide as the cell, at
# the cell's depth. Where the ray reaches the bar it goes down two levels; where it leaves the
# cell, to the next one, and up a level if it also leaves the cell two levels above. No ray
# leaves a cell without looking at its neighbour: this is what makes the search exact.

# %%
size = 64
place = np.arange(size) + 0.5
profile = 0.75 + 0.1 * np.sin(place / 7)
profile[21:23], profile[49:] = 0.3, 0.45
field = jnp.asarray(np.broadcast_to(profile, (size, size)).copy())
ends = np.array([[2.0, 31.5, 0.0]]), np.array([[60.0, 0.0, 0.62]])
ray = _crossings.grid_rays(*(_crossings.coordinates(jnp.asarray(end)) for end in ends))
tree = minimum_pyramid(field)
begin = _crossings.entry_texel(ray, size, size)
left, up = _crossings.backward_axes(ray)
state = _traversal.pack(begin.x, begin.y, jnp.array([len(tree.shapes) - 1]), left, up)
step, cells = jax.jit(_traversal.step), []
while True:
    x, y, level, *_ = (int(v[0]) for v in _traversal.unpack(state))
    if level >= _traversal.MISS:
        break
    cells.append((x >> level, level, float(tree.level(level)[y >> level, x >> level])))
    state = step(tree, ray, state)

figure, ax = plt.subplots(figsize=(11, 4), layout="constrained")
ax.fill_between(place, profile, 1, step="mid", color="0.85")
ax.plot([2, 62], [0, 0.62], color="black", linewidth=1)
colors = plt.get_cmap("viridis")(np.linspace(0, 0.9, len(tree.shapes)))
for number, (node, level, nearest) in enumerate(cells, 1):
    ends = np.array([node, node + 1]) * 2**level
    ax.plot(ends, [nearest] * 2, color=colors[level], linewidth=2.5)
    ax.annotate(
        f"{number}",
        (ends.mean(), nearest - 0.025 * (number % 3)),
        fontsize=8,
        ha="center",
        va="bottom",
        color=colors[level],
    )
for level, color in enumerate(colors):
    ax.plot([], [], color=color, label=f"level {level}", linewidth=2.5)
ax.legend(fontsize=8, ncols=4, loc="lower left")
ax.set(xlabel="x (texels)", ylabel="depth", ylim=(0.9, 0))
ax.set_title(f"{len(cells)} steps to the hit")
plt.show()

# %% [markdown]
# ## Where the quicker methods fail
#
# `descent` goes from the root to a leaf and looks at no border; `linear` takes equal steps and
# a secant, `relief` equal steps and halvings: both step over what is thinner than a step. How
# often their hit is wrong, by a texel or altogether, on a smooth field, on posts and gaps of a
# texel, and at a cliff, from the front (no slope) to grazing (32 texels to a tenth of the
# depth). The last row is their time. `pyramid` is never wrong: the tests hold it to a search of
# every texel.

# %%
FIELD, SLOPES, COUNTS = 64, (0, 2, 8, 32), (4, 16, 64)
fields = {name: make(FIELD) for name, make in cases.FIELDS.items()}
LINES = {"descent": (7,), "linear": COUNTS, "relief": COUNTS}


def timed(run):
    jax.block_until_ready(run())
    times = []
    for _ in range(7):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return 1e3 * np.min(times)


set_matplotlib_formats("png")
figure, axes = plt.subplots(
    4, len(SLOPES), figsize=(12, 8.5), layout="constrained", sharex=True, sharey="row"
)
for column, slope in enumerate(SLOPES):
    rays = cases.slanted_rays(FIELD, slope)
    for row, (name, depth_field) in enumerate(fields.items()):
        ax = axes[row, column]
        for method, counts in LINES.items():
            rates = [
                100 * cases.error_rate(depth_field, slope, method, count) for count in counts
            ]
            ax.plot(counts, rates, "o-", label=method)
        steps = float(cases.run(depth_field, *rays).steps.mean())
        ax.plot(steps, 0, "*", color="black", markersize=11, label="pyramid")
        ax.set_title(f"{name}, slope {slope}", fontsize=9)
        ax.grid(alpha=0.3)
    ax = axes[3, column]
    for method, counts in LINES.items():
        searches = [
            functools.partial(cases.run, fields["posts"], *rays, search=method, max_steps=count)
            for count in counts
        ]
        ax.plot(counts, [timed(search) for search in searches], "o-")
    steps = float(cases.run(fields["posts"], *rays).steps.mean())
    search = functools.partial(cases.run, fields["posts"], *rays)
    ax.plot(steps, timed(search), "*", color="black", markersize=11)
    ax.set(xlabel="steps", xscale="log", yscale="log")
    ax.set_xticks([4, 16, 64], [4, 16, 64])
    ax.tick_params(axis="x", which="minor", labelbottom=False)
    ax.set_title("time, posts", fontsize=9)
    ax.grid(alpha=0.3)
for ax in axes[:3, 0]:
    ax.set_ylabel("rays in error (%)")
axes[3, 0].set_ylabel("ms for 64 x 64 rays")
axes[0, 0].legend(fontsize=8)
plt.show()

# %% [markdown]
# The price of being exact: at a slant a ray looks at more texels, by the logarithm of its
# length. Rays through hills with discs before them, the depth taken to be as deep as the image
# is wide.

# %%
angles, rows = (0, 10, 20, 30, 45, 60, 70, 80, 85), []
hills = jnp.asarray(cases.hills(256))
search = jax.jit(lambda origin, direction: reproject.intersect(hills, origin, direction))
for angle in angles:
    rays = [jnp.asarray(v) for v in cases.fan(256, np.tan(np.deg2rad(angle)))]
    steps = float(search(*rays).steps.mean())
    rows.append((steps, 1e6 * timed(functools.partial(search, *rays)) / 256**2))
set_matplotlib_formats("jpeg", pil_kwargs={"quality": 85})
figure, axes = plt.subplots(1, 2, figsize=(9, 2.8), layout="constrained")
for ax, values, label in zip(
    axes, zip(*rows, strict=True), ("steps a ray", "time a ray (ns)"), strict=True
):
    ax.plot(angles, values, "o-")
    ax.set(xlabel="angle off the view (degrees)", ylabel=label, ylim=(0, None))
    ax.grid(alpha=0.3)
plt.show()

# %% [markdown]
# ## Against the truth, and beside two peers
#
# `backward` is told the target's depth, and reads the image where each point lies: it draws
# what the source did not see in the colour of what hid it. `mesh` makes two triangles of every
# four texels, none across a step in depth, and traces them by Embree. Of what is visible in
# both, the PSNR; and of the whole image, what is drawn that was not seen (false hits), what
# is left empty that was seen (false holes) and what is drawn.

# %%
meshed = cases.depth_mesh(depth, source)
print(f"{'':15}{'PSNR':>8}{'false hits':>12}{'false holes':>13}{'coverage':>10}")
for degrees in (5, 10, 20, 40):
    target, (truth, target_depth) = views[degrees], truths[degrees]
    seen = cases.visible(depth, source, target, target_depth)
    shape = depth.shape
    drawn = {
        "warp": warped(target),
        "backward": cases.backward_warp(image, target_depth, source, target),
        "mesh": cases.trace(meshed, image, source, target, shape),
    }
    for name, (colors, alpha) in drawn.items():
        score = cases.scores(colors, alpha, truth, seen)
        print(
            f"{degrees:4}° {name:10}{score['PSNR']:8.1f}{100 * score['false hits']:10.1f} %"
            f"{100 * score['false holes']:11.1f} %{100 * score['coverage']:8.1f} %"
        )

# %% [markdown]
# The columns without end are the difference to the mesh: what has passed behind something near
# counts as unseen. And the time, of which the mesh spends most on its making:

# %%
target = views[10]
peers = {
    "warp": lambda: warped(target),
    "mesh, made and traced": lambda: cases.trace(
        cases.depth_mesh(depth, source), image, source, target, depth.shape
    ),
    "mesh, traced": lambda: cases.trace(meshed, image, source, target, depth.shape),
}
for name, run in peers.items():
    print(f"{name:24}{timed(run):8.1f} ms")

# %% [markdown]
# ## Depth of field by reprojection
#
# `dof.accumulate` takes any renderer. Given `warp` of a single image it needs no scene: each
# pass carries its alpha along, and the mean is divided by it. Beside `scatter` and `layered`,
# against 64 renderings of the scene itself:

# %%
FOCUS, LARGEST = 2.8, 16.0
unit = ThinLens.from_camera(source, aperture=1.0, focus_distance=FOCUS)
lens = ThinLens(LARGEST / jnp.max(unit.circle_of_confusion(depth)), FOCUS, unit.focal_pixels)
lensless = ThinLens(0.0, FOCUS, unit.focal_pixels)
render = lambda eye: photograph(eye)[0]
reference = dof.accumulate(render, source, lens, samples=64, progress=False).image
sharp = dof.accumulate(render, source, lensless, samples=16, progress=False).image
through = jax.jit(lambda eye: jnp.dstack(reproject.warp(sharp, depth, source, eye)))


def by_reprojection(samples):
    options = {"samples": samples, "jitter": False, "progress": False}
    total = dof.accumulate(through, source, lens, **options).image
    return total[..., :3] / jnp.maximum(total[..., 3:], 1 / samples)


def program(method):
    blurred = jax.jit(lambda image, depth: method(image, depth, lens, max_coc=LARGEST))
    return lambda: blurred(sharp, depth)


methods = {"scatter": program(dof.scatter), "layered": program(dof.layered)}
methods |= {f"warp x {n}": lambda n=n: by_reprojection(n) for n in (4, 16, 64)}
for method in methods.values():
    jax.block_until_ready(method())
measured = tradeoff.measure(
    methods, reference, repeats=5, max_seconds=1.0, memory=False, progress=False
)
figure, axes = plt.subplots(
    1, 4, figsize=(13, 3.2), layout="constrained", width_ratios=(1.7, 1, 1, 1)
)
tradeoff.plot(measured, axes[0], lines={"warp": [f"warp x {n}" for n in (4, 16, 64)]})
show(axes[1], reference, "reference")
show(axes[2], methods["warp x 64"](), "warp x 64")
show(axes[3], methods["layered"](), "layered")
plt.show()
for m in measured:
    print(f"{m.name:12}{1e3 * m.seconds:8.1f} ms{m.psnr:8.2f} dB  SSIM {m.ssim:.3f}")
print(f"{'sharp':12}{'':11}{float(metrics.psnr(sharp, reference)):8.2f} dB")

# %% [markdown]
# ## What it cannot do
#
# - It draws a single layer. What the source did not see stays empty; `blend` fills it from
#   several sources and `choose` finds the few that show most, and what none saw stays a hole.
# - Surfaces have no thickness that one image could tell: a column has no end, so that a rod
#   in front takes away all that a ray passes on its way behind it, though the source may have
#   seen it. The false holes above are this, and grow with the turn.
# - The image is read, not rendered: its sharpness, aliasing and highlights are the source's,
#   and a surface seen at grazing by the source is stretched.
# - `hole_threshold` decides what is one surface. A slope steeper than it breaks into holes, a
#   step smaller than it is bridged.
# - Derivatives in depth, cameras and image hold for the point that a pixel shows. What comes
#   into sight or goes out of it has none: `fit.camera` leaves silhouettes out for that reason.
