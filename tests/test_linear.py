"""Linear functions with a transpose of their own: which program is run when."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx._linear import linear


@pytest.mark.full
def test_each_program_is_run_where_it_is_asked_for():
    """`push`, `pull` and `plain` are of three matrices, which tells them apart."""
    matrices = (jnp.asarray(m) for m in np.random.default_rng(0).normal(size=(3, 3, 2)))
    push, pull, plain = matrices
    scale = jnp.asarray(2.0)

    def scaled(scale, x):
        apply = lambda matrix: lambda x: {"out": scale * (matrix @ x["in"])}
        back = lambda y: {"in": scale * (pull.T @ y["out"])}
        return linear(apply(push), back, apply(plain), {"in": x})["out"]

    x, bar = jnp.arange(2.0) + 1, jnp.arange(3.0) - 1
    out, dot = jax.jvp(lambda x: scaled(scale, x), (x,), (x + 1,))
    np.testing.assert_allclose(out, 2 * push @ x)
    np.testing.assert_allclose(dot, 2 * push @ (x + 1))
    np.testing.assert_allclose(jax.vjp(scaled, scale, x)[1](bar)[1], 2 * pull.T @ bar)
    # The transpose's own transpose, and the derivative in what is closed over.
    twice = jax.vjp(lambda y: jax.vjp(scaled, scale, x)[1](y)[1], bar)[1]
    np.testing.assert_allclose(twice(x)[0], 2 * push @ x)
    _, by_scale = jax.jvp(lambda scale: scaled(scale, x), (scale,), (scale,))
    np.testing.assert_allclose(by_scale, 2 * plain @ x)
    back = lambda x: jax.vjp(lambda x: scaled(scale, x), x)[1](bar)[0]
    batch = jax.vmap(back)(jnp.stack([x, x]))
    np.testing.assert_allclose(batch, np.tile(2 * pull.T @ bar, (2, 1)))
