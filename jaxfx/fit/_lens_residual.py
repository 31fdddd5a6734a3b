"""The residual of `fit.dof`: what the model draws, less the photographs, after exposure."""

import dataclasses
import functools
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxfx.fit._descent import linear
from jaxfx.fit._exposure import exposure_between
from jaxfx.fit._lens_model import Model, Values
from jaxfx.fit._levenberg_marquardt import Stages
from jaxfx.fit._robust import huber


Tone = Literal["linear", "log"]


class Comparison(NamedTuple):
    """Images beside the photographs, at some unknowns.

    - `difference`: photograph height width channel, after gain, offset and tone.
    - `drawn`: by the effect.
    - `corrected`: the same with the footprint, before gain and offset.
    - `gain`, `offset`: a ratio and units of radiance.
    """

    difference: Float[Array, "photograph height width channel"]
    drawn: Float[Array, "photograph height width channel"]
    corrected: Float[Array, "photograph height width channel"]
    gain: Float[Array, "photograph channel"]
    offset: Float[Array, "photograph channel"]


class Residual(eqx.Module):
    """The images drawn less the references, weighted, as a function of the unknowns.

    - `scale`: standard deviation of each pixel's difference, in units of radiance; inf for a
      pixel that is left out, 1 everywhere for plain squares.
    - `unit`: the standard deviation of pixels far from edges, in units of radiance.
    - `is_robust`: whether the loss is Huber's, or plain squares.
    - `exposure`: whether gain and offset are free.
    """

    model: Model
    scale: Float[Array, "photograph height width"]
    unit: Float[Array, ""]
    is_robust: bool = eqx.field(static=True)
    exposure: bool = eqx.field(static=True)
    tone: Tone = eqx.field(static=True)

    def compare(self, unknowns: Values) -> Comparison:
        """The images drawn at these unknowns, and how they differ from the photographs."""
        return self._beside(self.model.drawn(self.model.values(unknowns)), unknowns)

    def _beside(self, drawn: Array, unknowns: Values) -> Comparison:
        """Drawn images beside the photographs."""
        images = self.model.images
        corrected = self.model.corrected(drawn, self.model.values(unknowns))
        counts = images.weights[None] / (self.scale / self.unit) ** 2

        def exposed(drawn, reference, counts, scale):
            return exposure_between(drawn, reference, counts, scale[..., None], self.exposure)

        gain, offset = jax.vmap(exposed)(corrected, images.references, counts, self.scale)
        shown = gain * corrected + offset
        tone = functools.partial(_log_tone, white=jnp.mean(jnp.abs(images.references)))
        toned = tone if self.tone == "log" else lambda x: x
        difference = toned(shown) - toned(images.references)
        return Comparison(difference, drawn, corrected, gain[:, 0, 0], offset[:, 0, 0])

    def weighted(self, difference: Array) -> Float[Array, "photograph height width channel"]:
        """Differences per pixel as residuals: their squares are the loss.

        They are in units of radiance, those of pixels far from edges at their own size.
        """
        root = jnp.sqrt(self.model.images.weights)[None, ..., None]
        if not self.is_robust:
            return (root * difference).astype(float)
        deviations = (difference / self.scale[..., None]).astype(float)
        return self.unit.astype(float) * root.astype(float) * huber(deviations)

    def __call__(self, unknowns: Values) -> Float[Array, "photograph height width channel"]:
        return self.weighted(self.compare(unknowns).difference)

    def stages(self, unknowns: Values) -> Stages | None:
        """The same residual as a call, in two stages: the images drawn, and all else.

        None if the images depend on all unknowns.
        """
        moving = {name: value for name, value in unknowns.items() if name != "footprint"}
        if len(moving) == len(unknowns):
            return None
        return Stages(
            moving,
            lambda moving: self.model.drawn(self.model.values(unknowns | moving)),
            lambda drawn, unknowns: self.weighted(self._beside(drawn, unknowns).difference),
        )

    def at(self, unknowns: Values) -> Float[Array, "photograph height width channel"]:
        """The same residual as a call, by the compiled program of `evaluate`.

        A search takes it where it needs no derivative: no other program is compiled for it.
        """
        return _weighted(self, evaluate(self, unknowns).difference)


def _log_tone(x: Array, white: Array) -> Array:
    """An odd logarithm: `x` itself where `x` is much smaller than `white`."""
    white = jnp.maximum(white, jnp.finfo(x.dtype).tiny)
    return white * jnp.sign(x) * jnp.log1p(jnp.abs(x) / white)


def plain(model: Model, exposure: bool, tone: Tone) -> Residual:
    """The residual of plain squares."""
    one = jnp.ones(model.images.references.shape[:3], model.images.image.dtype)
    return Residual(model, one, one[0, 0, 0], False, exposure, tone)


def evaluate(residual: Residual, unknowns: Values) -> Comparison:
    """`residual.compare`, compiled: all that needs no derivative shares this program.

    It takes as long to compile as the effect. The loss, of which it knows nothing, therefore
    makes no second program.
    """
    return _compare(dataclasses.replace(residual, is_robust=False), unknowns)


_compare = eqx.filter_jit(Residual.compare)
_weighted = eqx.filter_jit(Residual.weighted)


def mean_size(residual: Residual, unknowns: Values) -> Float[Array, " photograph"]:
    """The mean absolute difference of each photograph, in units of radiance.

    It ranks lenses before any noise is estimated: unlike a mean square, it is not decided by a
    few large differences.
    """
    difference = evaluate(residual, unknowns).difference
    weights = residual.model.images.weights[None, ..., None]
    return jnp.mean(jnp.abs(difference) * weights, axis=(1, 2, 3))


class Report(NamedTuple):
    """A residual and its derivatives at some unknowns.

    - `columns`: the Jacobian in the order of `ravel_pytree`.
    - `widening`: the derivative in the logarithm of a factor on all circles of confusion.
    """

    columns: Float[Array, "residual unknown"]
    widening: Float[Array, " residual"]
    residual: Float[Array, "photograph height width channel"]
    compared: Comparison


def report(residual: Residual, unknowns: Values) -> Report:
    """The residual, its derivatives and the comparison, by the programs of a search."""
    jacobian = linear(residual, unknowns).jacobian
    compared = evaluate(residual, unknowns)
    if "aperture" in unknowns:
        # An unknown of an aperture is its logarithm, which all circles of confusion follow.
        still = jax.tree.map(jnp.zeros_like, unknowns)
        direction = still | {"aperture": jnp.ones_like(unknowns["aperture"])}
        widening = jacobian @ ravel_pytree(direction)[0]
    else:
        widening = _widening(residual, unknowns)
    return Report(jacobian, widening, residual.weighted(compared.difference), compared)


@eqx.filter_jit
def _widening(residual: Residual, unknowns: Values) -> Float[Array, " residual"]:
    """The derivative in the logarithm of a factor on all apertures, which are not sought."""
    aperture = residual.model.start["aperture"]

    def widened(exponent):
        wide = aperture * jnp.exp(exponent).astype(aperture.dtype)
        return eqx.tree_at(lambda r: r.model.start["aperture"], residual, wide)(unknowns)

    zero = jnp.zeros((), float)
    return jax.jvp(widened, (zero,), (jnp.ones_like(zero),))[1].reshape(-1)
