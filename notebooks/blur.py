# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Gaussian blur, and what becomes of an idea made for texture units
#
# A blur is a weighted mean of neighbours. `blur.gaussian` does it in two passes, one down the
# columns and one along the rows, of as many taps as one likes and as often as one likes.

# %%
import statistics
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from jaxfx import _sampling, blur, io, relight, scene


plt.rcParams.update({"figure.dpi": 80, "savefig.dpi": 80})


def show(images, columns=3, **options):
    rows = -(-len(images) // columns)
    size = (2.3 * columns, 2.5 * rows)
    _, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, (title, shown) in zip(axes.flat, images.items(), strict=False):
        ax.imshow(io.srgb_from_linear(np.clip(shown, 0, 1)), **options)
        ax.set_title(title)
    plt.show()


mesh = scene.still_life()
camera = scene.default_camera(mesh, height=256, width=256)
gbuffer = scene.gbuffer(mesh, camera, height=256, width=256)
image = relight.render(gbuffer, camera, scene.default_lights(camera))
show(
    {
        "the picture": image,
        "one pass of 9 taps": blur.gaussian(image),
        "nine passes": blur.gaussian(image, passes=9),
    }
)

# %% [markdown]
# ## Weights
#
# The binomial distribution tends to the normal one, so a row of Pascal's triangle serves as
# weights. Of row 12 the outer two on either side are less than a 256th and are dropped, and
# what is left is divided by **its own** sum, 4070:
#
# $$w = \frac{(66, 220, 495, 792, 924, 792, 495, 220, 66)}{4070}.$$
#
# Divided by the whole row's 4096, every pass would darken the image to
# $(4070/4096)^2 = 98.7\,\%$: nine passes to 89 %.

# %%
weights = np.asarray(blur.binomial_weights(9, row=12))
print("weights  ", weights.round(10))
darkened = image
for _ in range(9):
    darkened = blur.gaussian(darkened) * (4070 / 4096) ** 2
kept = blur.gaussian(image, passes=9)
print("mean of the picture, after nine passes, after nine that darken:")
print(*(f"{float(jnp.mean(x)):.4f}" for x in (image, kept, darkened)))

# %% [markdown]
# ## Sigma, to be fitted
#
# `sigma` is a parameter as any other: traced, with a derivative, in pixels and of all passes
# together. A number sets the taps too, 4 sigma to each side; a traced one can't, so that they
# are given. Here it is found again from a blurred image by Newton's method.

# %%
blurred = blur.gaussian(image, taps=15, sigma=1.7)


@jax.jit
def loss(sigma):
    return jnp.sum((blur.gaussian(image, taps=15, sigma=sigma) - blurred) ** 2)


sigma = jnp.float32(1.3)
for _ in range(5):
    sigma = sigma - jax.grad(loss)(sigma) / jax.grad(jax.grad(loss))(sigma)
    print(f"{float(sigma):.5f}", end="  ")

# %% [markdown]
# The tap count is static, and what given taps can't hold is dropped: 9 taps give a standard
# deviation of 2.58 pixels at the most, that of equal weights. More passes hold more.

# %%
asked = np.linspace(0, 6, 61)


def spread(sigma, taps, passes):
    reach = passes * (taps // 2)
    point = jnp.zeros((1, 2 * reach + 1, 1)).at[0, reach].set(1)
    line = blur.gaussian(point, taps=taps, passes=passes, sigma=sigma).ravel()
    return jnp.sqrt(jnp.sum(line * (jnp.arange(2 * reach + 1) - reach) ** 2))


plt.figure(figsize=(5.5, 3.4), layout="constrained")
plt.plot(asked, asked, color="0.8", linewidth=5, label="asked for")
for taps, passes in ((9, 1), (9, 4), (33, 1)):
    got = jax.vmap(lambda sigma, t=taps, p=passes: spread(sigma, t, p))(asked)
    plt.plot(asked, got, label=f"{taps} taps, {passes} pass{'es' * (passes > 1)}")
plt.xlabel("sigma asked for (pixels)")
plt.ylabel("standard deviation (pixels)")
plt.legend()
plt.grid(alpha=0.3)
plt.show()

# %% [markdown]
# ## Linear sampling
#
# Between two texels a texture unit interpolates at no cost. Two taps of weights $a$ and $b$, at
# $o$ and $o + 1$, are then one read at $o + b/(a+b)$ of weight $a + b$: 5 reads for 9 taps.

# %%
offsets, shares = blur.linear_taps(weights)
print("offsets ", np.asarray(offsets).round(10))
print("weights ", np.asarray(shares).round(10))
discrete, linear = (blur.gaussian(image, passes=9, sampling=s) for s in ("discrete", "linear"))
print(f"largest difference after nine passes: {float(abs(discrete - linear).max()):.1e}")

# %% [markdown]
# ## One chart: fetches, bytes, time
#
# All of these reach 16 pixels to every side, at 1024 x 1024 x 3 in float32 (12.6 MB):
#
# - *direct*: 33 x 33 taps at once;
# - *separable*: 33 taps down, 33 along;
# - *composed*: four pairs of passes of 9 taps, $9 + 3 \cdot 8 = 33$. Four times row 12 is row
#   48, so that the others have their weights from there;
# - *linear*: the same with 5 reads for 9 taps, as `sampling="linear"` does it, by
#   interpolating between the slices;
# - *linear, gathered*: the same as a texture unit would be told, a bilinear read at every
#   offset.
#
# Fetches are counted per pixel, as the GPU's author counts them. Bytes are those that must
# move if nothing but a few rows stays in the cache: a pass reads the image once and writes it
# once.

# %%
side, megabyte = 1024, 1024 * 1024 * 3 * 4 / 1e6
large = jnp.asarray(np.random.default_rng(0).random((side, side, 3), np.float32))
row33 = np.asarray(blur.binomial_weights(33, row=48))


def direct(image):
    height, width, channels = image.shape
    wide = jnp.pad(image, ((16, 16), (16, 16), (0, 0)), mode="edge").reshape(height + 32, -1)

    def add_row(j, total):
        rows = jax.lax.dynamic_slice_in_dim(wide, j, height)
        taps = (rows[:, i * channels :][:, : width * channels] for i in range(33))
        weights = jnp.asarray(row33, image.dtype)
        return total + weights[j] * sum(w * tap for w, tap in zip(weights, taps, strict=True))

    total = jnp.zeros((height, width * channels), image.dtype)
    return jax.lax.fori_loop(0, 33, add_row, total).reshape(image.shape)


def gathered(image):
    centers = _sampling.pixel_centers(*image.shape[:2], image.dtype)
    for axis in (1, 0):
        reads = zip(offsets.astype(image.dtype), shares.astype(image.dtype), strict=True)
        image = sum(
            w * _sampling.bilinear(image, centers.at[..., axis].add(o)) for o, w in reads
        )
    return image


def seconds(function, repeats):
    call = jax.jit(function)
    call(large).block_until_ready()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call(large).block_until_ready()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


# A name, fetches of a pixel, passes over the image, seconds.
table = [
    ("direct, 33 x 33", 33 * 33, 1, seconds(direct, 1)),
    ("separable, 33", 2 * 33, 2, seconds(lambda x: blur.gaussian(x, taps=33, row=48), 5)),
    ("composed, 4 of 9", 4 * 2 * 9, 8, seconds(lambda x: blur.gaussian(x, passes=4), 9)),
    (
        "linear, 4 of 5 reads",
        4 * 2 * 5,
        8,
        seconds(lambda x: blur.gaussian(x, passes=4, sampling="linear"), 9),
    ),
    ("linear, gathered", 4 * 2 * 5, 8, 4 * seconds(gathered, 1)),
]
four, once = blur.gaussian(large, passes=4), blur.gaussian(large, taps=33, row=48)
inside = abs(four - once)[16:-16, 16:-16]
print(f"largest difference, composed and separable, inside: {float(inside.max()):.1e}\n")
print(f"{'':22}{'fetches':>9}{'megabytes':>11}{'ms':>9}{'GB/s':>7}")
for name, fetches, passes, spent in table:
    moved = 2 * passes * megabyte
    print(f"{name:22}{fetches:9}{moved:11.0f}{1e3 * spent:9.1f}{moved / 1e3 / spent:7.1f}")

# %%
figure, axes = plt.subplots(1, 3, figsize=(10.5, 2.8), layout="constrained", sharey=True)
names = [name for name, *_ in table]
columns = {
    "fetches a pixel": [fetches for _, fetches, _, _ in table],
    "megabytes moved, at least": [2 * passes * megabyte for _, _, passes, _ in table],
    "milliseconds": [1e3 * spent for *_, spent in table],
}
for ax, (title, values) in zip(axes, columns.items(), strict=True):
    bars = ax.barh(names, values, color=["0.6", "0.6", "C0", "C1", "C3"])
    ax.bar_label(bars, fmt="{:,.0f}", padding=3)
    ax.set(title=title, xscale="log", xlim=(min(values) / 2, max(values) * 8))
    ax.xaxis.set_minor_formatter(plt.NullFormatter())
axes[0].invert_yaxis()
plt.show()

# %% [markdown]
# ## What XLA does with it
#
# On the GPU of 2010 linear sampling was 60 % faster. A processor has no unit that reads between
# pixels. In the compiled program an interpolated read is two loads, a subtraction, a
# multiplication and an addition: 9 loads remain 9, and *composed* and *linear* run at one speed
# to within the machine's noise, since both wait for memory. As a gather, which is how one would
# port the shader, every read computes four addresses a pixel and takes its time. And 33 taps at
# once move the fewest bytes of all that is separable, but not four times fewer: of more than 16
# shifted reads in one sum XLA makes as many copies of the image, so they are added in groups,
# each of which writes an image and has it read again.
#
# What did help, each seen in the compiled text before it was believed:
#
# - **Separability**, as ever.
# - **No copy with a margin.** Rows are named by their index, held within the image; along a
#   row a tap is the flat image moved by some pixels; what runs on into the next row is put
#   right in two strips.
# - **Two passes, not one of 81 taps.** XLA would fuse both passes and compute the first again
#   for every tap of the second. It keeps in memory what has been padded: one row above and one
#   below are enough.
# - **Symmetry**: two taps of one weight are added first.

# %%
text = jax.jit(blur.gaussian).lower(large).compile().as_text()
entry = text[text.index("\nENTRY") :]
size = f"{side},{side * 3}]"
loops = [
    line.split(" = ")[1].split("{")[0] for line in entry.splitlines() if " fusion(" in line
]
print("fused loops of the compiled program:", *loops, sep="\n  ")

# %% [markdown]
# ## What it can't do
#
# - **Beyond the taps**: a `sigma` that the taps don't hold is silently weaker (above). Under
#   0.6 pixels the samples of a Gaussian are too few to have its width.
# - **In bytes**: rounded to 8 bits after each pass a faint slope turns to steps; in floats it
#   does not. Blur in linear light, and round once.
# - **At the border** the nearest pixel is repeated, which gives it more weight than the others:
#   the sum over the image is not kept.
# - **Across depth**: it knows no edges. For a lens, see `dof`.

# %%
slope = jnp.tile(jnp.linspace(0.10, 0.12, 64)[None, :, None], (8, 1, 1))
exact, stepped = blur.gaussian(slope, passes=9), slope
for _ in range(9):
    stepped = jnp.round(255 * blur.gaussian(stepped)) / 255
plt.figure(figsize=(5.5, 2.6), layout="constrained")
plt.plot(255 * exact[0, :, 0], label="floats")
plt.plot(255 * stepped[0, :, 0], label="rounded after each pass")
plt.xlabel("pixel")
plt.ylabel("value, of 255")
plt.legend()
plt.show()
