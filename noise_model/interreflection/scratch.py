"""The arrays that the kernels of bounced light write into on their way.

A kernel that makes arrays counts references to them, at every slice that its loops take: so gathering took
1.4 to 3 times as long. Python makes them all, and the kernels make none.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64, Int64
from noise_model.interreflection.first_bounce import MAX_CHORDS, Place

PSI_KNOTS, X_KNOTS, Y_KNOTS = 10, 36, 5
"""Room for what cuts psi, a corrugation's x and its y into pieces."""


class Scratch(NamedTuple):
    """Room for numbers that nobody needs afterwards.

    `knots` and `cuts` along the seam, `sides` and `side_cuts` across it: what cuts a range, and the pieces'
    borders. `borders` and `spans` are those of `arc_leaving`. `which` and `weights` (8,) are those of
    `lattice.around`.
    """

    knots: Float64
    cuts: Float64
    sides: Float64
    side_cuts: Float64
    borders: Float64
    spans: Float64
    which: Int64
    weights: Float64


def scratch_for(k: Place) -> Scratch:
    """Return room for what is computed of a place."""
    n_along = max(PSI_KNOTS, X_KNOTS)
    return Scratch(
        knots=np.empty(n_along),
        cuts=np.empty(n_along + 2),
        sides=np.empty(Y_KNOTS),
        side_cuts=np.empty(Y_KNOTS + 2),
        borders=np.empty((len(k.vertices), 3)),
        spans=np.empty((3, MAX_CHORDS)),
        which=np.empty(8, dtype=np.int64),
        weights=np.empty(8),
    )
