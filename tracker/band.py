"""The band of the image around the expected stripe: its pixels as charge, the arc map beside them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from noise_model.arc_map import CELL
from noise_model.frames import Float64
from noise_model.kernel import kernel

Float32 = npt.NDArray[np.float32]
Int64 = npt.NDArray[np.int64]


@kernel
def gather(
    image_dn: npt.NDArray[np.integer],
    along_rows: bool,
    lows: Int64,
    charge_e: Float32,
    saturation_dn: int,
    band: Float32,
    censored: npt.NDArray[np.bool_],
) -> None:
    """Copy a band (n_scan, depth) out of an image, linearised by the table `charge_e`.

    A code beyond the sensor's bits counts as the table's last.
    """
    n_scan, depth = band.shape
    max_dn = len(charge_e) - 1
    for s in range(n_scan):
        low = lows[s // CELL]
        for j in range(depth):
            dn = image_dn[low + j, s] if along_rows else image_dn[s, low + j]
            band[s, j] = charge_e[min(dn, max_dn)]
            censored[s, j] = dn >= saturation_dn


def place(center_px: Float64, n_pos: int, half_px: int) -> tuple[Int64, int]:
    """Return where the band begins for each CELL scan lines, and its depth, so that it holds +-half_px."""
    starts = np.arange(0, len(center_px), CELL)
    lowest, highest = np.minimum.reduceat(center_px, starts), np.maximum.reduceat(center_px, starts)
    spread = float((highest - lowest).max())
    depth = min(n_pos, 2 * half_px + int(np.ceil(min(spread, half_px))) + 1)
    middles = 0.5 * (lowest + highest)
    lows = np.clip(np.rint(middles - depth / 2.0), 0, n_pos - depth).astype(np.int64)
    return lows, depth


@kernel(allocates=True)
def median_background(band: Float32, half: int, background: Float32) -> None:
    """Write the running median over 2 half + 1 pixels of each scan line: a background without an arc map."""
    n_scan, depth = band.shape
    for s in range(n_scan):
        for j in range(depth):
            low, high = max(0, j - half), min(depth, j + half + 1)
            background[s, j] = np.median(band[s, low:high])
