"""Types of arrays and points, named once for all rooms. They tell the numbers' type, not the shape."""

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

Point = tuple[float, float, float]

Vector = Float64 | Point
"""x, y and z, as an array or one by one."""
