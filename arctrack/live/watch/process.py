"""The process that watches a live run: is its map right, what does a gap look like, how high is the arc."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection

import numpy as np

from arctrack.live.journal.journal import JournalReader, gap_name
from arctrack.live.journal.records import Entry, GapReport, pack
from arctrack.live.journal.ring import RingWriter
from arctrack.live.watch.arc_height import NOT_KNOWN, ArcHeight, ArcHeightEstimator
from arctrack.live.watch.gap_watch import GapWatch
from noise_model.setup import Setup
from tracker.geometry import SensorGeometry

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
            arc_level=height.level,
            arc_level_sigma=height.level_sigma,
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
        if view is None or entry is None or not entry.frame.arc_on:
            return NOT_KNOWN
        setup, pose, seam, stripe = (
            self._jobs.get(entry.job_number),
            entry.inputs.pose,
            view.seam,
            view.track.stripe,
        )
        if setup is None or setup.missing or pose is None or seam is None:
            return NOT_KNOWN
        if entry.frame.laser_on and stripe is None:
            return NOT_KNOWN
        if entry.job_number not in self._estimators:
            self._estimators[entry.job_number] = ArcHeightEstimator(SensorGeometry.of(setup))
        estimator = self._estimators[entry.job_number]
        # Where a line shows no stripe, none is near.
        stripe_px = None if stripe is None else np.nan_to_num(stripe.position_px, nan=-1e9)
        # 2 mm off the stripe no light is the laser's.
        keep_off_px = estimator.geometry.reach_px(2.0)
        surface_mm = view.track.offset_sigma_z_mm
        return estimator.estimate(entry.frame, pose, seam, stripe_px, keep_off_px, surface_mm)

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
