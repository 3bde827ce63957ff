"""The process that watches a live run: is its map right, what does a gap look like, how high is the arc."""

import itertools
import math
import statistics
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection

from arctrack.live.journal.journal import JournalReader, gap_name
from arctrack.live.journal.records import Entry, GapReport, pack
from arctrack.live.journal.ring import RingWriter
from arctrack.replay.arc_height import ArcHeight, ArcHeightEstimator
from noise_model.robust import MAD_SIGMA
from noise_model.setup import Setup
from tracker.geometry import SensorGeometry
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
    """Monitor of whether the map still explains the tracks: a cumulative sum over each frame's misfit.

    A track's `map_misfit` is the residual of the arc map over its stated sigma. Its logarithm, averaged over
    a block of time so that neighbouring frames count once, is compared with what the run began with. The sum

        S_b = max(0, S_{b-1} + z_b - drift)

    of the standardised blocks z is Page's test (1954, Biometrika 41, 100), the quickest for its rate of false
    alarms (Moustakides 1986, Ann. Stat. 14, 1379). It alarms above `decide`; the change began where S last
    was 0. Neighbouring blocks correlate by r; so z is over the sigma of a long sum's blocks,
    s sqrt((1 + r) / (1 - r)).

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


LOOK_FRAMES, MIN_LOOK_FRAMES, AGAIN_S = 12, 6, 60.0
"""Number of frames, evenly chosen since a gap began, that are used, their least number, and the time until
the next use.
"""


@dataclass(frozen=True)
class WatchOptions:
    """Options of the watch: a run by its name, and each job's setup."""

    run: str
    jobs: Mapping[int, Setup]


def run_watch(options: WatchOptions, parent: Connection) -> None:
    """Watch a run until the parent's connection is closed, and publish a `GapReport` each second."""
    reader = JournalReader(options.run)
    with RingWriter(gap_name(options.run), 4, 4096) as ring:
        parent.send([])
        watch = RunWatch(reader, options.jobs)
        reported_s = -math.inf
        while not parent.poll(0.2):
            watch.look()
            if watch.now_s - reported_s >= 1.0 or watch.now_s < reported_s:
                reported_s = watch.now_s
                ring.write(pack(watch.report()))


class RunWatch:
    """Watch of a run by its journal; `now_s` is the time of the newest frame that was examined."""

    def __init__(self, reader: JournalReader, jobs: Mapping[int, Setup]) -> None:
        self._reader, self._jobs = reader, jobs
        self._estimators: dict[int, ArcHeightEstimator] = {}
        self._watch, self._job_number = GapWatch(), -1
        self._position = reader.count
        self._looked_s = -math.inf
        self._likely: str = ""
        self.now_s = -math.inf

    @property
    def since_s(self) -> float:
        """Time since which the map no longer explains the frames, s; NaN while it does."""
        return self._watch.since_s

    def look(self) -> None:
        """Take the tracks that came, and look at a gap where there is one."""
        end = self._reader.count
        # Five a look, 25 a second, contain what 200 do, for neighbours correlate.
        step = max(1, (end - self._position) // 5)
        for position in range(self._position, end, step):
            entry = self._reader.entry(position)
            if entry is not None:
                self._see(entry)
        self._position = end
        watch = self._watch
        if not watch.is_gap:
            self._likely = ""
        # Time from a gap's begin to its examination, s: earlier, most frames are from before it.
        elif self.now_s - watch.since_s >= 5.0 and self.now_s - self._looked_s >= AGAIN_S:
            self._looked_s = self.now_s
            self._likely = self._look_at_the_gap()

    def report(self) -> GapReport:
        """Return what is known now."""
        status, watch = self._reader.status(), self._watch
        to_wall_s = math.nan if status is None else status.wall_s - status.now_s
        height, arc_mm = self._height(), math.nan
        setup = self._jobs.get(self._job_number)
        if setup is not None:
            arc_mm = setup.arc.center_in_tool_mm[2]
        return GapReport(
            time_s=self.now_s,
            is_gap=watch.is_gap,
            text=self._text(),
            since_wall_s=watch.since_s + to_wall_s,
            arc_height_mm=arc_mm + height.height_mm,
            arc_height_sigma_mm=height.height_sigma_mm,
        )

    def _see(self, entry: Entry) -> None:
        if entry.job_number != self._job_number:
            # Another part, another map.
            self._watch, self._job_number = GapWatch(), entry.job_number
        self._watch.see(entry.track)
        self.now_s = entry.frame.timestamp_s

    def _text(self) -> str:
        watch = self._watch
        if not watch.is_gap:
            return ""
        size = f"the arc map's error is {watch.misfit:.1f} times what it states"
        return f"{size}; {self._likely}" if self._likely else size

    def _height(self) -> ArcHeight:
        view = self._reader.newest_view()
        entry = None if view is None else self._reader.entry(view.position)
        if view is None or entry is None or view.seam is None:
            return ArcHeight()
        setup, pose = self._jobs.get(entry.job_number), entry.inputs.pose
        if setup is None or setup.missing or pose is None:
            return ArcHeight()
        if entry.job_number not in self._estimators:
            self._estimators[entry.job_number] = ArcHeightEstimator(SensorGeometry.of(setup))
        return self._estimators[entry.job_number].of_track(entry.frame, pose, view.seam, view.track)

    def _look_at_the_gap(self) -> str:
        # It is loaded once there is a gap: it takes a second, and most runs have none.
        from sim_to_real.first_look import first_look

        setup = self._jobs.get(self._job_number)
        if setup is None or setup.missing:
            return ""
        chosen = self._frames_of_the_gap()
        if len(chosen) < MIN_LOOK_FRAMES:
            return ""
        poses = {entry.frame.timestamp_s: entry.inputs.pose for entry in chosen}
        try:
            look = first_look(setup, [entry.frame for entry in chosen], poses.get)
        except ValueError as error:
            return f"no look at it: {error}"
        if not look.is_gap:
            # Values within the setup's tolerances explain it: from here on only a change is a gap.
            self._watch.accept()
            return ""
        likely = " or ".join(name.replace("_", " ") for name in look.likely)
        return f"looks like {likely}" if likely else "looks like nothing that is known"

    def _frames_of_the_gap(self) -> list[Entry]:
        """Return entries since the gap began, evenly chosen, with laser, arc and a pose."""
        positions = range(self._reader.first, self._reader.count)
        held = []
        for position in positions[:: max(1, len(positions) // (8 * LOOK_FRAMES))]:
            entry = self._reader.entry(position)
            if (
                entry is not None
                and entry.job_number == self._job_number
                and entry.frame.timestamp_s >= self._watch.since_s
                and entry.inputs.pose is not None
                and entry.frame.arc_on
                and entry.frame.laser_on
            ):
                held.append(entry)
        return held[:: max(1, len(held) // LOOK_FRAMES)][:LOOK_FRAMES]
