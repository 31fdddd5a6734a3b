"""Programs that are quick to compile, for what is asked of neither speed nor memory."""

import functools

import jax


# Compiling is most of the tests' work. What a user runs is compiled with all optimisation: that
# it is right too is shown by tests of values, which call `jax.jit` or the function alone.
quick_jit = functools.partial(
    jax.jit,
    compiler_options={
        "xla_backend_optimization_level": 0,
        "xla_cpu_use_fusion_emitters": False,
    },
)
