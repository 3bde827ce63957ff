"""Scratch of the arc's kernels, so that a kernel takes one argument for it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noise_model.arc.bicubic import LARGEST, N
from noise_model.arc.chords import MAX_PARTS, MAX_PIECES
from noise_model.arc.quadrature import MAX_POINTS
from noise_model.arc.slices import MAX_SLICES, N_NUMBERS
from noise_model.compiled.arrays import Float32, Float64
from noise_model.compiled.lanes import N_LANES
from noise_model.surface.visibility import MAX_LEDGES, MAX_PLANES

MAX_TOGETHER = 25
"""Largest number of points of a cell's polynomial."""

MAX_FACES = 40
"""Room for the faces of a section: those of a U are most."""

SCRATCH = np.dtype(
    [
        # One point's integral: nodes with their weights, the lines across the disc, the sorted crossings, the
        # open parts of a chord, the chords with their weights.
        ("nodes", np.float64, (3, MAX_POINTS)),
        ("cuts", np.float64, (MAX_PLANES, 3)),
        ("breaks", np.float64, (MAX_PIECES,)),
        ("parts", np.float64, (MAX_PARTS, 3)),
        ("spans", np.float64, (4, MAX_PIECES)),
        # What hides the arc from the point, see `visibility.sky_planes`.
        ("planes", np.float64, (MAX_PLANES, 3)),
        ("ledges", np.float64, (2 * MAX_LEDGES, 3)),
        # Points of a table's cell, integrated one after another.
        ("node_faces", np.int64, (MAX_TOGETHER,)),
        ("node_places", np.float64, (MAX_TOGETHER, 2)),
        ("node_light_e", np.float64, (MAX_TOGETHER,)),
        # Sixteen rays (x, y, 1) of the camera: the faces that they meet; the stations where, from the
        # camera's, then the ways across the face, mm; and their light.
        ("ray_x", np.float32, (N_LANES,)),
        ("ray_y", np.float32, (N_LANES,)),
        ("ray_faces", np.float32, (N_LANES,)),
        ("ray_places", np.float32, (2 * N_LANES,)),
        ("ray_light_e", np.float32, (N_LANES,)),
        # Pixels of an image's cell.
        ("pixels", np.int64, (LARGEST,)),
        ("faces", np.int64, (LARGEST,)),
        ("places", np.float64, (LARGEST, 2)),
        ("light_e", np.float64, (LARGEST,)),
        # By face: whether it is seen and filled by a polynomial, and its coefficients; where a line's runs
        # of one face end.
        ("is_filled", np.int8, (MAX_FACES,)),
        ("powers", np.float64, (MAX_FACES, N, N)),
        ("run_ends", np.int64, (MAX_FACES,)),
    ],
    align=True,
)

Record = Any
"""A record of SCRATCH."""


class ArcScratch(NamedTuple):
    """Scratch memory for the light on a section's faces.

    `records` (1,) is of SCRATCH: a record is freed with its array. `slices` is the memory of a lap's slices,
    None for other sections: so a kernel holds the integral over slices only where it may be needed.
    """

    records: NDArray[Any]
    slices: Float32 | None

    @classmethod
    def of(cls, vertices: Float64) -> ArcScratch:
        """Return new scratch for a section's vertices (n, 2)."""
        may_be_lap = len(vertices) == 4 and vertices[1, 0] == vertices[2, 0]
        slices = np.empty(N_NUMBERS * MAX_SLICES, dtype=np.float32) if may_be_lap else None
        return cls(np.empty(1, SCRATCH), slices)
