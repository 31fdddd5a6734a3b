"""The layers behind the first: what `layered` is given of them, and how much each shows."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxfx._arrays import ArrayLike
from jaxfx._checks import check_depth, check_image, items, option, share
from jaxfx._loops import scan
from jaxfx._numerics import clip01
from jaxfx.dof.arguments import compiled


# Pixels. The least difference in defocus between an occluder and a hidden point: lengths are
# divided by it.
_SMALLEST_GAP = 1e-3
# Share of the lens, 0 to 1. A point of a layer behind counts in full if at least this share
# sees it. With 1, points that part of the lens sees would count too little, and the fallback
# colour too much.
_SEEN = 0.25


_Image = Float[ArrayLike, "height width channel"]
_Plane = Num[ArrayLike, "height width"]
_Given = tuple[_Image, _Plane] | tuple[_Image, _Plane, _Plane]
# What the argument `behind` may be.
Behind = _Given | Sequence[_Given | Literal["peel"] | None] | Literal["peel"] | None


class Layer(NamedTuple):
    """One layer as given to `layered`; the lens is one that `jax.jit` takes."""

    image: Float[Array, "height width channel"]
    depth: Float[Array, "height width"]
    lens: Any
    alpha: Float[Array, "height width"] | None


class Surface(NamedTuple):
    """A layer as an occluder. `alpha` is None where it is 1 everywhere."""

    defocus: Float[Array, "height width"]
    is_there: Bool[Array, "height width"]
    alpha: Float[Array, "height width"] | None


def given(name: str, behind: Any) -> list[Any]:
    """The layers of an argument `behind`, front to back: `"peel"`, or tuples of arrays.

    `"peel"` is added where the last one is a tuple. None as the last item prevents that.
    """
    if behind is None:
        return []
    if isinstance(behind, str):
        return [option(name, behind, ("peel",))]
    expected = "a pair of an image and its depth, or a sequence of pairs"
    layers = items(name, behind, expected)
    is_layer = lambda x: isinstance(x, tuple | list | str)
    no_more = bool(layers) and layers[-1] is None and all(map(is_layer, layers[:-1]))
    if no_more:
        layers = layers[:-1]
    elif not all(map(is_layer, layers)):
        layers = [tuple(layers)]
    for word in (x for x in layers if isinstance(x, str)):
        option(name, word, ("peel",))
    ends = no_more or not layers or isinstance(layers[-1], str)
    return layers if ends else [*layers, "peel"]


def checked(function: str, image: Array, depth: Array, lens: Any, layer: Any) -> Layer:
    """A layer behind `image`: an image, its depth and, if given, its alpha; or `ValueError`."""
    name = f"{function}(behind=...)"
    if len(layer) not in (2, 3):
        raise ValueError(
            f"`{name}` must be an image and its depth, or those and alpha, "
            f"got {len(layer)} items."
        )
    hidden = check_image(name, layer[0])
    if hidden.shape != image.shape:
        raise ValueError(
            f"`{name}` must hold an image of shape {image.shape}, got {hidden.shape}."
        )
    farther = check_depth(name, layer[1], depth.shape)
    alpha = None if len(layer) == 2 else share(name, layer[2], depth.shape)
    return Layer(hidden.astype(image.dtype), farther, compiled(function, lens, farther), alpha)


def let_through(
    surfaces: list[Surface],
    farther: Float[Array, "height width"],
    threshold: Float[Array, ""],
    max_coc: float,
) -> Float[Array, "height width"]:
    """How much of the points of defocus `farther` counts, 0 to 1, behind all of `surfaces`.

    Behind the first of them nothing is asked for where it is not there.
    """
    first, *others = surfaces
    through = _past(first, farther, threshold, max_coc)
    for other in others:
        past = _past(other, farther, threshold, max_coc)
        through = through * jnp.where(other.is_there, past, 1)
    return through


def _past(surface: Surface, farther: Array, threshold: Array, max_coc: float) -> Array:
    """How much of the points counts behind one surface, or shows through it.

    A point counts of which the lens sees enough past the surface, and that lies a slice behind
    it or more: one that is nearer belongs to that surface.
    """
    defocus, is_there, alpha = surface
    # What is not there hides nothing: it counts as the farthest.
    seen = _seen(jnp.where(is_there, defocus, max_coc), farther, alpha, max_coc)
    apart = clip01((farther - defocus) / threshold - 1)
    past = clip01(seen / _SEEN) * apart
    return past if alpha is None else 1 - alpha * (1 - past)


def _seen(
    defocus: Float[Array, "height width"],
    farther: Float[Array, "height width"],
    alpha: Float[Array, "height width"] | None,
    max_coc: float,
) -> Float[Array, "height width"]:
    """The share of the lens, per pixel, that sees a point of a layer behind.

    `farther` is the point's defocus, `defocus` and `alpha` those of the layer in front. In 8
    directions that layer is followed from the point's own pixel while it lies in front of the
    point. Each of its pixels hides a piece of the lens's radius in that direction: the length
    of the step over half the difference in defocus, in radii of the lens. With alpha it hides
    that part of the ring. The layer in front is taken to end, gradually, where that difference
    falls below half of what it was at the start.
    """
    height, width = defocus.shape
    steps = int(max_coc) + 1
    padded = jnp.pad(defocus, steps, mode="edge")
    opacity = None if alpha is None else jnp.pad(alpha, steps, mode="edge")
    directions = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x]

    @jax.checkpoint
    def visible(direction):
        length = jnp.sqrt(jnp.sum(direction * direction).astype(defocus.dtype))

        def ahead(gap):
            return jnp.maximum(gap, _SMALLEST_GAP) / 2

        def there(plane, count):
            start = steps + count * direction
            return jax.lax.dynamic_slice(plane, start, (height, width))

        def step(carry, count):
            covered, hidden = carry
            gap = farther - there(padded, count)
            covered = covered * clip01(gap / ahead(farther - defocus))
            return (covered, hidden + length * covered / ahead(gap)), None

        def step_through(carry, count):
            (covered, hidden), area = carry
            after = step((covered, hidden), count)[0]
            ring = clip01(after[1]) ** 2 - clip01(hidden) ** 2
            return (after, area + there(opacity, count) * ring), None

        # The pixel itself hides the point, by half its width to each side.
        start = jnp.ones_like(defocus), length / 2 / ahead(farther - defocus)
        if alpha is None:
            hidden = scan(jax.checkpoint(step), start, jnp.arange(1, steps))[0][1]
            return 1 - clip01(hidden) ** 2
        start = start, alpha * clip01(start[1]) ** 2
        return 1 - scan(jax.checkpoint(step_through), start, jnp.arange(1, steps))[0][1]

    return jnp.mean(jax.lax.map(visible, jnp.asarray(directions)), axis=0)
