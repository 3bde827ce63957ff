"""Evidence that an arc burns, by its light off the stripe: the picture's word beside the robot's.

Off the stripe a pixel's charge is level map + black + u, with light u that the map does not explain. The
level's regression decides by two one-sided tests, each the likelihood ratio's (Neyman and Pearson 1933, Phil.
Trans. R. Soc. A 231, 289), for that ratio rises with the level:

- No arc burns. The level is 0. Its sigma is the noise's, and what u makes of it. Without an arc u is light of
  the hall, which an earlier frame without an arc has shown.
- An arc burns. The level is MIN_OUTPUT at least, with the map's own error besides.

Light u that is smooth over four tenths of the image's diagonal moves a level, in the worst pattern, by as
much as it leaves unexplained. So all of u's variance counts that neighbours of the sample's lattice have in
common. Of the rest 1 / sqrt(n) counts, for it may be alike along the lattice's lines.

A frame that rejects neither leaves the question open.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from tracker.arc.level import (
    CHANCE,
    HUBER,
    MAP_SIGMA,
    MISFIT_QUANTILE,
    NORMAL_QUANTILE,
    ArcLevel,
    Unlit,
    quantile,
)
from tracker.geometry import ImageSource, dark_variance_at

MIN_OUTPUT = 0.2
"""Least output of a burning arc over the expected one, that of 0.3 of the current at a power of 1.3."""

FRAMES, ANY_FALSE, TESTS = 1e5, 0.05, 2
"""Number of frames that are to pass without a false answer but for a chance of ANY_FALSE, and tests in each.
"""

DECIDED_SIGMAS = NormalDist().inv_cdf(1.0 - ANY_FALSE / (FRAMES * TESTS))
"""Distance of a level from a rejected one, in its sigmas: 5.03, by the union bound over FRAMES and TESTS."""


class ArcEvidence(NamedTuple):
    """Output of the arc over the expected one by a frame's light, and whether an arc burns.

    `sigma` is the level's 1 sigma, the map's error in it: one that is smooth does not average over pixels.
    `smooth_e` is the light that the map leaves unexplained and that may look like the map, 1 sigma, e-. They
    are NaN, and `burns` is None, where the frame does not tell.
    """

    level: float = math.nan
    sigma: float = math.nan
    smooth_e: float = math.nan
    burns: bool | None = None


class ArcMemory(NamedTuple):
    """Memory of the arc in earlier frames.

    `burns` as the latest one that told, None before the first. `hall_e` is the `smooth_e` of the latest
    without an arc, at the nominal exposure, e-; infinite before the first.
    """

    burns: bool | None = None
    hall_e: float = math.inf

    def after(self, evidence: ArcEvidence, exposure: float) -> ArcMemory:
        """Return the memory after a frame with this evidence, its `exposure` over the nominal one."""
        if evidence.burns is None:
            return self
        return ArcMemory(evidence.burns, self.hall_e if evidence.burns else evidence.smooth_e / exposure)


NO_EVIDENCE, NOTHING_SEEN = ArcEvidence(), ArcMemory()


def arc_evidence(image: ImageSource, unlit: Unlit, arc: ArcLevel, hall_e: float) -> ArcEvidence:
    """Return the evidence of a level that was fitted to pixels off the stripe.

    `hall_e` is the `smooth_e` of the hall alone at the frame's exposure, e-. It is infinite where no earlier
    frame has shown it: all that is unexplained may then be the hall's.
    """
    if not math.isfinite(arc.level):
        return NO_EVIDENCE
    n, map_e = len(unlit.arc_e), unlit.arc_e
    map_mean_e = float(map_e.sum()) / n
    contrast_e2 = float(map_e @ map_e) / n - map_mean_e**2
    if not contrast_e2 > 0.0:
        return NO_EVIDENCE
    off_e = unlit.charge_e - arc.level * map_e - arc.black_e
    spread_e = quantile(np.abs(off_e), MISFIT_QUANTILE) / NORMAL_QUANTILE
    noise_e2 = max(arc.level * map_mean_e + arc.black_e, 0.0) + dark_variance_at(image, unlit.charge_e)
    unexplained_e2 = max(spread_e**2 - noise_e2 * (1.0 + CHANCE / math.sqrt(n)) ** 2, 0.0)
    # Spatter is no smooth light.
    np.clip(off_e, -HUBER * spread_e, HUBER * spread_e, out=off_e)
    common_e2 = max(float(off_e[1:] @ off_e[:-1]) / n, 0.0)
    smooth_e = math.sqrt(min(common_e2, unexplained_e2) + unexplained_e2 / math.sqrt(n))
    contrast_e = math.sqrt(contrast_e2)
    dark_sigma = math.hypot(arc.sigma, min(smooth_e, hall_e) / contrast_e)
    sigma = math.hypot(arc.sigma, smooth_e / contrast_e)
    burns = None
    if MIN_OUTPUT - arc.level > DECIDED_SIGMAS * math.hypot(sigma, MAP_SIGMA * MIN_OUTPUT):
        burns = False
    elif arc.level > DECIDED_SIGMAS * dark_sigma:
        burns = True
    return ArcEvidence(arc.level, math.hypot(sigma, MAP_SIGMA * arc.level), smooth_e, burns)
