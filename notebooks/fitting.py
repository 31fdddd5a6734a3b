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
# # What made this image?
#
# Every effect here is a differentiable function of its parameters, so an image can be asked
# for them: least squares between the effect's output and the image. `fit.dof` asks for a
# lens, `fit.camera` for a pose, `fit.lights` for the lights;
# `docs/fits.md` says how well.

# %%
import tempfile
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import trimesh
from PIL import Image

from jaxfx import (
    AmbientLight,
    DirectionalLight,
    GBuffer,
    OrthographicCamera,
    PinholeCamera,
    PointLight,
    SpotLight,
    ThinLens,
    depth as depths,
    dof,
    exr,
    fit,
    io,
    relight,
    scene,
    shadow,
)


plt.rcParams["figure.dpi"] = 80
SIZE = {"height": 72, "width": 96}
room = scene.still_life()
camera = scene.default_camera(room, **SIZE)
gbuffer = scene.gbuffer(room, camera, **SIZE)


def show(**images):
    _, axes = plt.subplots(1, len(images), figsize=(4 * len(images), 3.2), layout="constrained")
    for axis, (name, image) in zip(axes, images.items(), strict=True):
        axis.imshow(np.clip(io.srgb_from_linear(np.asarray(image)), 0, 1))
        axis.set(title=name.replace("_", " "), xticks=[], yticks=[])
    plt.show()


# %% [markdown]
# ## A lens, from two EXR files
#
# A render as Blender writes it, image and depth in one file, and the same view through a lens.
# Both are made here, the render by 16 passes, as renderers smooth edges, the other by 64. With
# one sample per pixel edges are sharper than in any photograph: the aperture then comes out 4
# to 8 % larger.

# %%
folder = Path(tempfile.mkdtemp())
lamps = scene.default_lights(camera)


def taken(eye):
    seen = scene.gbuffer(room, eye, **SIZE)
    return relight.render(seen, eye, lamps), seen.depth


def seen_through(lens, samples):
    draw = lambda eye: taken(eye)[0]
    return dof.accumulate(draw, camera, lens, samples=samples, progress=False).image


lens = ThinLens.from_camera(camera, aperture=0.1, focus_distance=2.5)
pinhole = ThinLens.from_camera(camera, aperture=0.0, focus_distance=2.5)
image, depth = seen_through(pinhole, 16), taken(camera)[1]
exr.write(folder / "render.exr", {"ViewLayer.Combined": image, "ViewLayer.Depth": depth})
exr.write(folder / "lens.exr", seen_through(lens, 64))

# %% [markdown]
# The search starts with an aperture that is 30 % too large and a focus that is 15 % too far.

# %%
image, depth = exr.read_rgbd(folder / "render.exr")
photograph = io.read_color(folder / "lens.exr")
start = ThinLens(1.3 * lens.aperture, 1.15 * lens.focus_distance, lens.focal_pixels)
names = "aperture", "focus_distance"
options = {"effect": "layered", "parameters": names, "max_coc": 12, "throw": False}
fitted = fit.dof(photograph, image, depth, start, **options)
for name in names:
    value, true = (float(getattr(each, name)) for each in (fitted.lens, lens))
    print(f"{name:15}{value:.4f} +- {fitted.standard_errors[name]:.4f}, true {true:.4f}")
print(fitted.success, fitted.doubt)
show(render=image, through_a_lens=photograph, fitted=fitted.image)

# %% [markdown]
# ## A pose, from two RGB-D frames
#
# As a depth camera writes them: colour as sRGB of 8 bits, depth in millimetres of 16 bits, 0
# where there is none. The second frame is taken from 9 cm and 2.9 degrees aside.

# %%
aside = np.eye(4)
aside[:3, :3] = [[np.cos(0.05), 0, np.sin(0.05)], [0, 1, 0], [-np.sin(0.05), 0, np.cos(0.05)]]
aside[:3, 3] = 0.08, 0.02, 0.03
second = PinholeCamera(camera.intrinsics, camera.world_from_camera @ aside)
for name, eye in (("first", camera), ("second", second)):
    colors, depth = taken(eye)
    io.write_png(folder / f"{name}.png", colors)
    millimetres = np.where(np.isfinite(depth), np.rint(1000 * depth), 0).astype(np.uint16)
    Image.fromarray(millimetres).save(folder / f"{name}_depth.png")


def frame(name):
    millimetres = io.read_depth(folder / f"{name}_depth.png")
    return io.read_color(folder / f"{name}.png"), depths.clean(millimetres, unit=1e-3)


(image, depth), (other, other_depth) = frame("first"), frame("second")
start = PinholeCamera(second.intrinsics, camera.world_from_camera)
found = fit.camera(other, image, depth, camera, start, reference_depth=other_depth, throw=False)
motion = np.linalg.inv(second.world_from_camera) @ found.camera.world_from_camera - np.eye(4)
turn = np.linalg.norm(motion[:3, :3]) / np.sqrt(2)
shift, angle = (float(jnp.linalg.norm(each)) for each in found.standard_errors.values())
print(f"off by {1000 * np.linalg.norm(motion[:3, 3]):.1f} mm, {np.degrees(turn):.3f} degrees")
print(f"stated {1000 * shift:.1f} mm, {np.degrees(angle):.3f} degrees")
print(found.success, found.doubt)

# %% [markdown]
# ## Three lights
#
# An image under lights $i$ of colour $c_i$ and geometry $\theta_i$ is $I = \sum_i c_i\,
# B_i(\theta_i)$: linear in the colours. So the colours are never searched. For any geometry
# the best are the solution of a small linear system, and Levenberg-Marquardt searches
# the geometry alone:
#
# $$\min_\theta \big\lVert \sum_i c_i^\star(\theta)\, B_i(\theta_i) - I_{ref} \big\rVert^2,
# \qquad
# c^\star(\theta) = \arg\min_c \big\lVert \sum_i c_i B_i(\theta_i) - I_{ref} \big\rVert^2.$$

# %%
white = jnp.ones(3)
truth = [
    DirectionalLight([0.4, -1.0, -0.6], [0.5, 0.45, 0.35]),
    PointLight([-0.8, 1.2, -2.0], [0.2, 0.4, 0.9]),
    SpotLight([1.2, 2.2, -2.2], [-0.4, -1.0, -0.5], [2.5, 1.6, 0.8], 0.2, 0.5),
]
start = [
    DirectionalLight([0.1, -1.0, -0.9], white),
    PointLight([-0.5, 1.5, -2.4], white),
    SpotLight([1.0, 2.5, -2.0], [-0.2, -1.0, -0.6], white, 0.3, 0.7),
]
reference = relight.render(gbuffer, camera, truth)
fitted = fit.lights(reference, gbuffer, camera, start, progress=False)
show(
    reference=reference,
    start=0.3 * relight.render(gbuffer, camera, start),
    fitted=fitted.image,
)

# %%
for fitted_light, true_light in zip(fitted.lights, truth, strict=True):
    print(type(fitted_light).__name__)
    for name, value in vars(true_light).items():
        if value is None:  # Neither has a size.
            continue
        found, wanted = (np.asarray(x, float) for x in (getattr(fitted_light, name), value))
        if name == "direction":
            wanted = wanted / np.linalg.norm(wanted)
        print(f"  {name:12} {np.round(found, 3)!s:24} of {np.round(wanted, 3)}")
print(f"{len(fitted.losses)} losses, from {fitted.losses[0]:.1e} to {fitted.losses[-1]:.1e}")

# %% [markdown]
# Some lights can't be told apart, whatever the search does. On a wall that is matt and flat,
# every sun is the same as every other, and as the sky. `indistinct` names such groups: lights
# whose parameters can change together without the image changing. Such a fit is no success,
# and raises unless `throw=False`; `doubt` says why.

# %%
suns = [truth[0], AmbientLight(white), truth[0]]
photograph_of_suns = relight.render(gbuffer, camera, suns)
ambiguous = fit.lights(
    photograph_of_suns, gbuffer, camera, suns, parameters=("color",), throw=False
)
print(ambiguous.indistinct, ambiguous.doubt)

# %% [markdown]
# ## A sun by its shadow
#
# A photograph with hard shadows. Where is the sun? The answer lies in the shadows' edges, and
# a hard shadow has no derivative: whether a point is lit is a step. First the plainest case,
# boxes seen straight from above. All that is seen is level, so nothing but the shadows tells.


# %%
class View(NamedTuple):
    """A scene and what a camera sees of it; `middle` is where the things are."""

    world: scene.Scene
    gbuffer: GBuffer
    camera: PinholeCamera | OrthographicCamera
    middle: tuple[float, float, float]


def sun_camera(direction, middle, scale, size):
    """The view along the sun's rays."""
    ahead, middle = direction / jnp.linalg.norm(direction), jnp.array(middle)
    pose = PinholeCamera.look_at(
        middle - 9 * ahead, middle, up=[0, 1, 0], fov_y=1.0, height=size, width=size
    ).world_from_camera
    return OrthographicCamera(scale, jnp.array([size / 2, size / 2]), pose)


def hard(view, direction, size=512, scale=100.0):
    """The shadow by a fine map and a comparison."""
    light_camera = sun_camera(direction, view.middle, scale, size)
    depths = scene.depth(view.world, light_camera, height=size, width=size)
    places = shadow.receivers(view.gbuffer.depth, view.camera, light_camera)
    return shadow.hard(depths, places, bias=0.01, slope_bias=1.0)


def soft(view, direction, scale, size=256):
    """The shadow whose texels move with the light, as wide as nine of them."""
    light_camera = sun_camera(direction, view.middle, scale, size)
    depths = scene.depth(view.world, light_camera, height=size, width=size)
    return shadow.MovingShadow(
        depths, light_camera, view.gbuffer, view.camera, softness=1 / scale
    )


def photograph(view, sun):
    """Under a sky and a sun with hard shadows."""
    dim, visible = AmbientLight([0.12, 0.15, 0.2]), hard(view, sun.direction, size=1024)
    return relight.shade(view.gbuffer, view.camera, dim) + relight.shade(
        view.gbuffer, view.camera, sun, visible
    )


corners = [
    [[-4, -0.2, -4], [4, 0, 4]],
    [[-0.1, 0, -0.1], [0.1, 1.4, 0.1]],
    [[-1.2, 0, 0.3], [-0.7, 0.5, 1.0]],
    [[0.6, 0, -1.1], [1.3, 0.3, -0.9]],
]
boxes = [trimesh.creation.box(bounds=box_corners) for box_corners in corners]
boxes = scene.from_trimesh(trimesh.util.concatenate(boxes))
down = np.array([[1.0, 0, 0, 0], [0, 0, -1, 5], [0, 1, 0, 0], [0, 0, 0, 1]])
above = OrthographicCamera(16.0, jnp.array([48.0, 36.0]), down)
table = View(boxes, scene.gbuffer(boxes, above, **SIZE), above, (0.0, 0.3, 0.0))

sun = DirectionalLight([0.75, -1.0, -0.55], [1.0, 0.9, 0.7])
target = photograph(table, sun)
wide, narrow = (soft(table, sun.direction, scale)(sun) for scale in (10.0, 40.0))
show(
    photograph=target,
    soft_at_10_texels_a_unit=jnp.tile(wide[..., None], (1, 1, 3)),
    soft_at_40_texels_a_unit=jnp.tile(narrow[..., None], (1, 1, 3)),
)

# %% [markdown]
# The loss as the sun turns about the vertical, the best colours taken at each angle. From
# afar all look alike, and flatten where shadows no longer meet. Looked at closely, the hard
# shadow's is a staircase: pixels switch, and between two switches the slope is 0, which is
# all that a gradient sees. The soft shadow's has a slope, and the right one.


# %%
def turned(angle):
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return jnp.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ sun.direction


def loss(angle, visibility):
    lights = [AmbientLight(white), DirectionalLight(turned(angle), white)]
    parts = [
        relight.shade(table.gbuffer, table.camera, light, visible)
        for light, visible in zip(lights, (None, visibility), strict=True)
    ]
    matrix = np.stack(parts, axis=-1).reshape(-1, 3, 2).astype(float)
    right = np.asarray(target, float).reshape(-1, 3)
    residuals = [
        right[:, c] - matrix[:, c] @ np.linalg.lstsq(matrix[:, c], right[:, c])[0]
        for c in range(3)
    ]
    return np.mean(np.square(residuals))


def plot(axis, angles, **kinds):
    for name, visible in kinds.items():
        losses = [loss(angle, visible(angle)) for angle in angles]
        axis.plot(angles, losses, ".-", label=name.replace("_", " "))
    axis.set(xlabel="degrees off the sun", ylabel="mean squared residual")
    axis.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
    axis.legend()


def sun_at(angle):
    return DirectionalLight(turned(angle), white)


_, (far, near) = plt.subplots(1, 2, figsize=(12, 3.8), layout="constrained")
plot(
    far,
    np.linspace(-40, 40, 17),
    hard=lambda angle: hard(table, turned(angle)),
    soft_at_10=lambda angle: soft(table, turned(angle), 10.0)(sun_at(angle)),
    soft_at_40=lambda angle: soft(table, turned(angle), 40.0)(sun_at(angle)),
)
soft_by_one_map = soft(table, turned(2.0), 40.0)
plot(
    near,
    np.linspace(1.85, 2.15, 21),
    hard=lambda angle: hard(table, turned(angle)),
    soft_at_40_map_made_once=lambda angle: soft_by_one_map(sun_at(angle)),
)
plt.show()

# %% [markdown]
# So the search begins with a coarse map, whose kernel is as wide as the shadow is wrong, and
# renders a finer one from where it got to, round by round. Within a round the map stays, but
# its texels do not: each is a point of an occluder in the world, and moves its shadow with
# the light. Here is the room again, under a sun that starts 17 degrees off.

# %%
scales = (10.0, 20.0, 40.0)
still = View(room, gbuffer, camera, (0.0, 0.5, -3.0))
target = photograph(still, sun)
tilt = jnp.array([[0.966, 0.259, 0], [-0.259, 0.966, 0], [0, 0, 1]])
wrong = DirectionalLight(tilt @ turned(8.0), sun.color)


def degrees_off(light):
    direction, true_direction = (
        x.direction / jnp.linalg.norm(x.direction) for x in (light, sun)
    )
    return float(jnp.degrees(jnp.arccos(direction @ true_direction)))


def shadows(lights, index):
    print(f"round {index}: {degrees_off(lights[1]):.2f} degrees off")
    return None, soft(still, lights[1].direction, scales[index])


fitted = fit.lights(
    target,
    gbuffer,
    camera,
    [AmbientLight(white), wrong],
    visibilities=shadows,
    rounds=len(scales),
    loss="squares",
    progress=False,
)
print(f"in the end: {degrees_off(fitted.lights[1]):.2f} degrees off")
show(photograph=target, start=photograph(still, wrong), fitted=fitted.image)

# %% [markdown]
# ## What it can't do
#
# - Find a minimum far away: every search here is local. A sun 40 degrees off, or a light that
#   starts where it lights nothing, stays lost.
# - See an occluder that its light did not see: the first of two things behind one another
#   hides the second until the map is rendered again.
# - Know how many lights there are, or that a colour can't be negative: it takes what it is
#   given and says in `indistinct` and `standard_errors` what the image could not tell.
