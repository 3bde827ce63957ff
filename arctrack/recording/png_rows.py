"""A PNG's rows from their differences to neighbours: W3C PNG (3rd edition), 9.2."""

from __future__ import annotations

from noise_model.arrays import UInt8
from noise_model.kernel import kernel

NONE, SUB, UP, AVERAGE, PAETH = range(5)
"""The types of filters."""


@kernel
def unfilter(filtered: UInt8, pixel_bytes: int, rows: UInt8) -> bool:
    """Undo the filters of all rows; each byte of a pixel has neighbours of its own.

    Parameters
    ----------
    filtered : ndarray, uint8, shape (H, 1 + B)
        Each row's type of filter, and what the filter made of the row's B bytes.
    pixel_bytes : int
        How many bytes a pixel has.
    rows : ndarray, uint8, shape (1 + H, B)
        Takes the rows from its second one on. The first one, above the image, must be 0.

    Returns
    -------
    bool
        False where a type is none of the five.
    """
    for n in range(len(filtered)):
        for byte in range(pixel_bytes):
            of_byte = slice(byte, None, pixel_bytes)
            if not _undo(filtered[n, 0], filtered[n, 1:][of_byte], rows[n][of_byte], rows[n + 1][of_byte]):
                return False
    return True


@kernel
def _undo(of_type: int, filtered: UInt8, above: UInt8, row: UInt8) -> bool:
    """Undo one row's filter, modulo 256; return False at a type that is none of the five."""
    before, corner = 0, 0
    if of_type == NONE:
        for i in range(len(row)):
            row[i] = filtered[i]
    elif of_type == SUB:
        for i in range(len(row)):
            before = (filtered[i] + before) & 0xFF
            row[i] = before
    elif of_type == UP:
        for i in range(len(row)):
            row[i] = filtered[i] + above[i]
    elif of_type == AVERAGE:
        for i in range(len(row)):
            before = (filtered[i] + ((before + above[i]) >> 1)) & 0xFF
            row[i] = before
    elif of_type == PAETH:
        for i in range(len(row)):
            up = int(above[i])
            before = (filtered[i] + _paeth(before, up, corner)) & 0xFF
            row[i], corner = before, up
    return of_type <= PAETH


@kernel(inline=True)
def _paeth(before: int, up: int, corner: int) -> int:
    """Return that of three neighbours that is nearest to `before + up - corner`: W3C PNG, 9.4."""
    to_before, to_up, to_corner = abs(up - corner), abs(before - corner), abs(before + up - 2 * corner)
    nearer, to_nearer = (before, to_before) if to_before <= to_up else (up, to_up)
    return nearer if to_nearer <= to_corner else corner
