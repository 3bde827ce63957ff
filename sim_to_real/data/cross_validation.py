"""Split into fitted and held-out frames: every stratum on both sides, all conditions fitted."""

from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np

from noise_model.compiled.arrays import Bool
from sim_to_real.data.binned import ObservedRecording


def split_holdout(observed: ObservedRecording, share: float) -> Bool:
    """Return the frames (n_frames,) that are held out: about a share of each stratum, evenly over time.

    At least one frame of each condition, exposure and current included, is left to be fitted. If the share is
    less than a frame in every stratum, one frame of each is held out.
    """
    held = np.zeros(len(observed.frames), dtype=bool)
    min_count = 0 if any(round(share * len(members)) for members in _strata(observed)) else 1
    conditions = _conditions(observed)
    n_to_fit = Counter(conditions)
    for members in _strata(observed):
        count = min(len(members) - 1, max(round(share * len(members)), min_count))
        # Neither the first nor the last of a stratum: a drift would have to be continued beyond its data.
        for place in (np.arange(count) + 1.0) * len(members) / (count + 1.0):
            spare = [
                n for n, member in enumerate(members) if not held[member] and n_to_fit[conditions[member]] > 1
            ]
            if spare:
                chosen = members[min(spare, key=lambda n: abs(n - int(place)))]
                held[chosen] = True
                n_to_fit[conditions[chosen]] -= 1
    return held


def _strata(observed: ObservedRecording) -> list[list[int]]:
    """Return the positions of the frames of each stratum, in time."""
    strata = defaultdict(list)
    for frame in observed.frames:
        strata[frame.stratum].append(frame.position)
    return [strata[name] for name in sorted(strata)]


def _conditions(observed: ObservedRecording) -> list[tuple[str, int, int]]:
    """Return each frame's stratum, and the numbers of its exposure's and current's groups.

    Values that differ by less than 5 % from the next belong to one group.
    """
    exposure = _condition_groups([frame.condition.exposure_s for frame in observed.frames])
    arc = _condition_groups([frame.condition.arc_level for frame in observed.frames])
    return [(frame.stratum, e, a) for frame, e, a in zip(observed.frames, exposure, arc, strict=True)]


def _condition_groups(values: Sequence[float]) -> list[int]:
    """Return the group number of each of some values, not < 0; a group's values follow each other closely."""
    levels = np.array(values, dtype=np.float64)
    order = np.argsort(levels, kind="stable")
    # Measured values of one condition scatter by up to 5 %.
    is_apart = levels[order][1:] > 1.05 * levels[order][:-1]
    group = np.zeros(len(levels), dtype=np.int64)
    group[order[1:]] = np.cumsum(is_apart)
    return list(map(int, group))
