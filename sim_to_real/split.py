"""Which frames are fitted and which are held back: every stratum on either side, all conditions fitted."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np
import numpy.typing as npt

from sim_to_real.observed import Observed, ObservedFrame
from sim_to_real.pixels import Bool

Int64 = npt.NDArray[np.int64]


def held_out(observed: Observed, share: float) -> Bool:
    """Return the frames (n_frames,) that are held back, about a share of each stratum, evenly over its time.

    Of each condition, exposure and current included, one frame at least is left to be fitted. Where the
    share of no stratum makes a frame it is one of each.
    """
    held = np.zeros(len(observed.frames), dtype=bool)
    least = 0 if any(round(share * len(members)) for members in _strata(observed)) else 1
    conditions = [_condition(frame) for frame in observed.frames]
    left = Counter(conditions)
    for members in _strata(observed):
        count = min(len(members) - 1, max(round(share * len(members)), least))
        # Neither the first nor the last of a stratum: a drift would have to be continued beyond its data.
        for place in (np.arange(count) + 1.0) * len(members) / (count + 1.0):
            spare = [n for n, one in enumerate(members) if not held[one] and left[conditions[one]] > 1]
            if spare:
                chosen = members[min(spare, key=lambda n: abs(n - int(place)))]
                held[chosen] = True
                left[conditions[chosen]] -= 1
    return held


def one_of_each(observed: Observed) -> Observed:
    """Return the middle frame of each stratum."""
    chosen = np.zeros(len(observed.frames), dtype=bool)
    chosen[[members[len(members) // 2] for members in _strata(observed)]] = True
    return observed.some(chosen)


def folds(observed: Observed, count: int) -> Int64:
    """Return each frame's fold (n_frames,), 0 to count - 1: those of a stratum are dealt out in turn."""
    fold = np.zeros(len(observed.frames), dtype=np.int64)
    dealt = 0
    for members in _strata(observed):
        for member in members:
            fold[member] = dealt % count
            dealt += 1
    return fold


def _condition(frame: ObservedFrame) -> tuple[str, float, float]:
    return frame.stratum, frame.condition.exposure_s, frame.condition.arc_level


def _strata(observed: Observed) -> list[list[int]]:
    """Return the positions of the frames of each stratum, in time."""
    strata = defaultdict(list)
    for frame in observed.frames:
        strata[frame.stratum].append(frame.position)
    return [strata[name] for name in sorted(strata)]
