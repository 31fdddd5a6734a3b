"""A guess of the surface behind an edge in depth, made from the image in front of it."""

import functools as ft
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import Number, check, parameter
from jaxfx._meshes import on_any_mesh
from jaxfx._platform import by_platform
from jaxfx.dof.arguments import check_arguments, defocused
from jaxfx.dof.behind import Layer
from jaxfx.lens import Lens


# Pixels. How much farther from an edge a surface is taken to go on than the lens sees of it.
# Found on the still life, the cow and the fuze (docs/design/layered.md): with 0, gaps of a
# pixel stay between the layers; with 4, steep sides of round things are taken for edges.
_BEYOND = 1.0
# Rounds of single steps after the flood. With none, a few pixels miss their nearest source.
_LAST_ROUNDS = 1


@on_any_mesh
def peel(
    image: Float[ArrayLike, "height width channel"],
    depth: Num[ArrayLike, "height width"],
    lens: Lens,
    *,
    max_coc: Number | None = None,
    threshold: Float[ArrayLike, ""] | float = 2.0,
) -> tuple[Float[Array, "height width channel"], Float[Array, "height width"]]:
    """A guess of the surface behind the first, for `layered(behind=...)`, from one image.

    Next to an edge in depth a lens sees past the nearer surface. There the farther one is taken
    to go on, with the colour and depth that it has where the image shows it. The image may also
    be a second layer: the guess is then a third one.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background; 0, negative
      or NaN where it is missing.
    - `lens`: gives each depth its signed defocus, in pixels.
    - `max_coc`: static; the largest diameter, in pixels. Larger sprites are clamped to it.
      Outside `jit`, `grad` and `vmap` it may be left out and is then taken from `depth`.
    - `threshold`: pixels; a surface lies behind another if its defocus is larger by more than
      this. Give it and `layered` the same one.

    **Returns:** image and depth of the guess, in the types and shapes of the first. Where
    nothing is guessed the image is 0, and the depth 0, which is missing.

    **Raises:** `ValueError` for a wrong shape, an integer image, no lens, a negative
    `threshold`, or no `max_coc` under a transform.

    **Gradient:** exact with respect to `image` and `depth`, forward and reverse, for the pixels
    that are taken: which ones those are is constant. Zero in `lens` and `threshold`, which only
    choose them.

    **Example:**

    >>> import jax.numpy as jnp
    >>> from jaxfx import ThinLens, dof
    >>> image, depth = jnp.ones((8, 8, 3)), jnp.full((8, 8), 4.0).at[:, :4].set(1.0)
    >>> lens = ThinLens(aperture=0.1, focus_distance=2.0, focal_pixels=100.0)
    >>> hidden = dof.peel(image, depth, lens)
    >>> print(hidden[1][0])
    [4. 4. 4. 4. 0. 0. 0. 0.]
    >>> dof.layered(image, depth, lens, behind=hidden).shape
    (8, 8, 3)

    A pixel takes the nearest one, in the image, of those that lie behind it and show past
    it. Through a lens two points of one pixel move apart by up to half their difference in
    defocus: what is farther away than that, and a pixel more, does not show. So nothing is
    guessed behind a surface that is merely slanted, by up to a pixel of defocus per pixel.
    The nearest pixels are found by a jump flood: 8 steps of each of the lengths `max_coc / 2`,
    `max_coc / 4`, and so on to 1. Then the colours of 3 x 3 pixels are averaged, as far as they
    are of one surface, which removes streaks.

    Known limits: texture does not go on, it is repeated. Behind an edge before the background,
    of depth inf, nothing is guessed: pixels of its rim hold the nearer colour as well, and
    would shine through. Pixels without a depth or a colour are not taken.

    Source: developed for this library. Rong & Tan 2006 for the jump flood.
    """
    image, depth, own, max_coc = check_arguments("peel", image, depth, lens, max_coc)
    threshold = parameter("peel(threshold=...)", threshold)
    check("peel(threshold=...)", threshold, lambda v: v >= 0, "0 or positive")
    return _peel(Layer(image, depth, own, None), max_coc, threshold)


class Sources(NamedTuple):
    """Offset in pixels, down and to the right, to the source of each pixel's hidden surface.

    `defocus` is that of the source, in pixels, and -inf where there is none.
    """

    down: Float[Array, "height width"]
    right: Float[Array, "height width"]
    defocus: Float[Array, "height width"]


@ft.partial(jax.jit, static_argnames=("max_coc",))
def _peel(layer, max_coc, threshold):
    view = defocused(layer.image, layer.depth, layer.lens, max_coc)
    defocus = jax.lax.stop_gradient(view.defocus)
    threshold = jax.lax.stop_gradient(threshold).astype(defocus.dtype)
    may_be_taken = jnp.isfinite(layer.depth) & ~(view.missing | view.bad)
    sources = _nearest_behind(defocus, may_be_taken, threshold, max_coc)
    height, width = defocus.shape
    row = jnp.arange(height)[:, None] + sources.down.astype(int)
    column = jnp.arange(width)[None] + sources.right.astype(int)
    is_found = (sources.defocus > -jnp.inf) & ~view.missing
    color = view.image[row, column]
    hidden = _without_streaks(color, sources.defocus, is_found, threshold)
    farther = jnp.where(is_found, layer.depth[row, column], 0)
    return hidden.astype(layer.image.dtype), farther


def _nearest_behind(
    defocus: Float[Array, "height width"],
    may_be_taken: Bool[Array, "height width"],
    threshold: Float[Array, ""],
    max_coc: float,
) -> Sources:
    """The nearest pixel, in the image, of those that lie behind each and show past it."""
    lengths = [1] * (1 + _LAST_ROUNDS)
    while 2 * lengths[0] - 1 < max_coc:  # together they reach so far
        lengths.insert(0, 2 * lengths[0])
    around = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x]
    steps = jnp.asarray([(y * n, x * n) for n in lengths for y, x in around])
    height, width = defocus.shape
    none = jnp.full_like(defocus, -jnp.inf)
    far = lengths[0]
    padded = lambda x: jnp.pad(x, far, constant_values=-jnp.inf)
    own = padded(jnp.where(may_be_taken, defocus, -jnp.inf))

    def nearer(found, down, right, behind):
        """`found`, or the given sources where they are nearer and can be seen."""
        distance = lambda y, x: y * y + x * x
        gap = behind - defocus
        # Not by a root, and 0 where nothing is given: the gap is -inf there.
        within = jnp.maximum(gap / 2 + _BEYOND, 0)
        square = distance(down, right)
        is_behind = (gap > threshold) & (square <= within * within)
        is_first = (found.defocus == -jnp.inf) | (square < distance(found.down, found.right))
        pick = is_behind & is_first
        return Sources(
            jnp.where(pick, down, found.down),
            jnp.where(pick, right, found.right),
            jnp.where(pick, behind, found.defocus),
        )

    def step(found, offset):
        there = lambda x: jax.lax.dynamic_slice(x, far + offset, (height, width))
        down, right = offset.astype(defocus.dtype)
        theirs = Sources(*(there(padded(plane)) for plane in found))
        found = nearer(
            found, jnp.full_like(defocus, down), jnp.full_like(defocus, right), there(own)
        )
        return nearer(found, theirs.down + down, theirs.right + right, theirs.defocus), None

    start = Sources(jnp.zeros_like(defocus), jnp.zeros_like(defocus), none)
    # An accelerator needs no copies of the planes between the steps of one length.
    apart = lambda found, offset: jax.lax.optimization_barrier(step(found, offset))
    return by_platform(
        start,
        steps,
        cpu=lambda start, steps: jax.lax.scan(step, start, steps)[0],
        accelerator=lambda start, steps: jax.lax.scan(apart, start, steps, unroll=8)[0],
    )


def _without_streaks(
    color: Float[Array, "height width channel"],
    defocus: Float[Array, "height width"],
    is_found: Bool[Array, "height width"],
    threshold: Float[Array, ""],
) -> Float[Array, "height width channel"]:
    """The mean colour of 3 x 3 pixels whose defocus differs by less than the threshold."""
    height, width = defocus.shape
    padded = lambda x: jnp.pad(x, [(1, 1)] * 2 + [(0, 0)] * (x.ndim - 2))
    colors, places, found = padded(color), padded(defocus), padded(is_found)
    total, count = jnp.zeros_like(color), jnp.zeros_like(defocus)
    for row in range(3):
        for column in range(3):
            there = lambda x, y=row, x0=column: x[y : y + height, x0 : x0 + width]
            differs = jnp.abs(jnp.where(there(found), there(places), jnp.inf) - defocus)
            counts = (is_found & (differs <= threshold)).astype(color.dtype)
            total, count = total + counts[..., None] * there(colors), count + counts
    return total / jnp.maximum(count, 1)[..., None]
