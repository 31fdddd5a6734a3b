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
# # Depth of field, by every method
#
# One image, its depth and a lens go in: `(image, depth, lens, *, max_coc)`. All methods
# take the diameter $C$ of a pixel's circle of confusion from the lens, $C = E f\,|1/Z_f -
# 1/Z|$, and differ in who spreads what over whom. The reference is the mean of 128 images
# of the scene itself, from all over the lens.

# %%
import functools as ft
import os
import sys

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import trimesh
from matplotlib_inline.backend_inline import set_matplotlib_formats

from jaxfx import PinholeCamera, ThinLens, dof, io, metrics, relight, scene, tradeoff


sys.path.append("..")
from benchmarks.scenes import dof as dof_cases


plt.rcParams["figure.dpi"] = 80
set_matplotlib_formats("jpeg", pil_kwargs={"quality": 85})
SIDE, LARGEST, FOCUS, SAMPLES = 192, 16.0, 2.8, 128

room = scene.still_life()
camera = scene.default_camera(room, height=SIDE, width=SIDE)
lights = scene.default_lights(camera)
depth = scene.depth(room, camera, height=SIDE, width=SIDE)
unit = ThinLens.from_camera(camera, aperture=1.0, focus_distance=FOCUS)
lens = ThinLens(LARGEST / jnp.max(unit.circle_of_confusion(depth)), FOCUS, unit.focal_pixels)


def render(eye):
    return relight.render(scene.gbuffer(room, eye, height=SIDE, width=SIDE), eye, lights)


def passes(aperture, samples):
    eye = ThinLens(aperture, FOCUS, unit.focal_pixels)
    return dof.accumulate(render, camera, eye, samples=samples, progress=False)


reference, convergence = passes(lens.aperture, SAMPLES)
image, _ = passes(0.0, 16)  # a pinhole image, antialiased as the reference is
print(f"the reference's own error is about {float(convergence):.4f}")


# %%
def program(method):
    blurred = jax.jit(lambda image, depth: method(image, depth, lens, max_coc=LARGEST))
    return lambda: blurred(image, depth)


methods = {name: program(method) for name, method in dof_cases.methods().items()}
images = {"pinhole": image, "reference": reference}
images |= {name: method() for name, method in methods.items()}


def show(images, columns, size):
    rows = -(-len(images) // columns)
    _, axes = plt.subplots(
        rows, columns, figsize=(size * columns, (size + 0.3) * rows), layout="constrained"
    )
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, (title, shown) in zip(axes.flat, images.items(), strict=False):
        screen = io.srgb_from_linear(np.clip(np.asarray(shown), 0, 1))
        ax.imshow(screen, interpolation="nearest")
        ax.set_title(title, fontsize=9)
    plt.show()


show(images, columns=5, size=2.3)

# %% [markdown]
# Nearer: the rods before the focus, whose blur should let the room shine through.

# %%
crop = (slice(16, 88), slice(10, 82))
show({name: shown[crop] for name, shown in images.items()}, columns=5, size=2.3)

# %% [markdown]
# What each computes, of the pixel $q$:
#
# - `scatter` spreads every pixel $p$ over a disc: the mean of all $p$ under $K\,a_p$, with
#   $a_p$ the share of the disc that falls on $q$, $K = (Z_f/Z_p)^\gamma$ in front of the
#   focus, and 0 for background that would leak into what is in focus.
# - `depth_sorted` takes the same sprites front to back, the mean under $v_p =
#   \mathrm{clamp}(1 - \sum_{\text{nearer}} a,\; 0,\; a_p)$.
# - `layered` fills $q$'s lens from the front: of the $k$-th slice of defocus, of which $a_k$
#   arrives, it takes $\min(a_k,\; 1 - \text{filled})$. A sprite's share counts how its surface
#   is turned, so that the shares of a slanted floor add up to one. Beside an edge the lens sees
#   past the nearer surface: what lies there is guessed by `dof.peel`, or given as `behind`.
# - `separable` has sprites on a line, along rows and then along columns: a square for a disc.
# - `gather` reads 8 taps on $q$'s own circle, each mixed with a quarter-resolution image by
#   its blurriness; one in front of $q$ counts by its blurriness.
# - `blend` is $\mathrm{lerp}(I, B, C/C_{\max})$, with $B$ two blurs of 13 taps.
# - `anisotropic_diffusion` is $\partial I/\partial t = \nabla\!\cdot(g\,\nabla I)$ with $g =
#   \min(C_p, C_q)^2/32 \;/\; (1 + (\Delta D/\text{edge})^2)$, in the fewest stable steps.
# - `implicit_diffusion` solves $u - \partial_x(g\,\partial_x u) = I$, then $v -
#   \partial_y(g\,\partial_y v) = u$: two tridiagonal systems.
#
# ## Speed against accuracy
#
# Time of an image at this size against PSNR to the reference; beside it the PSNR in the band
# of one largest radius about the edges in depth, where methods differ most, and the most memory
# that the compiled program asks for beside its arguments. What a method does with the pinhole
# image is all that is timed; the true second layer is drawn beforehand. The peer of them all is
# the multi-pass image of few passes, rendering included.

# %%
inverse = 1 / jnp.asarray(depth)


def largest(x, side):
    return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (side, side), (1, 1), "SAME")


jump = largest(inverse, 3) > -1.05 * largest(-inverse, 3)
band = largest(jump.astype(jnp.float32), int(LARGEST) + 1) > 0

second = scene.gbuffer(room, camera, height=SIDE, width=SIDE, layer_index=1)
behind = relight.render(second, camera, lights), second.depth
second_layers = {
    "layered, one layer": program(ft.partial(dof.layered, behind=None)),
    "layered, true second": program(ft.partial(dof.layered, behind=[behind, None])),
}
for run in second_layers.values():
    jax.block_until_ready(run())
peers = {f"accumulate, {n} passes": lambda n=n: passes(lens.aperture, n).image for n in (4, 16)}
options = {"mask": band, "max_seconds": 1.0, "progress": False}
measurements = tradeoff.measure(methods, reference, repeats=5, **options)
measurements += tradeoff.measure(second_layers, reference, repeats=5, memory=False, **options)
measurements += tradeoff.measure(peers, reference, repeats=1, memory=False, **options)
set_matplotlib_formats("png")
figure, ax = plt.subplots(figsize=(8, 5.5), layout="constrained")
tradeoff.plot(measurements, ax)
ax.set_title(f"{SIDE} x {SIDE}, circles up to {LARGEST:.0f} pixels, on this machine's CPU")
plt.show()
for m in sorted(measurements, key=lambda m: -m.psnr):
    print(
        f"{m.name:22} {1e3 * m.seconds:8.1f} ms  {m.psnr:6.2f} dB  {m.band_psnr:6.2f} dB "
        f"in the band  SSIM {m.ssim:.3f}  {m.memory / 1e6:6.1f} MB"
    )
print(f"{'pinhole':22} {'':8}     {float(metrics.psnr(image, reference)):6.2f} dB")
print(f"{os.getloadavg()[0]:.0f} processes shared {os.cpu_count()} cores while this was timed")

# %% [markdown]
# The times are worth something only where no more processes than cores ran: under load, all
# are several times too long. `charts.ipynb` shows those that were measured by themselves.
#
# Two facts to take away. Two passes along lines lose a few tenths of a decibel to discs, unless
# a highlight shows their square, and their time grows with the radius in place of its square.
# And taps are cheap on a GPU, which reads between pixels for nothing; here every one of them is
# four reads, so gathering is neither fast nor good.
#
# ## One threshold for all scenes
#
# `layered` has one number, `threshold`, the width of a slice in pixels of defocus: thin slices
# take time, and in thick ones nothing hides anything. Its default was chosen on a scene of
# spheres and posts that is compared nowhere else, as the thickest slices that lose less than
# two tenths of a decibel to the best.

# %%
SMALL = 128
dice = np.random.default_rng(5)


def painted(mesh, place, tint):
    mesh.apply_translation(place)
    x, y, z = np.moveaxis(mesh.triangles_center, -1, 0)
    checks = (np.sin(9 * y) * np.sin(9 * (x + z)) > 0)[:, None]
    mesh.visual.face_colors = np.where(checks, tint, tint[::-1])
    return mesh


floor = trimesh.creation.box((14, 0.1, 14)).subdivide_to_size(0.5)
parts = [painted(floor, (0, -0.05, -2), (220, 190, 60))]
for x, z, r in ((-0.8, 2.2, 0.6), (0.5, 0.6, 0.5), (0.9, -2.5, 0.8), (-1.6, -1.5, 0.7)):
    parts.append(
        painted(trimesh.creation.icosphere(4, r), (x, r, z), dice.integers(20, 255, 3))
    )
for k in range(6):
    place = 0.75 * k - 2, 1.2, 3 - 1.3 * (2 * k % 5)
    parts.append(
        painted(trimesh.creation.box((0.12, 2.4, 0.12)), place, dice.integers(60, 255, 3))
    )
training = scene.from_trimesh(trimesh.Scene(parts))
view = PinholeCamera.look_at(
    (0.2, 1.6, 6), (0, 0.6, 0), up=(0, 1, 0), fov_y=0.75, height=SMALL, width=SMALL
)
lamps = scene.default_lights(view)


def layer_of(eye, layer=0):
    seen = scene.gbuffer(training, eye, height=SMALL, width=SMALL, layer_index=layer)
    return relight.render(seen, eye, lamps), seen.depth


def through(aperture, focus, samples):
    glass = ThinLens.from_camera(view, aperture=aperture, focus_distance=focus)
    draw = lambda eye: layer_of(eye)[0]
    return glass, dof.accumulate(draw, view, glass, samples=samples, progress=False).image


(_, distance), hidden = layer_of(view), layer_of(view, 1)
_, still = through(0.0, 4.0, 16)
trials = []
for share in (0.1, 0.5, 0.9):
    focus = float(np.quantile(distance[np.isfinite(distance)], share))
    glass = ThinLens.from_camera(view, aperture=1.0, focus_distance=focus)
    trials.append(
        through(12 / float(glass.circle_of_confusion(distance).max()), focus, samples=32)
    )
thresholds, curves = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0), {}
seconds = {"one layer": None, "guessed second": "peel", "true second": [hidden, None]}
for name, second in seconds.items():
    draw = jax.jit(
        lambda glass, width, second=second: dof.layered(
            still, distance, glass, max_coc=12.01, threshold=width, behind=second
        )
    )
    curves[name] = [
        np.mean([metrics.psnr(draw(glass, jnp.float32(t)), truth) for glass, truth in trials])
        for t in thresholds
    ]
figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
left.imshow(io.srgb_from_linear(np.clip(np.asarray(trials[1][1]), 0, 1)))
left.set_axis_off()
left.set_title("what the threshold was chosen on", fontsize=9)
for name, curve in curves.items():
    right.plot(thresholds, np.asarray(curve) - max(curve), "o-", label=name)
right.axvline(2.0, color="0.7", linewidth=1, zorder=0)
right.set(xlabel="threshold (pixels)", ylabel="PSNR less the best (dB)", ylim=(-2, 0.1))
right.legend()
right.grid(alpha=0.3)
plt.show()

# %% [markdown]
# `fit.dof(effect="layered")` fits it to one image. The curve is flat and has a hollow or two,
# so such a search stays near its start.
#
# ## Time and radius
#
# The implicit flow does the same work at any radius:

# %%
radii, line = (8, 24, 64), {}
for name in ("implicit_diffusion", "separable"):
    method = getattr(dof, name)
    blur = lambda image, depth, aperture, size, method=method: method(
        image, depth, ThinLens(aperture, FOCUS, unit.focal_pixels), max_coc=2 * size
    )
    blur = jax.jit(blur, static_argnames="size")
    wide = {
        r: lambda r=r, blur=blur: blur(image, depth, lens.aperture * 2 * r / LARGEST, r)
        for r in radii
    }
    for run in wide.values():
        jax.block_until_ready(run())
    timed = tradeoff.measure(wide, reference, repeats=5, memory=False, progress=False)
    line[name] = [1e3 * m.seconds for m in timed]

figure, ax = plt.subplots(figsize=(6, 3), layout="constrained")
for name, times in line.items():
    ax.plot(radii, times, "o-", label=name)
ax.set_xscale("log", base=2)
ax.set(ylim=(0, None), xlabel="largest radius (pixels)", ylabel="time (ms)")
ax.set_xticks(radii, radii)
ax.legend()
ax.grid(alpha=0.3)
plt.show()

# %% [markdown]
# ## Where they fail
#
# `stability.ipynb` has the figures of every method in every case, to which the tests hold them.
# Here are the cases with something to see, 46 pixels wide: a white half-plane before a black
# one, both ways; a dim bar of 3 pixels before a bright field; a slanted plane. The last row is
# the multi-pass reference, the line below each image its middle row, over the truth.

# %%
cases = {name: several[-1] for name, several in dof_cases.scenes().items()}
names = [*dof_cases.methods(), "accumulate"]
figure, axes = plt.subplots(
    len(names), 2 * len(cases), figsize=(13, 1.05 * len(names)), layout="constrained"
)
for row, name in enumerate(names):
    if name != "accumulate":
        method = jax.jit(
            lambda *data, name=name: getattr(dof, name)(*data, max_coc=dof_cases.MAX_COC),
            compiler_options={"xla_backend_optimization_level": 0},
        )
    for column, (case, example) in enumerate(cases.items()):
        if name == "accumulate":
            blurred = example.accumulated(128)
        else:
            blurred = method(*example.through(dof_cases.CAMERA), example.lens)
        left, right = axes[row, 2 * column : 2 * column + 2]
        left.imshow(blurred[12:-12, :, 0], cmap="gray", vmin=0, vmax=1)
        right.plot(example.truth, color="0.6", linewidth=2.5)
        right.plot(blurred[dof_cases.MIDDLE, :, 0], color="C3", linewidth=1)
        right.set(xticks=[], yticks=[], ylim=(-0.08, 1.08))
        left.set(xticks=[], yticks=[])
        if row == 0:
            left.set_title(case, fontsize=9, loc="left")
        if column == 0:
            left.set_ylabel(
                name.replace("_", "\n"), fontsize=8, rotation=0, ha="right", va="center"
            )
plt.show()

# %% [markdown]
# ## What none of them can do
#
# - An image holds one surface per pixel. Inside the edge of a blurred foreground the lens looks
#   past it, at what the image does not hold: no method of one layer gets *blurred foreground*
#   right, and `depth_sorted`, exact outside the edge, fails inside it as well. `layered`
#   guesses a second layer there, which is right in this case and a guess in any other:
#   `layered(behind=...)` takes the true one.
# - What neither layer shows, `layered` takes from the mean of what lies behind, and two edges
#   one before the other are taken to hide different parts of the lens.
# - `anisotropic_diffusion` and `implicit_diffusion` stop at every edge, so they never leak,
#   never jump and lose nothing to rounding; and a blurred foreground keeps its outline as if
#   cut out.
# - `gather` reads over the circle of the pixel where it stands: its blurred foreground ends
#   at its outline too, and its eight taps show, as does the image of a point.
# - `blend` blurs all by one width and fades it in, so that the sharp image shines through
#   what is a little out of focus; the halo of what is in focus lies on all that is not.
# - `separable` makes squares of highlights, and corners leak where the second pass spreads
#   what the first has mixed.
# - Changes are slopes, not jumps, for all of them: each derivative can be followed by a fit.
