"""Which frames are fitted and which are held back: every kind of condition on either side."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import numpy.typing as npt

from sim_to_real.observed import Observed

Bool = npt.NDArray[np.bool_]
Int64 = npt.NDArray[np.int64]


def held_out(observed: Observed, share: float) -> Bool:
    """Return the frames (n_frames,) that are held back, about a share of each kind of condition.

    A kind with a single frame is not held back; within a kind they lie evenly over the time.
    """
    held = np.zeros(len(observed.frames), dtype=bool)
    for members in _kinds(observed):
        count = min(len(members) - 1, round(share * len(members)))
        # Neither the first nor the last of a kind: a drift would have to be continued beyond its data.
        places = (np.arange(count) + 1.0) * len(members) / (count + 1.0)
        held[[members[int(place)] for place in places]] = True
    return held


def one_of_each(observed: Observed) -> Observed:
    """Return the middle frame of each kind of condition."""
    chosen = np.zeros(len(observed.frames), dtype=bool)
    chosen[[members[len(members) // 2] for members in _kinds(observed)]] = True
    return observed.some(chosen)


def folds(observed: Observed, count: int) -> Int64:
    """Return each frame's fold (n_frames,), 0 to count - 1: those of a kind are dealt out in turn."""
    fold = np.zeros(len(observed.frames), dtype=np.int64)
    dealt = 0
    for members in _kinds(observed):
        for member in members:
            fold[member] = dealt % count
            dealt += 1
    return fold


def _kinds(observed: Observed) -> list[list[int]]:
    """Return the positions of the frames of each stratum, in time."""
    kinds = defaultdict(list)
    for frame in observed.frames:
        kinds[frame.stratum].append(frame.position)
    return [kinds[name] for name in sorted(kinds)]
