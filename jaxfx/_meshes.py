"""Arrays that are spread over the devices of a mesh: what each device computes of them.

`jit(vmap(f))` of a batch that is sharded along its first axis runs on every device over the
device's own members. Two things stand in the way. XLA can't divide a loop over the members of a
batch, or a loop that ends with its data, and would gather the batch on every device: the rules
of `_platform` for batches use `each_device`, which divides it by hand. And on a
mesh of `AxisType.Explicit`, which `jax.make_mesh` makes by default, JAX raises an error where a
program indexes or reshapes without saying how the result is sharded: `on_any_mesh` leaves that
to XLA, as on a mesh of `AxisType.Auto`.
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import jax
from jax.experimental.custom_partitioning import (
    ArrayMapping,
    SdyShardingRule,
    custom_partitioning,
)
from jax.extend import core
from jax.sharding import AbstractMesh, AxisType, NamedSharding, PartitionSpec


Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def on_any_mesh(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """`function` of arrays, also of arrays on a mesh whose axes are explicit.

    The axes of a batch that `vmap` maps over keep their sharding; without `vmap` the result is
    on every device.
    """

    any_function: Callable[..., Any] = function

    @ft.wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        leaves, tree = jax.tree.flatten((args, kwargs))
        places = [i for i, leaf in enumerate(leaves) if isinstance(leaf, jax.Array)]
        mesh = _explicit_mesh([leaves[i] for i in places])
        if mesh is None:
            return function(*args, **kwargs)

        def of_arrays(arrays: list) -> Any:
            for i, array in zip(places, arrays, strict=True):
                leaves[i] = array
            args, kwargs = jax.tree.unflatten(tree, leaves)
            return any_function(*args, **kwargs)

        with jax.sharding.use_abstract_mesh(mesh):
            automatic: Any = jax.sharding.auto_axes(of_arrays, out_sharding=PartitionSpec())
            return automatic([leaves[i] for i in places])

    return call


def _explicit_mesh(arrays: Sequence[jax.Array]) -> AbstractMesh | None:
    """The mesh of the first array that lies on one with an explicit axis."""
    for array in arrays:
        mesh = jax.typeof(array).sharding.mesh
        if AxisType.Explicit in (mesh.axis_types or ()):
            return mesh
    return None


def each_device(
    function: Callable[..., Any], levels: Sequence[Sequence[bool]]
) -> Callable[..., Any]:
    """`function` of batches, which each device computes of the members that lie on it.

    The operands' leaves begin with axes of batches, the outermost first, and so do those of the
    result, with all of them. `levels` says of each of these axes which leaves of the operands
    have it. No member may depend on another one. On a single device this is `function`.
    """

    def divided(*operands):
        if jax.sharding.get_abstract_mesh().manual_axes:
            return function(*operands)  # An enclosing `shard_map` has divided it.
        leaves, tree = jax.tree.flatten(operands)
        of_leaves = lambda *leaves: function(*jax.tree.unflatten(tree, leaves))
        # Constant arrays become operands: JAX accepts none in what it divides.
        traced, shapes = jax.make_jaxpr(of_leaves, return_shape=True)(*leaves)
        levels_of = [[has[i] for has in levels] for i in range(len(leaves))]
        levels_of += [[False] * len(levels)] * len(traced.consts)

        def whole(*leaves):
            operands, constants = leaves[: tree.num_leaves], leaves[tree.num_leaves :]
            return core.jaxpr_as_fun(core.ClosedJaxpr(traced.jaxpr, constants))(*operands)

        def part(*leaves):  # Traced again: it has fewer members.
            return jax.tree.leaves(of_leaves(*leaves[: tree.num_leaves]))

        results = _divided(whole, part, levels_of)(*leaves, *traced.consts)
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return divided


def _divided(
    whole: Callable[..., Any], part: Callable[..., Any], levels_of: Sequence[Sequence[bool]]
) -> Callable[..., Any]:
    """`whole` of operands, divided by JAX's `custom_partitioning`: `part` on each device.

    `levels_of` says of each operand which axes of batches it has.
    """
    depth = len(levels_of[0])
    axes_of = [[k for k in range(depth) if has[k]] for has in levels_of]

    def partition(mesh, operands, results):
        specs = [_entries(operand) for operand in operands]
        of_results = [_entries(result) for result in jax.tree.leaves(results)]
        # As the operands are sharded; where none of them is, as XLA asks for the results.
        mesh_axes = _by_level(specs, axes_of, depth)
        all_levels = [list(range(depth))] * len(of_results)
        mesh_axes = _by_level(of_results, all_levels, depth, mesh_axes)
        placed = lambda axes: NamedSharding(mesh, PartitionSpec(*(mesh_axes[k] for k in axes)))
        of_batches = jax.tree.map(lambda _: placed(range(depth)), results)
        return mesh, part, of_batches, tuple(map(placed, axes_of))

    def rule(*types):
        """Which axes of operands and results are the same: those of batches, and no others."""
        names = (f"x{i}" for i in range(10**6))
        *_, operands, results = types
        mapping = lambda type, axes: ArrayMapping(
            *(f"b{k}" for k in axes), *(next(names) for _ in range(len(type.shape) - len(axes)))
        )
        return SdyShardingRule(
            tuple(map(mapping, operands, axes_of)),
            tuple(mapping(result, range(depth)) for result in results),
        )

    divided = custom_partitioning(whole)
    divided.def_partition(partition=partition, sharding_rule=rule)
    return divided


def _entries(operand: Any) -> tuple:
    """Of each axis of an operand, the mesh's axes over which it is sharded."""
    return tuple(getattr(operand.sharding, "spec", ()))


def _by_level(specs, axes_of, depth: int, before: Sequence = ()) -> list:
    """Of each level of batches, the mesh's axes over which the first sharded leaf has it.

    `before` has those of levels for which they are decided already, None for the others. No
    axis of the mesh serves two levels.
    """
    mesh_axes = list(before) or [None] * depth
    for spec, levels in zip(specs, axes_of, strict=True):
        for entry, level in zip(spec, levels, strict=False):
            if entry is not None and mesh_axes[level] is None and entry not in mesh_axes:
                mesh_axes[level] = entry
    return mesh_axes
