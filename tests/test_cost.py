"""What compiled derivatives compute: as much as they need, and nothing again for every tap.

Where a loop of taps reads something, XLA may compute it again in each of them. Operations are
counted by XLA itself, in the program that it made.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import ThinLens, dof, shadow


pytestmark = pytest.mark.usefixtures("optimised")

SIDE = 64


def operations(function, *arguments):
    analysis = jax.jit(function).lower(*arguments).compile().cost_analysis()
    return analysis["flops"]


def blended():
    rng = np.random.default_rng(0)
    image, depth = rng.random((SIDE, SIDE, 3)), rng.uniform(1, 9, (SIDE, SIDE))
    blend = lambda image: dof.blend(image, depth, ThinLens(0.3, 3.0, 60.0), max_coc=12.0)
    return blend, (jnp.asarray(image),)


def shadowed():
    rng = np.random.default_rng(0)
    fields = [jnp.asarray(rng.uniform(1, SIDE, (SIDE, SIDE))) for _ in range(4)]
    shadow_map = jnp.asarray(rng.uniform(1, 9, (SIDE, SIDE)))
    pcf = lambda *data: shadow.pcf(data[0], data[1], size=5, softness=data[2])
    return pcf, (shadow_map, shadow.Receivers(*fields), jnp.asarray(0.1))


@pytest.mark.parametrize(
    ("effect", "argument", "most"),
    [(blended, 0, 4), (shadowed, 0, 8), (shadowed, 1, 8), (shadowed, 2, 8)],
)
@pytest.mark.full
def test_a_gradient_takes_a_few_times_the_operations_of_its_picture(effect, argument, most):
    function, arguments = effect()
    loss = lambda *arguments: jnp.sum(function(*arguments) ** 2)
    gradient = jax.grad(loss, argnums=argument)
    assert operations(gradient, *arguments) < most * operations(function, *arguments)
