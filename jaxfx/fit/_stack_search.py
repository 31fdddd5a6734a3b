"""The search of `fit.focal_stack`: image and inverse depth, by gradients through the effect."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfx._numerics import one_program
from jaxfx.dof.layered import layered
from jaxfx.dof.scatter import scatter
from jaxfx.fit._lens_model import Effect, missing_blur
from jaxfx.lens import ThinLens


# Second difference of the defocus between neighboring pixels, in pixels, from which on the
# prior counts it as an edge. A larger one rounds edges off, a smaller one leaves noise.
_BEND = 0.05
# Difference in luminance between neighbors, as a ratio to the images' root mean square, that
# lowers the prior by a factor of e: surfaces often end where the image has an edge.
_EDGE = 0.3
# Change of an image by a pixel of defocus, as a ratio to the images' root mean square. It only
# scales the unknowns: a wrong one makes the search slow.
_CONTRAST = 0.1
# Circle of confusion, in pixels, from which on an image counts less where it has such a one. A
# larger one lets what the effect draws wrong beside edges spread over the radius of the blur, a
# smaller one leaves the sharpest image alone. Chosen on the still life and room 501.
_SHARP = 2.0


class StackResidual(eqx.Module):
    """Differences between the stack and what the effect draws, and the prior, as one residual.

    - `strength`: pixels of defocus per unit of inverse depth, the mean of the lenses.
    - `noise`: standard deviation of a difference, in units of radiance.
    - `level`: the images' root mean square, in units of radiance.
    - `lenses`: with a leading axis of photographs.
    """

    images: Float[Array, "photograph height width channel"]
    lenses: ThinLens
    image: Float[Array, "height width channel"]
    inverse_depth: Float[Array, "height width"]
    bounds: tuple[Array, Array]
    strength: Float[Array, ""]
    noise: Float[Array, ""]
    level: Float[Array, ""]
    smoothness: Float[Array, ""]
    effect: Effect = eqx.field(static=True)
    max_coc: int | float = eqx.field(static=True)

    @one_program
    def values(self, unknowns: dict[str, Array]) -> tuple[Array, Array]:
        """Image and inverse depth, from unknowns, which are 0 at the start.

        They are scaled so that the mean squared residual bends by about 1 in each.
        """
        unit = self.noise * math.sqrt(self.images.size / 2)
        seen = self.images.size / self.inverse_depth.size * (_CONTRAST * self.level) ** 2
        # A pixel's bend counts in three second differences along each axis: 2 (1 + 4 + 1).
        bends = 12 * self.smoothness * (self.noise / _BEND) ** 2
        shift = unit / jnp.sqrt(seen + bends) / self.strength
        inverse_depth = self.inverse_depth + shift * unknowns["shift"].astype(shift.dtype)
        image = self.image + unit * unknowns["change"].astype(unit.dtype)
        return image, jnp.clip(inverse_depth, *self.bounds)

    @one_program
    def drawn(
        self, image: Array, inverse_depth: Array
    ) -> Float[Array, "photograph height width channel"]:
        """The stack as the effect draws it."""
        depth = 1 / inverse_depth

        def draw(lens: ThinLens) -> Array:
            if self.effect == "scatter":
                drawn = scatter(image, depth, lens, max_coc=self.max_coc)
            else:
                drawn = layered(image, depth, lens, behind=None, max_coc=self.max_coc)
            return drawn + missing_blur(drawn, lens.circle_of_confusion(depth))

        return jax.lax.map(draw, self.lenses)

    @one_program
    def __call__(self, unknowns: dict[str, Array]) -> Float[Array, " residual"]:
        image, inverse_depth = self.values(unknowns)
        difference = (self.drawn(image, inverse_depth) - self.images) / self.noise
        depth = 1 / self.inverse_depth
        circles = jax.vmap(lambda lens: lens.circle_of_confusion(depth))(self.lenses)
        difference = difference / jnp.sqrt(1 + (circles / _SHARP) ** 2)[..., None]
        parts = [_eased(difference).reshape(-1)]
        luminance = jnp.mean(self.image, axis=-1)
        for axis in (0, 1):
            if inverse_depth.shape[axis] < 3:
                continue
            bend = jnp.diff(inverse_depth, n=2, axis=axis) * (self.strength / _BEND)
            step = jnp.abs(jnp.diff(luminance, axis=axis)) / (_EDGE * self.level)
            count = step.shape[axis]
            sides = [jax.lax.slice_in_dim(step, at, at + count - 1, axis=axis) for at in (0, 1)]
            weight = jnp.sqrt(self.smoothness * jnp.exp(-jnp.maximum(*sides)))
            parts.append((weight * _eased(bend)).reshape(-1))
        return jnp.concatenate(parts).astype(float)


def _eased(x: Array) -> Array:
    """Root of the pseudo-Huber loss: about x where small, about sqrt(2 abs(x)) where large."""
    return x * jnp.sqrt(2 / (1 + jnp.sqrt(1 + x * x)))
