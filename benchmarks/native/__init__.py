"""The same computations in native code: parallel loops in numba, and CUDA."""
