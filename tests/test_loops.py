"""Loops and branches whose carry begins as a constant, inside `shard_map` and outside."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, PartitionSpec

from jaxfx._loops import cond, fori_loop, scan, switch, while_loop


def scanned(x):
    total, shown = scan(lambda sum_, row: (sum_ + row, sum_), jnp.zeros(3), x)
    return total + shown.sum(axis=0)


def counted(x):
    add = lambda i, state: (state[0] + x[i], state[1] + 1)
    total, count = fori_loop(0, len(x), add, (jnp.zeros(3), 0))
    return total * count


def until(x):
    """The row is closed over: the carry and the numbers of the loop are constants."""
    add = lambda state: (state[0] + 1, state[1] + x[0])
    return while_loop(lambda state: state[1].sum() < 9, add, (0, jnp.zeros(3)))[1]


def branched(x):
    taken = cond(x.sum() > 3, lambda y: y + x[0], lambda _: jnp.zeros(3), jnp.ones(3))
    return taken + switch(jnp.int32(x[0, 0]), [lambda y: 0 * y, lambda _: x[1]], jnp.ones(3))


def nested(x):
    inner = lambda row: fori_loop(0, 2, lambda _, sum_: sum_ + row, jnp.zeros(3))
    return scan(lambda sum_, row: (sum_ + inner(row), None), jnp.zeros(3), x)[0]


# The batch has rows of ones and of twos.
EXPECTED = {
    scanned: lambda rows: rows.sum(axis=0) + np.cumsum(rows, axis=0)[:-1].sum(axis=0),
    counted: lambda rows: len(rows) * rows.sum(axis=0),
    until: lambda rows: -(-9 // rows[0].sum()) * rows[0],
    branched: lambda rows: 1 + rows[0] + rows[1],
    nested: lambda rows: 2 * rows.sum(axis=0),
}


def mesh_of(*names):
    """A mesh of one device, of automatic axes."""
    return jax.make_mesh((1,) * len(names), names, axis_types=(AxisType.Auto,) * len(names))


@pytest.mark.parametrize("function", EXPECTED, ids=lambda function: function.__name__)
def test_loops_compute_the_same_inside_shard_map(function):
    batch = np.stack([np.ones((2, 3)), np.full((2, 3), 2.0)])
    expected = np.stack([EXPECTED[function](rows) for rows in batch])
    np.testing.assert_allclose(jax.jit(jax.vmap(function))(batch), expected)
    spec, names = PartitionSpec("batch"), ("batch", "other")
    for count in (1, 2):
        mesh = mesh_of(*names[:count])
        # The result does not vary over the other axis, or it would be refused.
        mapped = jax.shard_map(jax.vmap(function), mesh=mesh, in_specs=spec, out_specs=spec)
        np.testing.assert_allclose(jax.jit(mapped)(batch), expected)


def test_branches_of_what_varies_are_traced_once():
    """Else branches in branches would take twice the time for each level."""
    traced = []

    def branch(x):
        traced.append(x)
        return x

    spec = PartitionSpec("batch")
    mapped = lambda x: cond(x[0] > 0, branch, lambda x: -x, x)
    jax.eval_shape(
        jax.shard_map(mapped, mesh=mesh_of("batch"), in_specs=spec, out_specs=spec), jnp.ones(3)
    )
    assert len(traced) == 1


def test_a_loop_inside_an_unchecked_shard_map():
    """It knows nothing of what varies, and asks for nothing."""
    batch, spec = jnp.ones((2, 3)), PartitionSpec("batch")
    mesh = jax.make_mesh((1,), ("batch",), axis_types=(AxisType.Auto,))
    mapped = jax.shard_map(
        counted, mesh=mesh, in_specs=spec, out_specs=PartitionSpec(), check_vma=False
    )
    np.testing.assert_allclose(jax.jit(mapped)(batch), EXPECTED[counted](np.ones((2, 3))))
