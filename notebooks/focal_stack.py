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
# # How far away is it? Ask the focus ring
#
# Five photographs from a tripod, the focus moved from near to far. Nothing else changes, so
# what is sharp when tells how far away it is. `fit.focal_stack` finds from them the picture in
# which all is sharp, and a depth for every pixel with the error that it may have.
#
# Here the photographs are rendered, through points all over a lens, so that the truth is known.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

from jaxfx import ThinLens, dof, fit, io, relight, scene


plt.rcParams["figure.dpi"] = 70
SIZE = {"height": 72, "width": 96}
room = scene.still_life()
camera = scene.default_camera(room, **SIZE)
lights = scene.default_lights(camera)
shade = jax.jit(relight.render)
render = lambda eye: shade(scene.gbuffer(room, eye, **SIZE), eye, lights)

foci = 1 / np.linspace(1, 1 / 8, 5)
lenses = [ThinLens.from_camera(camera, aperture=0.1, focus_distance=float(f)) for f in foci]
# 124 points whose spread is that of a disc to 0.3 %; most other counts lack some per cent.
photographs = [
    np.asarray(dof.accumulate(render, camera, lens, samples=124, seed=48).image)
    for lens in lenses
]


def show(pictures, columns=5, **options):
    rows = -(-len(pictures) // columns)
    _, axes = plt.subplots(
        rows, columns, figsize=(3 * columns, 2.5 * rows), layout="constrained"
    )
    for axis, (title, picture) in zip(axes.flat, pictures.items(), strict=True):
        is_color = np.ndim(picture) == 3
        shown = io.srgb_from_linear(np.clip(picture, 0, 1)) if is_color else picture
        drawn = axis.imshow(shown, **({} if is_color else options))
        axis.set(title=title, xticks=[], yticks=[])
        if not is_color:
            plt.colorbar(drawn, ax=axis, shrink=0.8)
    plt.show()


show({f"focus at {f:.1f}": image for f, image in zip(foci, photographs, strict=True)})

# %% [markdown]
# ## One call
#
# `doubt` is empty where the photographs tell enough. `determined` are the pixels whose standard
# error is below a tenth of their depth.

# %%
options = {"min_depth": 0.75, "max_depth": 9.0, "max_steps": 12}
found = fit.focal_stack(photographs, lenses, **options)
depth = np.asarray(scene.gbuffer(room, camera, **SIZE).depth)
off = np.abs(np.asarray(found.depth) / depth - 1)
told = np.asarray(found.determined)
error = np.asarray(found.standard_errors["depth"])
print(f"{100 * float(found.share):.0f} % of the pixels are determined")
print(f"their median error: {100 * np.median(off[told]):.1f} %")
inside = np.mean((off * depth < 1.96 * error)[told])
print(f"within 1.96 standard errors: {100 * inside:.0f} %")
print("doubt:", found.doubt or "none")

# %%
show({"all in focus": np.asarray(found.image), "in the middle focus": photographs[2]}, 2)
relative = {"standard error / depth": error / np.asarray(found.depth), "error / depth": off}
show(relative, 2, vmin=0, vmax=0.1)
show({"1 / depth, found": 1 / np.asarray(found.depth), "1 / depth, true": 1 / depth}, 2)

# %% [markdown]
# ## Where it goes wrong, it says so
#
# Clouds passed: the second photograph is a fifth brighter. And an even wall has no texture.

# %%
brighter = [photographs[0], 1.2 * photographs[1], *photographs[2:]]
even = [np.full_like(image, 0.5) for image in photographs]
again = options | {"max_steps": 0}
for name, images in {"brighter": brighter, "even": even}.items():
    print(f"{name}: {fit.focal_stack(images, lenses, throw=False, **again).doubt}")

# %% [markdown]
# ## What a focal stack cannot tell
#
# The depth of an even surface: it looks the same in every focus. And what lies beside an edge,
# closer than the radius of the blur: the lens looks around the edge there, and a window about
# such a pixel shows two surfaces. A lens whose picture grows with its focus must be undone
# first.
