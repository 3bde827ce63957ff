"""Test of whether the arc map still explains the frames: a cumulative sum over each frame's misfit.

A track's `map_misfit` is the residual of the arc map over its stated sigma. Its logarithm, averaged over a
block of time so that neighbouring frames count once, is compared with what the run began with. The sum

    S_b = max(0, S_{b-1} + z_b - DRIFT)

of the standardised blocks z is Page's test (1954, Biometrika 41, 100), the quickest for its rate of false
alarms (Moustakides 1986, Ann. Stat. 14, 1379). It alarms above DECIDE; the change began where S last was 0.
Neighbouring blocks correlate by r; so z is over the sigma of a long sum's blocks, s sqrt((1 + r) / (1 - r)).
"""

import itertools
import math
import statistics
from collections import deque
from dataclasses import dataclass, field

from noise_model.robust import MAD_SIGMA
from tracker.state import Track


@dataclass(frozen=True)
class GapPolicy:
    """Policy of the gap report: a CUSUM test on blocks of mean ln(misfit).

    - `block_s`: length of a block, s (a texture's patches pass in half a second at 10 mm/s).
    - `learn_blocks`: largest number of gap-free blocks that the run's own level and scatter are taken from
      (chosen: ten minutes; with correlated neighbours, what half a minute tells of them makes false alarms).
    - `correlation_blocks`, `max_correlation`: number of blocks from which the correlation of neighbours is
      estimated, and its largest value (chosen: fewer blocks do not determine it; beyond it a change could not
      be told from correlation).
    - `min_frames`: a block with fewer frames that determine a misfit does not count.
    - `prior_sigma`, `prior_blocks`: prior scatter of a block's mean ln(misfit), and the number of blocks that
      it counts for (simulated runs show 0.07 to 0.12, correlated by 0.5).
    - `drift`, `decide`: in sigmas, half the shift to be found quickly, and the sum that alarms. With 0.5 and
      12 the run length without a gap is 10^6 blocks for independent ones (Siegmund 1985, Sequential Analysis,
      Eq. 2.56), and a shift of 3 sigmas is reported after five blocks.
    - `explained`: a misfit up to this is within what the map states, whatever the run began with.
    """

    block_s: float = 1.0
    learn_blocks: int = 600
    correlation_blocks: int = 30
    max_correlation: float = 0.8
    min_frames: int = 4
    prior_sigma: float = 0.2
    prior_blocks: int = 10
    drift: float = 0.5
    decide: float = 12.0
    explained: float = 1.2


@dataclass
class GapWatch:
    """Monitor of whether the map still explains the tracks.

    While `is_gap`, `since_s` is when it began on the frames' clock, otherwise NaN. `misfit` is the newest
    block's, NaN before the first.
    """

    policy: GapPolicy = field(default_factory=GapPolicy)
    is_gap: bool = False
    since_s: float = math.nan
    misfit: float = math.nan

    def __post_init__(self) -> None:
        self._block: list[float] = []
        self._block_s = -math.inf
        self._learned: list[float] = []
        self._recent: deque[float] = deque(maxlen=self.policy.correlation_blocks)
        self._explained = math.log(self.policy.explained)
        self._usual, self._sigma = 0.0, self.policy.prior_sigma
        self._sum, self._rising_s = 0.0, math.nan

    def accept(self) -> None:
        """Take the misfit of the last blocks for explained: only what is beyond it is a gap from now on."""
        self._learned = list(self._recent)
        self._learn()
        self._explained = max(self._explained, self._usual)
        self._sum, self.is_gap, self.since_s = 0.0, False, math.nan

    def see(self, track: Track) -> None:
        """Take a track; one without a misfit says nothing."""
        if not track.map_misfit > 0.0 or math.isinf(track.map_misfit):
            return
        if not 0.0 <= track.timestamp_s - self._block_s < self.policy.block_s:
            if len(self._block) >= self.policy.min_frames:
                self._end_block(statistics.fmean(self._block), self._block_s)
            self._block, self._block_s = [], track.timestamp_s
        self._block.append(math.log(track.map_misfit))

    def _end_block(self, level: float, began_s: float) -> None:
        policy = self.policy
        self.misfit = math.exp(level)
        self._recent.append(level)
        if len(self._learned) < policy.learn_blocks and not self.is_gap:
            self._learned.append(level)
            self._learn()
        # What a run begins with is no excuse: a map that explains nothing then is a gap as well.
        z = (level - min(self._usual, self._explained)) / self._sigma
        before = self._sum
        z = z if level > self._explained else min(0.0, z)
        self._sum = min(max(0.0, before + z - policy.drift), 2.0 * policy.decide)
        if before == 0.0 and self._sum > 0.0:
            self._rising_s = began_s
        if self._sum == 0.0:
            self.is_gap, self.since_s = False, math.nan
        elif self._sum > policy.decide and not self.is_gap:
            self.is_gap, self.since_s = True, self._rising_s

    def _learn(self) -> None:
        """Take the usual level and its sigma, of a long sum's blocks, from the blocks that were learned."""
        policy, count = self.policy, len(self._learned)
        self._usual = statistics.median(self._learned)
        off = [block - self._usual for block in self._learned]
        spread = MAD_SIGMA * statistics.median(map(abs, off))
        square = math.fsum(block * block for block in off)
        if count >= policy.correlation_blocks and square > 0.0:
            product = math.fsum(block * other for block, other in itertools.pairwise(off))
            correlation = min(max(product / square, 0.0), policy.max_correlation)
            spread *= math.sqrt((1.0 + correlation) / (1.0 - correlation))
        prior, weight = policy.prior_sigma, policy.prior_blocks
        self._sigma = math.sqrt((weight * prior**2 + count * spread**2) / (weight + count))
