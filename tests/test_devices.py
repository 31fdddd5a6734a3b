"""Programs for devices that are not here: they are lowered, and what they hold is looked at."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from jaxfx import ThinLens, dof
from tests.helpers.forms import first
from tests.helpers.programs import primitives
from tests.helpers.quick import for_accelerators, optimised
from tests.test_transforms import CASES, each


def both(call):
    """The result of a function, and what a reverse pass gives for its own result."""

    def value_and_slopes(arguments):
        out, pull = jax.vjp(call, arguments)
        return out, pull(out)

    return value_and_slopes


@pytest.mark.full
@pytest.mark.usefixtures("optimised")
@each(CASES)
def test_every_function_and_its_gradient_can_be_lowered_for_accelerators(case):
    call, arguments = case.split()
    lowered = export.export(jax.jit(both(call)), platforms=["cuda", "tpu"])(arguments)
    assert lowered.platforms == ("cuda", "tpu")


def picture(seed=0, shape=(12, 14)):
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random(shape) < 0.2, np.inf, rng.uniform(1.2, 6, shape))
    return jnp.asarray(rng.random((*shape, 3))), jnp.asarray(depth)


LENS = ThinLens(0.1, 2.5, 60.0)
METHODS = {
    "scatter": lambda *data: dof.scatter(*data, gamma=1.3, epsilon=1.7, max_coc=7.0),
    "depth_sorted": lambda *data: dof.depth_sorted(*data, max_coc=7.0),
    "gather": lambda *data: dof.gather(*data, max_coc=7.0),
}
TRANSFORMS = {
    "value": lambda call: call,
    "gradient": lambda call: jax.grad(lambda *data: jnp.sum(call(*data) ** 2), (0, 1, 2)),
    "tangent": lambda call: lambda *data: jax.jvp(call, data, data)[1],
    "jacobian": lambda call: jax.jacfwd(call, 2),
    "batch": lambda call: jax.vmap(call, (0, 0, None)),
    "batch of batches": lambda call: jax.vmap(jax.vmap(call, (0, None, None)), (None, 0, 0)),
    "jacobian of a batch": lambda call: TRANSFORMS["jacobian"](TRANSFORMS["batch"](call)),
    "gradient of a batch": lambda call: TRANSFORMS["gradient"](TRANSFORMS["batch"](call)),
}


def case_of(transform):
    """Two images and lenses, one of them without a blur, as the transform takes them."""
    pictures = [picture(0), picture(1)]
    images, depths = (jnp.stack(each) for each in zip(*pictures, strict=True))
    if transform == "batch of batches":
        return images, depths, jax.tree.map(lambda x: jnp.stack([x, 0 * x]), LENS)
    return (images, depths, LENS) if "batch" in transform else (*pictures[0], LENS)


@first(
    ("name", "transform"),
    [*((("scatter", transform)) for transform in TRANSFORMS), ("depth_sorted", "gradient")],
)
def test_every_kind_of_program_computes_the_same(name, transform):
    """A CPU's alone, those for accelerators, and the choice of a platform that users have."""
    call, data = TRANSFORMS[transform](METHODS[name]), case_of(transform)
    expected = jax.jit(call)(*data)
    for kind in (for_accelerators, optimised):
        with kind():
            found = jax.jit(call)(*data)
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)


@first("transform", TRANSFORMS, 2)
@pytest.mark.parametrize("name", METHODS)
def test_accelerators_neither_scatter_nor_loop_without_a_known_end(name, transform):
    with for_accelerators():
        program = jax.make_jaxpr(TRANSFORMS[transform](METHODS[name]))(*case_of(transform))
    found = set(primitives(program.jaxpr))
    gathers = name == "gather" and "gradient" in transform
    # What a bilinear tap reads is where an image says: its transpose is a scatter.
    assert ("scatter-add" in found) == gathers
    assert "while" not in found


def test_a_picture_in_focus_is_itself_on_accelerators_too():
    image, depth = picture(2)
    sharp = eqx.tree_at(lambda lens: lens.aperture, LENS, jnp.zeros(()))
    with for_accelerators():
        np.testing.assert_array_equal(METHODS["scatter"](image, depth, sharp), image)
