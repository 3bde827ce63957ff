"""Types of arrays and points, named once for all packages, and the layout that kernels take.

Types state the numbers' type, not the shape.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]
UInt8 = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]

Integers = npt.NDArray[np.integer]
"""Integers of any width: an image of 8 to 16 bit, or indices."""


def as_compiled_for(numbers: Float64) -> Float64:
    """Return numbers in the layout that kernels are compiled for: float64, contiguous and writable."""
    if numbers.flags.carray and numbers.dtype == np.float64:
        return numbers
    return np.require(numbers, np.float64, ("C", "W", "A"))


Point = tuple[float, float, float]

Vector = Float64 | Point
"""x, y and z, as an array or one by one."""
