"""Kernels' machine code: its keys, the folder that keeps it, and numba's private parts."""
