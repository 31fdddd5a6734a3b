"""Images of a scene through lenses, as a function of the parameters that `fit.dof` seeks.

A solver moves unknowns. `Model.values` turns them into parameters (aperture, focus distance and
so on), `Model.drawn` parameters into images, by `dof.scatter` or `dof.layered`, and
`Model.corrected` adds the footprint to these.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._numerics import one_program
from jaxfx.dof.iris import Iris
from jaxfx.dof.layered import layered
from jaxfx.dof.scatter import scatter
from jaxfx.dof.sprites import POINT_RADIUS, coverage, reach, row_half_width
from jaxfx.fit._reduction import reduced, thinned
from jaxfx.lens import ThinLens


Effect = Literal["scatter", "layered"]
Values = dict[str, Array]

# The parameters of a lens, of which each photograph has its own, and those of the depth: its
# inverse is `scale` times the inverse of the given depth, plus `shift`.
LENS = ("aperture", "focus_distance")
DISPARITY = ("scale", "shift")
# Those of the iris, which all photographs share.
IRIS = ("rotation", "squeeze")

# The least start of a parameter that is sought by its logarithm, in that parameter's unit: a
# start of 0 has no logarithm. A larger bound would move starts that are small on purpose.
_SMALLEST = 1e-6

# Up to this circle of confusion, in pixels, the footprint is corrected: above it, the second
# moments of a sprite and of its disc differ by less than 3 %. A smaller bound leaves larger
# differences in, a larger one costs and corrects next to nothing.
_SMALL_COC = 8.0

# The unknown of a footprint of 1, that of a photograph.
FULL_FOOTPRINT = 2 * math.atanh(0.5)


class Images(NamedTuple):
    """The images of a fit, all of one size and type.

    - `references`: the photographs, one for each lens.
    - `image`, `depth`, `behind`: what the effect is given.
    - `weights`: factor of each pixel's squared difference.
    - `focal_pixels`: focal length of each lens, in pixels.
    """

    references: Float[Array, "photograph height width channel"]
    image: Float[Array, "height width channel"]
    depth: Float[Array, "height width"]
    behind: tuple[Any, Any] | None
    weights: Float[Array, "height width"]
    focal_pixels: Float[Array, " photograph"]

    def shrunk(self, factor: int) -> "Images":
        """The same images at a size smaller by a whole factor."""
        small = functools.partial(reduced, factor=factor)
        behind = self.behind
        if behind is not None:
            behind = small(behind[0]), thinned(behind[1], factor)
        return Images(
            jax.vmap(small)(self.references),
            small(self.image),
            thinned(self.depth, factor),
            behind,
            small(self.weights[..., None])[..., 0],
            self.focal_pixels / factor,
        )


class Model(eqx.Module):
    """An effect as a function of the parameters that are sought, the others held at the start.

    - `start`: all parameters; those of `LENS` have an entry for each photograph.
    - `corrects`: 1 where the footprint is free, 0 where it is held at 0.
    - `iris`: the shape of the lens, whose numbers are those of the values; None for the disc.
    - `names`: the parameters that are sought.
    - `max_coc`: the largest circle of confusion that is drawn, in pixels.
    - `peels`: whether `dof.peel` guesses the second layer, again for every lens that is tried.
    """

    images: Images
    start: Values
    corrects: Float[Array, ""]
    iris: Iris | None
    names: tuple[str, ...] = eqx.field(static=True)
    effect: Effect = eqx.field(static=True)
    max_coc: int | float = eqx.field(static=True)
    peels: bool = eqx.field(static=True, default=False)

    @one_program
    def values(self, unknowns: Values) -> Values:
        """All parameters, in their units, from unknowns, which are 0 at the start.

        An unknown is the logarithm of the parameter over its start. That of `gamma`, which may
        come to 0, adds to the inverse softplus of the start; that of `shift`, which has either
        sign, counts in medians of the inverse depth; that of `footprint` goes through a
        hyperbolic tangent, which keeps it between -0.5 and 1.5; that of `rotation` is added;
        a `squeeze` ends at 1.
        """
        values = dict(self.start)
        for name, unknown in unknowns.items():
            start = self.start[name].astype(float)
            positive = jnp.maximum(start, _SMALLEST)
            if name == "gamma":
                base = positive + jnp.log(-jnp.expm1(-positive))
                value = jax.nn.softplus(base + unknown)
            elif name == "shift":
                value = start + unknown * self._median_inverse_depth().astype(float)
            elif name == "rotation":
                value = start + unknown
            elif name == "squeeze":
                value = jnp.minimum(positive * jnp.exp(unknown), 1)
            elif name == "footprint":
                value = self.corrects * (0.5 + jnp.tanh(unknown - math.atanh(0.5)))
            else:
                value = positive * jnp.exp(unknown)
            values[name] = value.astype(self.start[name].dtype)
        return values

    def _median_inverse_depth(self) -> Array:
        depth = self.images.depth
        is_known = (depth > 0) & jnp.isfinite(depth)
        return jnp.nanmedian(jnp.where(is_known, 1 / jnp.where(is_known, depth, 1), jnp.nan))

    def depths(self, values: Values) -> tuple[Array, tuple[Any, Any] | None]:
        """The depth and the second layer, rescaled by `scale` and `shift` where those are free.

        An inverse depth that comes to 0 or less is background.
        """
        depth, behind = self.images.depth, self.images.behind
        if not set(DISPARITY).intersection(self.names):
            return depth, behind

        def rescaled(depth: Array) -> Array:
            is_known = depth > 0
            inverse_depth = values["scale"] / jnp.where(is_known, depth, 1) + values["shift"]
            is_finite = inverse_depth > 0
            positive = jnp.where(is_finite, inverse_depth, 1)
            return jnp.where(is_known, jnp.where(is_finite, 1 / positive, jnp.inf), depth)

        return rescaled(depth), None if behind is None else (behind[0], rescaled(behind[1]))

    def lens(self, values: Values, photograph: int) -> ThinLens:
        """The lens of one photograph."""
        aperture, focus_distance = (values[name][photograph] for name in LENS)
        return ThinLens(aperture, focus_distance, self.images.focal_pixels[photograph])

    def shape(self, values: Values) -> Iris | None:
        """The iris with these numbers."""
        if self.iris is None:
            return None
        numbers = tuple(values[name] for name in IRIS)
        return eqx.tree_at(lambda iris: (iris.rotation, iris.squeeze), self.iris, numbers)

    def circles(self, values: Values) -> Float[Array, "photograph height width"]:
        """The circles of confusion in pixels, 0 where the depth is missing."""
        depth, _ = self.depths(values)
        count = self.images.focal_pixels.size
        lenses = (self.lens(values, photograph) for photograph in range(count))
        circles = jnp.stack([lens.circle_of_confusion(depth) for lens in lenses])
        return jnp.where(depth > 0, circles, 0)

    def drawn(self, values: Values) -> Float[Array, "photograph height width channel"]:
        """The images that the effect draws. They don't depend on the footprint."""
        depth, behind = self.depths(values)
        layers = "peel" if self.peels else None if behind is None else [behind, None]
        iris = self.shape(values)

        def draw(lens):
            image = self.images.image
            if self.effect == "scatter":
                return scatter(
                    image,
                    depth,
                    lens,
                    gamma=values["gamma"],
                    epsilon=values["epsilon"],
                    max_coc=self.max_coc,
                    iris=iris,
                )
            return layered(
                image,
                depth,
                lens,
                behind=layers,
                threshold=values["threshold"],
                max_coc=self.max_coc,
                iris=iris,
            )

        return self._each(values, draw)

    def corrected(
        self, drawn: Float[Array, "photograph height width channel"], values: Values
    ) -> Float[Array, "photograph height width channel"]:
        """The images drawn with the footprint that the effect lacks."""
        if "footprint" not in self.names:
            return drawn
        depth, _ = self.depths(values)

        def correct(lens, drawn):
            coc = jnp.where(depth > 0, lens.circle_of_confusion(depth), 0)
            return drawn + values["footprint"] * missing_blur(drawn, coc)

        return self._each(values, correct, drawn)

    def _each(self, values: Values, function: Callable[..., Array], *images: Array) -> Array:
        """`function(lens, *images)` for each photograph."""
        lenses = [*(values[name] for name in LENS), self.images.focal_pixels]
        of_photograph = lambda lens, *images: function(ThinLens(*lens), *images)
        if self.images.focal_pixels.size == 1:
            return of_photograph([x[0] for x in lenses], *(x[0] for x in images))[None]
        return jax.vmap(of_photograph)(lenses, *images)


def missing_blur(
    drawn: Float[Array, "height width channel"], coc: Float[Array, "height width"]
) -> Float[Array, "height width channel"]:
    """What a footprint of 1 adds to a drawn image.

    A sprite covers whole pixels: up to a circle of confusion of a pixel it blurs nothing, a
    little above it blurs more than its disc. To second order a blur adds half its second moment
    times the second derivative of the image. So the moment that the sprite lacks beside its
    disc, times half the second difference, makes up for it.
    """
    blur = jnp.zeros_like(drawn)
    for axis, lacking in enumerate(_lacking_moments()):
        pad = [(1, 1) if a == axis else (0, 0) for a in range(3)]
        padded = jnp.pad(drawn, pad, mode="edge")
        before, after = (
            jax.lax.slice_in_dim(padded, at, at + drawn.shape[axis], axis=axis) for at in (0, 2)
        )
        diameters = jnp.linspace(0, _SMALL_COC, lacking.size, dtype=coc.dtype)
        moment = jnp.interp(coc, diameters, lacking.astype(coc.dtype), right=0)
        blur = blur + moment[..., None].astype(drawn.dtype) / 2 * (before - 2 * drawn + after)
    return blur


@functools.cache
def _lacking_moments() -> tuple[Any, Any]:
    """Second moments of discs less those of their sprites, down and across, in square pixels.

    Each has an entry for every twentieth of a pixel of diameter, from 0 to `_SMALL_COC`. The
    moment of a disc is a sixteenth of its squared diameter.
    """
    with jax.ensure_compile_time_eval():
        far = reach(_SMALL_COC)
        diameter = jnp.linspace(0, _SMALL_COC, 161, dtype=float)
        radius = jnp.maximum(diameter / 2, POINT_RADIUS)
        place = jnp.arange(-far, far + 1, dtype=float)
        widths = jax.vmap(lambda row: row_half_width(radius, row))(place)
        sprite = jax.vmap(lambda column: coverage(widths, column))(place)  # x, y, diameter
        sprite = sprite / jnp.sum(sprite, axis=(0, 1))[None, None]
        squares = place[:, None] ** 2
        across, down = (jnp.sum(jnp.sum(sprite, axis=a) * squares, axis=0) for a in (1, 0))
        return jax.device_get((diameter**2 / 16 - down, diameter**2 / 16 - across))
