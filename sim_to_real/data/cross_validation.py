"""Which frames are fitted and which are held back: every stratum on either side, all conditions fitted."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np

from noise_model.arrays import Bool, Int64
from sim_to_real.data.binned import Observed

SAME_REL = 0.05
"""Exposures and currents that differ by less are alike: what is measured scatters."""


def held_out(observed: Observed, share: float) -> Bool:
    """Return the frames (n_frames,) that are held back, about a share of each stratum, evenly over its time.

    Of each condition, exposure and current included, one frame at least is left to be fitted. Where the
    share of no stratum makes a frame it is one of each.
    """
    held = np.zeros(len(observed.frames), dtype=bool)
    least = 0 if any(round(share * len(members)) for members in _strata(observed)) else 1
    conditions = _conditions(observed)
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


def sees_as_much(observed: Observed, chosen: Bool) -> bool:
    """Say whether some frames (n_frames,), not none, show laser and arc if any of all frames do."""
    shown = observed.shows_laser, observed.shows_arc
    return bool(chosen.any()) and all(of[chosen].any() == of.any() for of in shown)


def _conditions(observed: Observed) -> list[tuple[str, int, int]]:
    """Return each frame's stratum and to which exposures and currents its own belong.

    Measured ones scatter: those that differ by less than `SAME_REL` from the next are the same.
    """
    exposure = _alike([frame.condition.exposure_s for frame in observed.frames])
    arc = _alike([frame.condition.arc_level for frame in observed.frames])
    return [(frame.stratum, e, a) for frame, e, a in zip(observed.frames, exposure, arc, strict=True)]


def _alike(values: Sequence[float]) -> list[int]:
    """Return the number of the group of each of some values, not < 0: of those that follow closely."""
    of = np.array(values, dtype=np.float64)
    order = np.argsort(of, kind="stable")
    is_apart = of[order][1:] > (1.0 + SAME_REL) * of[order][:-1]
    group = np.zeros(len(of), dtype=np.int64)
    group[order[1:]] = np.cumsum(is_apart)
    return list(map(int, group))


def _strata(observed: Observed) -> list[list[int]]:
    """Return the positions of the frames of each stratum, in time."""
    strata = defaultdict(list)
    for frame in observed.frames:
        strata[frame.stratum].append(frame.position)
    return [strata[name] for name in sorted(strata)]
