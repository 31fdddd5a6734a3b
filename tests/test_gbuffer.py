"""The deep frame buffer: its eight fields, as types, under transforms, and what it refuses."""

import dataclasses
import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfx import GBuffer


COLORS = ("color", "ambient", "diffuse", "specular", "normal")
SCALARS = ("depth", "roughness")


def fields(height=4, width=5, dtype=np.float64):
    rng = np.random.default_rng(0)
    images = {name: rng.random((height, width, 3)).astype(dtype) for name in COLORS}
    planes = {name: rng.random((height, width)).astype(dtype) for name in SCALARS}
    return images | planes | {"shader": rng.integers(-1, 3, (height, width), np.int32)}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [(4, 5), (1, 1), (1, 7)])
def test_fields_are_kept(size, dtype):
    values = fields(*size, dtype)
    gbuffer = GBuffer(**values)
    assert {field.name for field in dataclasses.fields(gbuffer)} == values.keys()
    for name, value in values.items():
        assert isinstance(getattr(gbuffer, name), jax.Array)
        assert getattr(gbuffer, name).dtype == value.dtype
        np.testing.assert_array_equal(getattr(gbuffer, name), value)


def test_order_of_fields():
    """As the design has it; files and examples rely on it."""
    names = [*inspect.signature(GBuffer).parameters]
    assert names == [
        *("color", "shader", "ambient", "diffuse", "specular", "normal", "depth", "roughness")
    ]


def test_background_is_infinite():
    depth = np.full((4, 5), np.inf)
    np.testing.assert_array_equal(GBuffer(**fields() | {"depth": depth}).depth, depth)


def test_transforms():
    gbuffer = GBuffer(**fields())
    floats, shader = eqx.partition(gbuffer, eqx.is_inexact_array)

    def total(floats):
        whole = GBuffer(**vars(eqx.combine(floats, shader)))
        leaves = jax.tree.leaves(eqx.filter(whole, eqx.is_inexact_array))
        return sum(jnp.sum(leaf * leaf) for leaf in leaves)

    for mode in (jax.grad, jax.jacfwd):
        slopes = jax.jit(mode(total))(floats)
        assert slopes.shader is None
        for name in COLORS + SCALARS:
            slope, value = getattr(slopes, name), getattr(gbuffer, name)
            np.testing.assert_allclose(slope, 2 * np.asarray(value), rtol=1e-15)
    floats = jax.device_get(floats)
    batch = jax.tree.map(lambda leaf: np.stack([leaf, 2 * leaf]), floats)
    value = float(jax.jit(total)(floats))
    found = jax.jit(jax.vmap(total))(batch)
    np.testing.assert_allclose(found, [value, 4 * value], rtol=1e-14)


@pytest.mark.parametrize("name", [name for name in COLORS if name != "color"])
def test_errors_of_images(name):
    wrong = np.zeros((4, 4, 3))
    match = rf"`GBuffer\({name}\)` must have shape \(4, 5, 3\), got \(4, 4, 3\)"
    with pytest.raises(ValueError, match=match):
        GBuffer(**fields() | {name: wrong})


@pytest.mark.parametrize("name", SCALARS)
def test_errors_of_planes(name):
    match = rf"`GBuffer\({name}\)` must have shape \(4, 5\), got \(4, 5, 1\)"
    with pytest.raises(ValueError, match=match):
        GBuffer(**fields() | {name: np.zeros((4, 5, 1))})


@pytest.mark.parametrize("shape", [(4, 5), (4, 5, 4), (2, 4, 5, 3)])
def test_errors_of_the_colour(shape):
    match = r"`GBuffer\(color\)` must have shape \(height, width, 3\), got "
    with pytest.raises(ValueError, match=match):
        GBuffer(**fields() | {"color": np.zeros(shape)})


@pytest.mark.parametrize(
    "shader", [np.zeros((4, 5)), np.zeros((5, 4), int), np.zeros((4, 5), bool)]
)
def test_errors_of_the_shader(shader):
    match = r"`GBuffer\(shader\)` must hold integers of shape \(4, 5\), got "
    with pytest.raises(ValueError, match=match):
        GBuffer(**fields() | {"shader": shader})


def test_errors_of_types():
    with pytest.raises(
        ValueError, match=r"`GBuffer\(depth\)` must hold real numbers, got complex"
    ):
        GBuffer(**fields() | {"depth": np.zeros((4, 5), complex)})
