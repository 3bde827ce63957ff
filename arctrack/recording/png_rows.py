"""The rows of a PNG that differ from the pixel before: W3C PNG (3rd edition), 9.2."""

from __future__ import annotations

from noise_model.compiled.arrays import UInt8
from noise_model.compiled.kernel import kernel

SUB = 1
"""The filter that stores each byte less the one of the pixel before."""


@kernel
def undo_sub(filtered: UInt8, pixel_bytes: int, rows: UInt8) -> None:
    """Write the rows (H, B) of a PNG whose filtered rows (H, 1 + B) are all of the filter Sub."""
    for n in range(len(rows)):
        for byte in range(pixel_bytes):
            before, differences, row = 0, filtered[n, 1 + byte :: pixel_bytes], rows[n, byte::pixel_bytes]
            for i in range(len(row)):
                before = (differences[i] + before) & 0xFF
                row[i] = before
