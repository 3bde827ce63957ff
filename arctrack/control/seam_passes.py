"""Seams of a job from pass to pass: the file of an earlier pass is followed, the own seam is kept."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from datetime import UTC, datetime

from arctrack.control.cell_file import CellJob
from arctrack.control.cell_file.choices import AgainChoice
from arctrack.control.frame_tracking import PassFrame
from arctrack.control.pass_seam import LaidSeam, PassRecorder, lay_seam
from arctrack.errors import ArctrackError, in_file
from arctrack.recording.seam_file import read_seam, write_seam
from arctrack.recording.weld_schedule import WeldValues, read_schedule
from noise_model.compiled.arrays import Float64
from tracker.geometry import SensorGeometry
from tracker.seam.earlier_pass import EarlierPass
from tracker.seam.expected import torch_station_mm
from tracker.state import OffsetLookAhead


def utc_now() -> datetime:
    """Return the time of day, UTC."""
    return datetime.now(UTC)


class SeamPasses:
    """Keeper of a job's seam from pass to pass.

    With `limits_age` the earlier pass's seam must not be older than the job states: that of a live run, for
    another part may lie there by now. `problem` says why the earlier pass is unusable, None where it is not.
    Raises ArctrackError for a weld schedule that is wrong.
    """

    def __init__(
        self,
        job: CellJob,
        geometry: SensorGeometry,
        limits_age: bool = False,
        now: Callable[[], datetime] = utc_now,
    ) -> None:
        self.problem: str | None = None
        self._has_warned = False
        self._job, self._geometry, self._now = job, geometry, now
        self._schedule = None if job.schedule is None else read_schedule(job.schedule)
        self._limits_age = limits_age
        self._recorder = PassRecorder(geometry)
        self._laid: LaidSeam | None = None

    def begin(self) -> EarlierPass | None:
        """Begin a pass; return the one that it follows, without measurements if unusable, None for none."""
        self._recorder = PassRecorder(self._geometry)
        self._laid, self.problem, self._has_warned = None, None, False
        if self._job.again is None:
            return None
        try:
            self._laid = self._read()
        except ArctrackError as error:
            self.problem = str(error)
            return EarlierPass(uses_laser=self._job.again.laser)
        return self._laid.earlier

    def add(self, frame: PassFrame) -> None:
        """Take a frame whose pose is trusted; the first one without a usable earlier pass is warned of."""
        if self.problem is not None and not self._has_warned:
            self._has_warned = True
            warnings.warn(self.problem, stacklevel=2)
        if self._job.keep_seam is None and self._schedule is None:
            return
        was_empty = self._recorder.is_empty
        self._recorder.add(frame)
        if was_empty and not self._recorder.is_empty and self._job.keep_seam is not None:
            # Of a part that is not welded to its end there must be no seam of the part before.
            self._job.keep_seam.unlink(missing_ok=True)

    def finish(self) -> None:
        """End a pass: its seam goes to its file, if it was measured."""
        kept = None if self._job.keep_seam is None else self._recorder.kept(self._now())
        self._recorder = PassRecorder(self._geometry)
        if kept is None or self._job.keep_seam is None:
            return
        try:
            write_seam(self._job.keep_seam, kept)
        except ArctrackError as error:
            # The robot must be answered all the same; a pass that follows is refused.
            warnings.warn(str(error), stacklevel=2)

    def weld_at(self, T_base_tool: Float64, look_ahead: OffsetLookAhead) -> WeldValues | None:
        """Return the weld's inputs where the torch will stand, by the joint there; None without a schedule.

        What this pass has measured there comes first, then what the earlier one has.
        """
        if self._schedule is None:
            return None
        _, torch_mm = torch_station_mm(self._geometry.seam_source, T_base_tool.tolist())
        station_mm = torch_mm + look_ahead.way_mm
        gap_mm, area_mm2 = self._recorder.joint_at(station_mm)
        if self._laid is not None:
            before_mm, before_mm2 = self._laid.joint_at(station_mm)
            gap_mm = before_mm if math.isnan(gap_mm) else gap_mm
            area_mm2 = before_mm2 if math.isnan(area_mm2) else area_mm2
        return self._schedule.at(gap_mm, area_mm2)

    def _read(self) -> LaidSeam:
        """Return the earlier pass's seam; ArctrackError, with the cure, where it is unusable."""
        again = self._job.again
        assert again is not None
        now = self._now() if self._limits_age else None
        return read_laid(again, self._geometry, now)


def read_laid(again: AgainChoice, geometry: SensorGeometry, now: datetime | None = None) -> LaidSeam:
    """Return an earlier pass's seam along a job's line, not older than the job states where `now` is known.

    ArctrackError names the file, the key and the cure where it is unusable.
    """
    kept = read_seam(again.seam)
    age_s = 0.0 if now is None else (now - kept.kept_at).total_seconds()
    if not 0.0 <= age_s <= again.max_age_s:
        raise in_file(
            again.seam,
            f"kept_at: is {age_s:.0f} s ago, [again] max_age_s is {again.max_age_s:g}; "
            "track the earlier pass on this part",
        )
    try:
        return lay_seam(kept, geometry, again)
    except ValueError as error:
        raise in_file(again.seam, str(error)) from None
