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
# # Relighting from a deep frame buffer
#
# What no light changes is kept for every pixel: reflectances, normal, depth, roughness, the
# shader. A change of light shades those again. The cost follows the image's size, not the
# scene's.

# %%
import statistics
import sys
import time
from io import BytesIO
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Image as StoredImage, display
from matplotlib_inline.backend_inline import set_matplotlib_formats
from PIL import Image

from jaxfx import (
    AmbientLight,
    DirectionalLight,
    EnvironmentLight,
    GBuffer,
    PinholeCamera,
    PointLight,
    SphericalHarmonicsLight,
    SpotLight,
    io,
    metrics,
    relight,
    scene,
)


# The scenes that the benchmarks use, whichever folder this runs in.
root = next(p for p in (Path.cwd(), *Path.cwd().parents) if (p / "benchmarks").is_dir())
sys.path.append(str(root))
from benchmarks.scenes import relight as relight_scenes


set_matplotlib_formats("jpeg", pil_kwargs={"quality": 80})
plt.rcParams |= {"figure.dpi": 80, "font.size": 9, "axes.grid": True, "grid.alpha": 0.3}
show = lambda image: np.asarray(io.srgb_from_linear(np.clip(np.asarray(image), 0, 1)))


def show_titled(titled, columns, width=10):
    rows = -(-len(titled) // columns)
    _, axes = plt.subplots(
        rows, columns, figsize=(width, width / columns * rows * 0.86), layout="constrained"
    )
    for ax in np.ravel(axes):
        ax.set_axis_off()
    for ax, (title, image) in zip(np.ravel(axes), titled.items(), strict=False):
        flat = np.ndim(image) == 2
        ax.imshow(image if flat else show(image), cmap="viridis" if flat else None)
        ax.set_title(title)
    plt.show()


mesh = scene.still_life()
SIZE = {"height": 240, "width": 320}
camera = scene.default_camera(mesh, **SIZE)
gbuffer = scene.gbuffer(mesh, camera, **SIZE)
show_titled(
    {
        "color": gbuffer.color,
        "shader": gbuffer.shader,
        "ambient": gbuffer.ambient,
        "diffuse": gbuffer.diffuse,
        "specular, 10 times": 10 * gbuffer.specular,
        "normal": (gbuffer.normal + 1) / 2,
        "1 / depth": 1 / gbuffer.depth,
        "roughness": gbuffer.roughness,
    },
    4,
)

# %% [markdown]
# ## One light of many
#
# A pixel is $\sum_k E_k\,(\rho_d \max(N\cdot L_k, 0) + \rho_s h_k)$. The state keeps the two
# sums over $k$, without the reflectances $\rho$. So an edit takes out what the old light
# brought and puts in the new, and a change of reflectance touches no light.

# %%
lights = [*scene.default_lights(camera), PointLight([0.5, 1.2, -1.5], [1.5, 0.6, 0.3])]
state = relight.start(gbuffer, camera, lights)
moved = state.edit(3, PointLight([-0.6, 1.3, -2.5], [0.4, 1.0, 2.5]))
floor = (scene.material_ids(mesh, camera, **SIZE) == 0) & (gbuffer.shader >= 0)
show_titled(
    {
        "four lights": state.image,
        "one of them edited": moved.image,
        "without the key light": moved.remove(0).image,
        "and one material painted": moved.paint(floor, color=np.array([0.1, 0.5, 0.3])).image,
    },
    4,
)

# %% [markdown]
# Ten thousand edits in turn of two lights, one a million times as bright as the other, in
# float32. A plain sum would keep what it lost each time.

# %%
faint, glaring = PointLight([0, 1, -1], [1, 1, 1]), PointLight([0, 1, -1], [1e6, 1e6, 1e6])
small = jax.tree.map(lambda image: image[::16, ::16], gbuffer)
small_camera = scene.default_camera(mesh, height=15, width=20)


@jax.jit
def chain(state, plain):
    def step(carry, _):
        state, plain = carry
        for old, new in ((faint, glaring), (glaring, faint)):
            state = state.edit(0, new)
            plain = plain - relight.shade(small, small_camera, old)
            plain = plain + relight.shade(small, small_camera, new)
        return (state, plain), None

    (state, plain), _ = jax.lax.scan(step, (state, plain), None, length=5_000)
    return state.image, plain


other = PointLight([0.3, 1.5, -2], [2, 2, 2])
kept = relight.start(small, small_camera, [faint, other])
fresh = relight.render(small, small_camera, [faint, other])
kept_image, plain_image = chain(kept, fresh)
for name, image in (("kept", kept_image), ("plain", plain_image)):
    print(f"{name:6} off by {float(jnp.max(jnp.abs(image - fresh)) / jnp.max(fresh)):.1e}")

# %% [markdown]
# ## A light on sliders, of every kind
#
# 640 x 480, every surface shaded by GGX, which costs most. While a light is on sliders the
# state without it is kept: to add the light again is the cost of one. The times are from a
# slider's value to the bytes of the image.

# %%
import ipywidgets as widgets


large, large_camera = relight_scenes.cache_of((480, 640), "GGX")
rest = relight.start(large, large_camera, scene.default_lights(large_camera)[1:])
curve = lambda image: jnp.where(
    image <= 0.0031308,
    12.92 * image,
    1.055 * jnp.exp(jnp.log(jnp.clip(image, 0.0031308, 1)) / 2.4) - 0.055,
)


@jax.jit
def bytes_under(rest, light):
    """The image with the light added, in sRGB: one program, which keeps no other state."""
    return jnp.round(255 * curve(rest.add(light).image)).astype(jnp.uint8)


def jpeg_under(light):
    """The image with the light added, as JPEG."""
    stream = BytesIO()
    pixels = np.asarray(bytes_under(rest, light))
    Image.fromarray(pixels).save(stream, "JPEG", quality=85)
    return stream.getvalue()


numbers = lambda *values: np.array(values, np.float32)
warm = lambda strength: strength * numbers(1.0, 0.85, 0.6)
turned = lambda degrees: relight_scenes.about_y(degrees).astype(np.float32)
surroundings = EnvironmentLight(0.3 * relight_scenes.surroundings())


def sky(above, left):
    """Soft light, more of it from above or from the left."""
    coefficients = np.zeros((9, 3), np.float32)
    coefficients[[0, 1, 3]] = numbers(1, above, -left)[:, None] * numbers(0.7, 0.85, 1)
    return SphericalHarmonicsLight(coefficients)


# Of each kind: the light of some numbers, and of each number its name, value and range.
KINDS = {
    "ambient": (lambda s: AmbientLight(warm(s)), {"strength": (0.2, 0, 1)}),
    "sun": (
        lambda x, s: DirectionalLight(numbers(x, -1, -0.5), warm(s)),
        {"to the right": (0.5, -1.5, 1.5), "strength": (1.0, 0, 3)},
    ),
    "lamp": (
        lambda x, y, z, s: PointLight(numbers(x, y, z), warm(s)),
        {
            "x": (0.3, -1.5, 1.5),
            "y": (1.1, 0.2, 2),
            "z": (-1.8, -3.5, -0.5),
            "strength": (2.0, 0, 6),
        },
    ),
    "spot": (
        lambda x, angle: SpotLight(
            numbers(x, 1.6, -1), numbers(-x / 2, -1, -0.7), warm(6), 0.6 * angle, angle
        ),
        {"x": (0.3, -1.5, 1.5), "angle": (0.5, 0.1, 1.2)},
    ),
    "sky": (sky, {"above": (0.5, -1, 1), "left": (0.0, -1, 1)}),
    "surroundings": (lambda a: surroundings.turned(turned(a)), {"degrees": (0, -180, 180)}),
}


def panel(make, ranges):
    """Sliders over an image that follows them."""
    view = widgets.Image(format="jpeg")
    sliders = [
        widgets.FloatSlider(value, min=low, max=high, step=(high - low) / 60, description=name)
        for name, (value, low, high) in ranges.items()
    ]

    def answer(_=None):
        view.value = jpeg_under(make(*(np.float32(slider.value) for slider in sliders)))

    for slider in sliders:
        slider.observe(answer, "value")
    answer()
    return view, sliders


panels = {kind: panel(*what) for kind, what in KINDS.items()}
for kind, (_, sliders) in panels.items():
    times = []
    for value in np.linspace(sliders[0].min, sliders[0].max, 32)[1:]:
        started = time.perf_counter()
        sliders[0].value = float(value)
        times.append(1e3 * (time.perf_counter() - started))
    median = statistics.median(times)
    print(f"{kind:12} {median:3.0f} ms from slider to picture, {min(times):3.0f} at least")
middles = {
    kind: make(*(v[0] for v in ranges.values())) for kind, (make, ranges) in KINDS.items()
}
show_titled({kind: rest.add(light).image for kind, light in middles.items()}, 3)
tabs = [widgets.VBox([view, *sliders]) for view, sliders in panels.values()]
widgets.Tab(tabs, titles=list(panels))

# %% [markdown]
# ## New views
#
# A pixel of the new view and its depth are a point of the world; each cache that sees it, by
# depth, normal and shader, is read; their mean is the new cache. What no cache sees is a
# hole.

# %%
target, depth, gbuffers, cameras = relight_scenes.new_view((240, 320), 4)
new_gbuffer, views = relight.synthesize(gbuffers, cameras, target, depth=depth)
filled, count = relight.fill_holes(new_gbuffer, views)
truth = scene.gbuffer(mesh, target, **SIZE)
lights = scene.default_lights(target)
image, filled_image, true_image = (
    relight.render(shaded, target, lights) for shaded in (new_gbuffer, filled, truth)
)
show_titled(
    {
        "how many caches see it": views,
        f"{int(count)} pixels of holes": image,
        f"filled: {float(metrics.psnr(filled_image, true_image)):.1f} dB": filled_image,
        "its error, 4 times": 4 * jnp.abs(filled_image - true_image),
    },
    4,
)

# %% [markdown]
# Against the new view's own cache, by the angle to the nearest cache and their number. Caches
# are read at the nearest pixel, which is off by up to half of one in each. Weights by detail
# change little where the caches are alike, and help where some of them stand farther off.

# %%
look = mesh.viewpoint
small_size = {"height": 120, "width": 160}


def orbit(degrees, rise=0.0, away=1.0):
    angle = np.radians(degrees)
    turn = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    offset = away * (turn @ (np.array(look.eye) - look.at))
    eye = np.array(look.at) + offset + [0, rise, 0]
    return PinholeCamera.look_at(eye, look.at, up=[0, 1, 0], fov_y=look.fov, **small_size)


stations = {
    "alike": [
        (0, 0),
        (-8, 0.1),
        (0, 0.3),
        (-4, -0.2),
        (-12, 0.3),
        (-16, 0),
        (4, 0.2),
        (2, -0.2),
    ],
    "near and far": [(0, 0), (4, 0, 1.6), (-4, 0.1, 1.6), (2, 0.2, 2.2)],
}
angles = [5, 15, 30]
targets = [orbit(degrees, 0.05) for degrees in angles]
truths = [scene.gbuffer(mesh, target, **small_size) for target in targets]


def scores(gbuffers, cameras, weighting="equal"):
    """PSNR of the relit image and the share of the view that is seen, at each angle."""
    for target, truth in zip(targets, truths, strict=True):
        new_gbuffer, views = relight.synthesize(
            gbuffers, cameras, target, depth=truth.depth, weighting=weighting
        )
        filled, _ = relight.fill_holes(new_gbuffer, views)
        lights = scene.default_lights(target)
        pair = (relight.render(shaded, target, lights) for shaded in (filled, truth))
        seen_share = jnp.mean(views > 0) / jnp.mean(truth.shader >= 0)
        yield float(metrics.psnr(*pair)), float(seen_share)


figure, axes = plt.subplots(1, 3, figsize=(10, 3), layout="constrained", sharex=True)
for name, places in stations.items():
    cameras = [orbit(*place) for place in places]
    gbuffers = [scene.gbuffer(mesh, camera, **small_size) for camera in cameras]
    for number in (1, 4, 8) if name == "alike" else ():
        score, seen_share = zip(*scores(gbuffers[:number], cameras[:number]), strict=True)
        axes[0].plot(angles, score, ".-", label=f"{number}")
        axes[1].plot(angles, seen_share, ".-", label=f"{number}")
    for weighting, style in (("equal", ".-"), ("detail", "x:")):
        score, _ = zip(*scores(gbuffers[:4], cameras[:4], weighting), strict=True)
        color = "C2" if name == "alike" else "C4"
        axes[2].plot(angles, score, style, color=color, label=f"{name}, {weighting}")
axes[0].set(xlabel="degrees from the nearest cache", ylabel="PSNR of the relit picture, dB")
axes[1].set(xlabel="degrees from the nearest cache", ylabel="share of the view that is seen")
axes[2].set(xlabel="degrees from the nearest cache", ylabel="PSNR from 4 caches, dB")
axes[0].legend(title="caches")
axes[2].legend()
plt.show()

# %% [markdown]
# ## Why caches are not antialiased
#
# The mean of two surfaces' normals and depths is a third surface, between them. Sixteen samples
# per pixel, averaged after shading and before:

# %%
FINE = 4
fine_size = {name: FINE * side for name, side in small_size.items()}
fine_camera = scene.default_camera(mesh, **fine_size)
fine = scene.gbuffer(mesh, fine_camera, **fine_size)
coarse_camera = scene.default_camera(mesh, **small_size)
lights = scene.default_lights(coarse_camera)


def shrunk(image):
    rows, columns = (side // FINE for side in image.shape[:2])
    return jnp.mean(image.reshape(rows, FINE, columns, FINE, *image.shape[2:]), axis=(1, 3))


middle = lambda image: image[FINE // 2 :: FINE, FINE // 2 :: FINE]
depth = jnp.where(jnp.isfinite(fine.depth), fine.depth, 20.0)
averaged = {
    name: shrunk(depth if name == "depth" else getattr(fine, name))
    for name in ("color", "ambient", "diffuse", "specular", "normal", "depth", "roughness")
}
antialiased = GBuffer(shader=middle(fine.shader), **averaged)
supersampled = shrunk(relight.render(fine, fine_camera, lights))
averaged_first = relight.render(antialiased, coarse_camera, lights)
one_sample = relight.render(
    scene.gbuffer(mesh, coarse_camera, **small_size), coarse_camera, lights
)
ids = scene.object_ids(mesh, fine_camera, **fine_size).reshape(120, FINE, 160, FINE)
edges = jnp.max(ids, axis=(1, 3)) != jnp.min(ids, axis=(1, 3))
score = lambda image: float(metrics.psnr(image, supersampled, mask=edges))
show_titled(
    {
        "shaded, then averaged": supersampled,
        f"averaged first: {score(averaged_first):.1f} dB at edges": averaged_first,
        f"one sample: {score(one_sample):.1f} dB at edges": one_sample,
        "averaging first: 4 times the error": 4 * jnp.abs(averaged_first - supersampled),
    },
    4,
)

# %% [markdown]
# ## Against a path tracer
#
# Mitsuba's direct light on the same meshes, every surface Lambert, under a directional, a point
# and a spot light; one ray through each pixel's centre. But for pixels whose centre lies on an
# edge the two are the same to rounding; unfiltered shadow maps miss the rims of shadows by
# their texels. `python -m benchmarks.relight_charts --out docs` makes this image and
# the next chart.

# %%
display(StoredImage(root / "docs/relight_truth.png"))

# %% [markdown]
# ## One bounce
#
# Points of the mesh send on what falls on them. How much of it gets to each pixel does not
# depend on the lights:
# $T_{ij} = V_{ij} \cos\theta_i \cos\theta_j\, A_j / (\pi r_{ij}^2 + A_j)$. Its rank is low,
# $T \approx U S$. An edit of a light shades the points, and costs a product,
# $\rho_d\, U\,(S\,(\rho \odot E))$.

# %%
bounce_size = {"height": 60, "width": 80}
bounce_camera = scene.default_camera(mesh, **bounce_size)
bounce_cache = scene.gbuffer(mesh, bounce_camera, **bounce_size)
started = time.perf_counter()
transfer = scene.transfer(mesh, bounce_cache, bounce_camera, point_count=256, rank=64)
print(f"{time.perf_counter() - started:.0f} s to build, once for all lights")
lamp = PointLight([0.5, 1.4, -1.5], [2.0, 1.8, 1.5])
shown = jnp.isfinite(bounce_cache.depth)
positions = bounce_camera.points(jnp.where(shown, bounce_cache.depth, 1))
reached = lambda points: scene.visible(mesh, points, lamp.position)
straight = relight.shade(bounce_cache, bounce_camera, lamp, reached(positions))
lit = [reached(transfer.position)]
bounced = relight.indirect(bounce_cache, transfer, [lamp], visibilities=lit)
show_titled(
    {
        "direct": straight,
        "one bounce, 3 times": 3 * bounced,
        "both": straight + bounced,
    },
    3,
)
display(StoredImage(root / "docs/relight_bounce.png"))

# %% [markdown]
# Against Mitsuba's paths of one bounce: the number of points decides the error, about one over
# its square root, unless the rank is too small: 64 will do for a thousand points.

# %% [markdown]
# ## Against rendering again
#
# The same image from the mesh: Embree finds what each pixel shows, and one shadow ray goes to
# each light. The ratio grows with the lights, for an edit does not know how many there are.


# %%
def median(function, rounds, warm=True):
    if warm:
        jax.block_until_ready(function())
    times = []
    for _ in range(rounds):
        started = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - started)
    return statistics.median(times)


counts = (1, 10, 100)
figure, ax = plt.subplots(figsize=(6, 3), layout="constrained")
for side in (120, 240, 480):
    size = (side, side * 4 // 3)
    cached, at = relight_scenes.cache(size)
    ratios = []
    for number in counts:
        lights = relight_scenes.lights(number)
        lit = [jnp.ones(size, jnp.float32)] * number
        state = relight.start(cached, at, lights, visibilities=lit)
        edit = median(lambda s=state, o=lights[0], v=lit[0]: s.edit(0, o, v).image, 5)
        from_mesh = lambda o=lights, c=at, s=size: relight_scenes.rendered_anew(mesh, c, o, s)
        ratios.append(median(from_mesh, 1, warm=number == 1) / edit)
    ax.loglog(counts, ratios, ".-", label=f"{size[1]} x {size[0]}")
ax.axhline(100, color="0.5", linestyle=":")
ax.set(xlabel="lights with shadows", ylabel="times as fast")
ax.legend()
plt.show()

# %% [markdown]
# ## What it cannot do
#
# - Reflections and refractions: a pixel knows one surface. Of the light that comes from
#   another surface, one diffuse bounce; it is coarse where surfaces nearly touch.
# - Shadows of its own: `visibility` is the caller's, of `jaxfx.shadow` say.
# - Transparency, motion blur, defocus: a cache is not antialiased. Take it finer, shade, then
#   average.
# - Texture finer than a cache's pixels in a new view, and what no cache saw there: holes are
#   filled with their neighbours.
# - Two surfaces nearer than the tolerance, of one shader and one normal, can blend in a new
#   view where no cache fits better than another.
