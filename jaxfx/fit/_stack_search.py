"""The search of `fit.focal_stack`: image and inverse depth, by gradients through the effect."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

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
# What an unknown of 1 changes: the defocus, in pixels, and the image, as a ratio to the images'
# root mean square. The images depend about as much on either; else the search is slow.
_SHIFT, _CHANGE = 1.0, 0.5


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

    def values(self, unknowns: dict[str, Array]) -> tuple[Array, Array]:
        """Image and inverse depth, from unknowns, which are 0 at the start."""
        shift = unknowns["shift"].astype(self.image.dtype) * (_SHIFT / self.strength)
        change = unknowns["change"].astype(self.image.dtype) * (_CHANGE * self.level)
        return self.image + change, jnp.clip(self.inverse_depth + shift, *self.bounds)

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

    def __call__(self, unknowns: dict[str, Array]) -> Float[Array, " residual"]:
        image, inverse_depth = self.values(unknowns)
        difference = (self.drawn(image, inverse_depth) - self.images) / self.noise
        parts = [_eased(difference).reshape(-1)]
        luminance = jnp.mean(self.image, axis=-1)
        for axis in (0, 1):
            if inverse_depth.shape[axis] < 3:
                continue
            bend = jnp.diff(inverse_depth, n=2, axis=axis) * (self.strength / _BEND)
            step = jnp.abs(jnp.diff(luminance, axis=axis)) / (_EDGE * self.level)
            count = step.shape[axis]
            sides = [
                jax.lax.slice_in_dim(step, at, at + count - 1, axis=axis) for at in (0, 1)
            ]
            weight = jnp.sqrt(self.smoothness * jnp.exp(-jnp.maximum(*sides)))
            parts.append((weight * _eased(bend)).reshape(-1))
        return jnp.concatenate(parts).astype(float)


def _eased(x: Array) -> Array:
    """What has the pseudo-Huber loss as its square: x where small, a root of it where large."""
    return x * jnp.sqrt(2 / (1 + jnp.sqrt(1 + x * x)))
