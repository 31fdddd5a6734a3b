"""Batches on a mesh: here of one device; tests/sharding has eight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from jaxfx._meshes import each_device, on_any_mesh


def squares(x, numbers):
    """Indexes and reshapes, which an explicit mesh does not divide by itself."""
    return (x[numbers] ** 2).reshape(2, -1).reshape(-1)


@pytest.mark.parametrize("kind", [AxisType.Explicit, AxisType.Auto])
def test_an_explicit_mesh_is_as_good_as_an_automatic_one(kind):
    mesh = jax.make_mesh((1,), ("batch",), axis_types=(kind,))
    x, numbers = jnp.arange(12.0).reshape(3, 4), jnp.asarray([[3, 0, 1, 1]] * 3)
    sharding = NamedSharding(mesh, PartitionSpec("batch"))
    placed = jax.device_put((x, numbers), sharding)
    loss = lambda x, numbers: (on_any_mesh(squares)(x, numbers) ** 2).sum()
    found = jax.jit(jax.vmap(jax.grad(loss)))(*placed)
    expected = np.zeros((3, 4))
    for row, number in zip(range(3), np.asarray(numbers), strict=True):
        np.add.at(expected[row], number, 4 * np.asarray(x)[row, number] ** 3)
    np.testing.assert_allclose(found, expected)
    assert found.sharding.is_equivalent_to(sharding, 2)


def test_a_function_of_no_mesh_is_called_as_it_is():
    assert on_any_mesh(lambda x, y=2: (x, y))(3, y=4) == (3, 4)


def test_a_single_device_computes_the_function_itself():
    numbers = np.arange(3.0)  # a constant
    turned = lambda x, y: x * y[None] + numbers[None]
    x, y = jnp.ones((2, 3)), jnp.arange(3.0)
    divided = each_device(turned, [[True, False]])
    np.testing.assert_array_equal(jax.jit(divided)(x, y), turned(x, y))
    modules = (
        export.export(jax.jit(each), platforms=["cuda"])(x, y).mlir_module()
        for each in (divided, turned)
    )
    assert all("custom_call" not in module for module in modules)
