"""The same sums in native code: parallel loops, compiled by numba."""
