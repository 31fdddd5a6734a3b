"""`ArrayLike` in annotations: which values pass, and what `help()` prints."""

import inspect

import beartype
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from jaxtyping import Float, Num

from jaxfx._arrays import ArrayLike


@jaxtyping.jaxtyped(typechecker=beartype.beartype)
def paired(image: Float[ArrayLike, "height width 3"], depth: Num[ArrayLike, "height width"]):
    """A function of an image and its depth, floats or integers."""
    return np.shape(image), np.shape(depth)


@jaxtyping.jaxtyped(typechecker=beartype.beartype)
def scalar(value: Float[ArrayLike, ""] | float):
    """A function of one number."""
    return float(value)


@pytest.mark.parametrize("library", [np, jnp])
def test_arrays_of_a_shape_pass(library):
    image, depth = library.zeros((4, 5, 3)), library.ones((4, 5), int)
    assert paired(image, depth) == ((4, 5, 3), (4, 5))
    jax.eval_shape(paired.__wrapped__, image, depth)
    for wrong in (
        (image, library.ones((4, 6))),
        (image[..., :2], depth),
        (library.zeros((4, 5, 3), int), depth),
    ):
        with pytest.raises(jaxtyping.TypeCheckError):
            paired(*wrong)


def test_traced_arrays_pass():
    traced = jax.jit(lambda image, depth: jnp.asarray(paired(image, depth)[0]))
    np.testing.assert_array_equal(traced(jnp.zeros((4, 5, 3)), jnp.ones((4, 5))), [4, 5, 3])


def test_scalars_of_any_library_pass():
    for value in (1.5, np.float32(1.5), np.array(1.5), jnp.float32(1.5)):
        assert scalar(value) == 1.5
    for wrong in ("1.5", [1.5], np.array([1.5]), None):
        with pytest.raises(jaxtyping.TypeCheckError):
            scalar(wrong)


def test_lists_are_no_arrays():
    with pytest.raises(jaxtyping.TypeCheckError):
        paired([[[0.0, 0.0, 0.0]]], np.ones((1, 1)))


def test_help_prints_one_name():
    text = str(inspect.signature(paired))
    assert "Float[ArrayLike, 'height width 3']" in text
    assert "Union" not in text
