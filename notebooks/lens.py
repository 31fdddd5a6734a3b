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
# # The look of a lens
#
# A sharp picture, how far away things are, and a lens: out comes the photograph that the lens
# would have taken. What photographers choose a lens for is in it: how lamps out of focus are
# drawn, hair against the light, and what the focus ring tells.
#
# The model stands 1.6 m away with the city behind her, 20 m away. Hair is thinner than a pixel:
# each pixel has a colour, and an alpha that says how much of it is hair. Lamps are up to 50
# times as bright as white paper, as they are at night; a photograph that is clipped at white
# has to be given that back.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib_inline.backend_inline import set_matplotlib_formats
from PIL import Image, ImageDraw

from jaxfx import PinholeCamera, ThinLens, dof, fit, io, metrics


plt.rcParams["figure.dpi"] = 100
set_matplotlib_formats("jpeg", pil_kwargs={"quality": 88})
# Of all pictures, in pixels; by how much planes are wider on each side; fine rows of a pixel.
BORDER, FINE = 16, 4
LAMPS = np.array(
    [[1, 0.62, 0.25], [1, 0.8, 0.5], [0.9, 0.95, 1], [1, 0.25, 0.12], [0.25, 1, 0.6]]
)


def city(rng, height, width, lamps, spread):
    """Dusk over houses with windows, and lamps up to 50 times white; height width 3."""
    height, width = height + 2 * BORDER, width + 2 * BORDER
    y, x = np.mgrid[:height, :width]
    glow = np.exp(-(((y / height - 0.62) / 0.16) ** 2))[..., None]
    image = np.array([0.012, 0.02, 0.06]) + np.array([0.10, 0.04, 0.03]) * glow
    left = 0
    while left < width:
        wide, top = int(rng.integers(18, 34)), int(height * rng.uniform(0.25, 0.58))
        image[top:, left : left + wide] = rng.uniform(0.004, 0.014) * np.array([1, 1.1, 1.4])
        for row in range(top + 4, height - 6, 7):
            for column in range(left + 3, left + wide - 4, 6):
                if rng.random() < 0.22:
                    window = rng.uniform(0.1, 0.5) * np.array([1.0, 0.65, 0.3])
                    image[row : row + 3, column : column + 3] = window
        left += wide + int(rng.integers(0, 8))
    down = np.clip(rng.normal(0.6, spread, lamps), 0.02, 0.98) * height
    for row, column in zip(down, rng.uniform(0, width, lamps), strict=True):
        spot = np.exp(-((y - row) ** 2 + (x - column) ** 2) / 2)[..., None]
        hue = LAMPS[rng.choice(5, p=[0.4, 0.25, 0.13, 0.14, 0.08])]
        image = image + 50 * rng.uniform(0.08, 1) ** 1.5 * spot * hue
    return image.astype(np.float32)


def model(rng, height, width):
    """A person from behind against the light: colours, and how opaque each pixel is."""
    tall, wide = height * FINE, width * FINE
    paper, ink = Image.new("RGB", (wide, tall)), Image.new("L", (wide, tall))
    draw, cover = ImageDraw.Draw(paper), ImageDraw.Draw(ink)
    middle, top, head = 0.5 * wide, 0.2 * tall, 0.145 * wide
    t = np.linspace(-1, 1, 200)
    ridge = tall * (0.74 + 0.17 * np.abs(t) ** 2.2 - 0.035 * np.exp(-((t / 0.25) ** 2)))
    shoulders = np.stack([middle + 0.46 * wide * t, ridge], axis=1)
    coat = [*map(tuple, shoulders), (wide, tall), (0, tall)]
    draw.polygon(coat, fill=(26, 24, 30))
    cover.polygon(coat, fill=255)
    for k in range(14):
        rim = tuple(int(c * (1 - k / 14) + 26) for c in (120, 80, 50))
        draw.line([(right, down + k) for right, down in shoulders], fill=rim, width=2)

    s = np.linspace(0, 1, 40)
    for strand in rng.permutation(4100):
        loose = strand < 300
        side = rng.uniform(-1, 1)
        side = np.sign(side) * rng.uniform(0.8, 1.15) if loose else side
        length = (0.58 + 0.07 * rng.normal()) * tall * (rng.uniform(0.5, 1) if loose else 1)
        fall = np.clip((s * length - head) / (0.5 * tall), 0, 1)
        # Over the round head, then down the back.
        reach = np.sqrt(1 - (1 - np.minimum(s * length / (1.15 * head), 1)) ** 2)
        full = reach * (1 + 0.55 * fall - 0.5 * fall**2)
        wave = np.sin(s * rng.uniform(8, 13) + rng.uniform(0, 6)) * (0.05 + 0.06 * loose)
        drift = rng.normal() * (0.05 + 0.3 * loose) + 0.25 * loose * rng.random()
        away = side * full + fall * (wave + drift) + 0.1 * loose * rng.random() * side * reach
        x, y = middle + head * away, top + s * length - loose * head * rng.uniform(0, 0.08)
        band = np.exp(-(((s * length / head - 0.75 - 0.25 * side**2) / 0.35) ** 2))
        edge = np.clip(np.abs(away) / (full + 1e-3), 0, 1)
        light = 0.06 + 0.3 * band * rng.random() + 1.5 * edge**7
        light = np.full_like(s, rng.uniform(0.7, 1.6)) if loose else light
        tint = np.array([0.5, 0.26, 0.12]) * rng.uniform(0.6, 1.4)
        color = 255 * io.srgb_from_linear(np.clip(light[:, None] * tint, 0, 1))
        for k in range(len(s) - 1):
            line = [(x[k], y[k]), (x[k + 1], y[k + 1])]
            draw.line(line, fill=tuple(color[k].astype(int)), width=1 if loose else 2)
            cover.line(line, fill=255, width=1 if loose else 2)

    mean = lambda x: x.reshape(height, FINE, width, FINE, -1).mean(axis=(1, 3))
    covered = np.asarray(ink)[..., None] / 255
    light, alpha = mean(io.linear_from_srgb(np.asarray(paper) / 255) * covered), mean(covered)
    color = np.where(alpha > 0, light / np.maximum(alpha, 1e-6), 0)
    return color.astype(np.float32), alpha[..., 0].astype(np.float32)


def show(pictures, width=12.0, scale=1):
    """Pictures in linear light beside one another, as a screen shows them."""
    shapes = [np.shape(picture) for picture in pictures.values()]
    total = sum(columns / rows for rows, columns, *_ in shapes)
    _, axes = plt.subplots(
        1,
        len(pictures),
        figsize=(width, width / total + 0.3),
        width_ratios=[columns / rows for rows, columns, *_ in shapes],
        layout="constrained",
        squeeze=False,
    )
    for axis, (title, picture) in zip(axes.flat, pictures.items(), strict=True):
        larger = np.kron(np.asarray(picture), np.ones((scale, scale, 1)))
        axis.imshow(io.srgb_from_linear(np.clip(larger, 0, 1)), interpolation="lanczos")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    plt.show()


inside = lambda plane: plane[BORDER:-BORDER, BORDER:-BORDER]
HEIGHT, WIDTH, MODEL, CITY, COC = 240, 200, 1.6, 20.0, 22.0
rng = np.random.default_rng(7)
street = city(rng, HEIGHT, WIDTH, lamps=70, spread=0.2)
woman, alpha = model(rng, HEIGHT, WIDTH)
sharp = alpha[..., None] * woman + (1 - alpha[..., None]) * inside(street)
show(
    {
        "the model": woman * alpha[..., None],
        "alpha": np.dstack([alpha] * 3),
        "all sharp": sharp,
    },
    8,
)

# %% [markdown]
# ## The iris draws the lamps
#
# A lamp out of focus is a picture of the opening in the lens. Six blades, nearly straight,
# make hexagons, blades that bend with the opening rounder ones, and an anamorphic lens, which
# squeezes the picture onto the film, ovals. `behind` is what the model hides, as an inpainting
# network or a second photograph without her has it.

# %%
plane = lambda distance: np.full((HEIGHT, WIDTH), distance, np.float32)


def opened(camera, focus):
    """A lens whose circles of confusion are `COC` pixels wide in the city."""
    lens = lambda aperture: ThinLens.from_camera(
        camera, aperture=aperture, focus_distance=focus
    )
    return lens(COC / float(lens(1.0).circle_of_confusion(CITY)))


camera = PinholeCamera.from_fov(0.6, height=HEIGHT, width=WIDTH)
lens = opened(camera, MODEL)


def through(iris, city, alpha):
    behind = city, plane(CITY)
    options = {"behind": behind, "alpha": alpha, "iris": iris, "max_coc": COC + 0.01}
    return dof.layered(woman, plane(MODEL), lens, **options)


irises = {
    "wide open": dof.Iris(6, roundness=1.0),
    "six blades": dof.Iris(6, rotation=0.2, roundness=0.02),
    "rounded blades": dof.Iris(6, rotation=0.2, roundness=0.6),
    "anamorphic": dof.Iris(6, roundness=1.0, squeeze=0.5),
}
seen = {name: through(iris, inside(street), alpha) for name, iris in irises.items()}
show(seen, 14)

# One lamp of 50 times white in the dark, and nobody before it.
lamp = np.zeros_like(woman)
lamp[HEIGHT // 2, WIDTH // 2] = 50
print("light of the picture of a lamp over that of the lamp, and its brightness:")
for name, iris in irises.items():
    disc = np.asarray(through(iris, lamp, np.zeros_like(alpha)), np.float64)[..., 0]
    print(f"{name:16} {disc.sum() / 50:.4f} {np.median(disc[disc > 0.02]):6.3f}")

# %% [markdown]
# No light is lost or made. A smaller opening draws smaller and brighter discs of the same lamp,
# since it is the same light: a photographer who stops down exposes longer.
#
# ## Hair against the light
#
# On the left what a portrait mode does with a mask that says yes or no. Lamps stick to the hair
# that the mask took along, and hair that it did not take is smeared over the city. In the
# middle the same call with `alpha`. On the right the truth: the mean of 512 pictures from
# points all over the lens, which knows nothing of sprites.

# %%


def read(plane, eye, distance):
    """A plane across the axis, moved by parts of a pixel, as a camera on the lens sees it."""
    height, width = (n - 2 * BORDER for n in plane.shape[:2])
    axis = jnp.asarray([width / 2, height / 2])
    view = eye_at_rest(height, width)
    moved = view.project(eye.unproject(axis, jnp.asarray(distance))).pixels - axis + BORDER
    whole = jnp.floor(moved)
    right, down = moved - whole
    column, row = whole.astype(int)
    part = height + 1, width + 1, plane.shape[2]
    near = jax.lax.dynamic_slice(plane, (row, column, 0), part)
    near = (1 - right) * near[:, :-1] + right * near[:, 1:]
    return (1 - down) * near[:-1] + down * near[1:]


def eye_at_rest(height, width):
    return PinholeCamera.from_fov(0.6, height=height, width=width)


over = np.dstack([woman * alpha[..., None], alpha])
over = np.pad(over, [(BORDER, BORDER)] * 2 + [(0, 0)], mode="edge")


@jax.jit
def pinhole(eye):
    front = read(jnp.asarray(over), eye, MODEL)
    return front[..., :3] + (1 - front[..., 3:]) * read(jnp.asarray(street), eye, CITY)


truth = dof.accumulate(pinhole, camera, lens, samples=512, jitter=False).image
mask = np.where(alpha > 0.5, MODEL, CITY).astype(np.float32)
results = {
    "yes or no": dof.layered(sharp, mask, lens, max_coc=COC + 0.01),
    "alpha": seen["wide open"],
    "512 passes": truth,
}
show(results, 10)
show({name: picture[56:184, 40:100] for name, picture in results.items()}, 10, scale=4)
# A pixel's neighbourhood counts if hair is in it.
soft = (alpha > 0.02) & (alpha < 0.98)
shown = lambda picture: jnp.clip(picture, 0, 1)
for name in ("yes or no", "alpha"):
    off = metrics.psnr(shown(results[name]), shown(truth), mask=jnp.asarray(soft))
    print(f"{name:10} {float(off):.1f} dB where there is hair")

# %% [markdown]
# ## Cat's eyes
#
# Towards the corners the rim of a fast lens cuts the opening, and discs turn into cat's eyes
# that seem to swirl about the middle. `vignetting` is how far the rim has moved at the corner,
# in radii of the opening. On the left the truth from 1024 passes, of which each pixel counts
# those that it sees past the rim, on the right the effect. `margin` says that the image is
# wider than what is wanted, so that lamps beyond the frame are drawn too.

# %%
HEIGHT, WIDTH = 144, 216
night = city(np.random.default_rng(3), HEIGHT, WIDTH, lamps=110, spread=0.34)
camera = PinholeCamera.from_fov(0.6, height=HEIGHT, width=WIDTH)
lens = opened(camera, MODEL)


def at_night(iris):
    far = np.full(night.shape[:2], CITY, np.float32)
    return dof.layered(
        night, far, lens, behind=None, iris=iris, max_coc=COC + 0.01, margin=BORDER
    )


look = jax.jit(lambda eye: read(jnp.asarray(night), eye, CITY))
eyes = dof.Iris(vignetting=0.9)
truth = dof.accumulate(look, camera, lens, samples=1024, iris=eyes, jitter=False).image
result = at_night(eyes)
show({"1024 passes": truth, "jaxfx": result}, 14)
corner = slice(0, 72), slice(0, 108)
show(
    {"1024 passes, the corner": truth[corner], "jaxfx, the corner": result[corner]}, 14, scale=3
)
print(f"{float(metrics.psnr(shown(result), shown(truth))):.1f} dB on a screen")

# %% [markdown]
# ## Soap bubbles and cream
#
# A lens that is corrected too far has bright rims about its discs: soap bubbles, which some
# collect old lenses for. One that is corrected too little has discs that fade outwards, and a
# background that is calm. `profile` goes from the one to the other.

# %%
profiles = {"soap bubbles": -0.9, "even": 0.0, "creamy": 0.9}
part = slice(20, 124), slice(20, 160)
show(
    {name: at_night(dof.Iris(profile=value))[part] for name, value in profiles.items()},
    14,
    scale=2,
)

# %% [markdown]
# ## The focus ring as a ruler
#
# Five small photographs of two plates before a wall, the focus moved from near to far. From
# them `fit.focal_stack` makes the picture in which all is sharp, and a distance for each pixel.
# Where the photographs do not tell it, that is said. The guide to focal stacks
# (`focal_stack.ipynb`) has more of this.

# %%
HEIGHT, WIDTH = 64, 96
camera = eye_at_rest(HEIGHT, WIDTH)
rng = np.random.default_rng(11)


def mosaic(hue, middle, radius):
    """A disc of tiles of 3 pixels with alpha, wider by the border on each side."""
    height, width = HEIGHT + 2 * BORDER, WIDTH + 2 * BORDER
    tiles = np.asarray(hue) * rng.uniform(0.15, 1, (height // 3 + 1, width // 3 + 1, 1))
    y, x = np.mgrid[:height, :width] - BORDER
    away = np.hypot(x - middle[0], y - middle[1])
    alpha = np.clip(radius - away, 0, 1)[..., None]
    tiles = np.kron(tiles, np.ones((3, 3, 1)))[:height, :width]
    return np.concatenate([tiles * alpha, alpha], axis=-1).astype(np.float32)


plates = {
    1.4: mosaic([0.9, 0.35, 0.15], (32, 38), 20),
    2.4: mosaic([0.2, 0.7, 0.45], (64, 26), 19),
    6.0: mosaic([0.45, 0.5, 0.75], (48, 32), 1000),
}


@jax.jit
def table(eye):
    light, left = 0.0, 1.0
    for distance, plate in plates.items():
        seen = read(jnp.asarray(plate), eye, distance)
        light, left = light + left * seen[..., :3], left * (1 - seen[..., 3:])
    return light


foci = 1 / np.linspace(1 / 1.2, 1 / 8, 5)
lenses = [ThinLens.from_camera(camera, aperture=0.16, focus_distance=float(f)) for f in foci]
# 124 points spread as a disc does; most other counts lack some per cent.
photographs = {
    f"focus at {lens.focus_distance:.1f} m": dof.accumulate(
        table, camera, lens, samples=124, seed=48, jitter=False
    ).image
    for lens in lenses
}
show(photographs, 14)
options = {"min_depth": 1.0, "max_depth": 9.0, "max_steps": 0}
found = fit.focal_stack([*photographs.values()], lenses, **options)
told = np.asarray(found.determined)
true = np.select([inside(plate)[..., 3] > 0.5 for plate in plates.values()], list(plates))
heat = lambda distance: io.linear_from_srgb(plt.get_cmap("magma")(1.2 / distance)[..., :3])
distances = {
    "distance, found": np.where(told[..., None], heat(np.asarray(found.depth)), 0.25),
    "distance, true": heat(true),
}
show({"all in focus": found.image} | distances, 11)
off = np.abs(np.asarray(found.depth) / true - 1)[told]
print(f"{100 * told.mean():.0f} % of the pixels are told (the others are grey),")
print(f"their distance is {100 * np.median(off):.1f} % off in the median")

# %% [markdown]
# ## What none of these lenses can do
#
# - A matte says how much of a pixel is hair, not which part of the lens the hair leaves free:
#   where both the hair and what is behind it are blurred, colours are off by a few hundredths.
# - Without `behind` the city behind the model is guessed, and lamps that she hides are missing.
#   So are lamps beyond the frame without a `margin`.
# - A rim takes no light here: corners do not get darker. `Iris.open_share` is by how much they
#   would.
# - Lamps that a camera has clipped at white are pale when they spread: raise them first.
# - Longitudinal colour, astigmatism and coma, which colour and bend the discs of real lenses,
#   are not modelled.
