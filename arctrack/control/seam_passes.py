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
from arctrack.recording.seam_file import check_can_keep, read_seam, write_seam
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

    Live, the earlier pass's seam must be a live run's, and not older than the job states as the pass begins:
    another part may lie there by now. `problem` says why the earlier pass is unusable, None where it is not.
    Raises ArctrackError for a weld schedule that is wrong, and where the seam cannot be kept.
    """

    def __init__(
        self,
        job: CellJob,
        geometry: SensorGeometry,
        is_live: bool = False,
        now: Callable[[], datetime] = utc_now,
    ) -> None:
        self.problem: str | None = None
        self._has_warned = False
        self._job, self._geometry, self._now = job, geometry, now
        if job.keep_seam is not None:
            check_can_keep(job.keep_seam)
        self._schedule = None if job.schedule is None else read_schedule(job.schedule)
        self._is_live = is_live
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

    @property
    def is_outdated(self) -> bool:
        """True once the seam of the earlier pass has become too old for a pass to begin with it."""
        again, laid = self._job.again, self._laid
        if not self._is_live or again is None or laid is None:
            return False
        try:
            _check_age(again, laid.kept_at, self._now())
        except ArctrackError:
            return True
        return False

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
            # A pass that is cut short must not leave the seam of the part before.
            try:
                self._job.keep_seam.unlink(missing_ok=True)
            except OSError as error:
                # The robot must be answered all the same.
                warnings.warn(
                    f"{self._job.keep_seam}: is of the part before, and cannot be removed: {error.strerror}",
                    stacklevel=2,
                )

    def finish(self) -> None:
        """End a pass: its seam goes to its file, if it was measured."""
        kept_at = self._now() if self._is_live else None
        kept = None if self._job.keep_seam is None else self._recorder.kept(kept_at)
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
        laid = read_laid(again, self._geometry)
        if self._is_live:
            _check_age(again, laid.kept_at, self._now())
        return laid


def read_laid(again: AgainChoice, geometry: SensorGeometry) -> LaidSeam:
    """Return an earlier pass's seam along a job's line.

    ArctrackError names the file, the key and the cure where it is unusable.
    """
    kept = read_seam(again.seam)
    try:
        return lay_seam(kept, geometry, again)
    except ValueError as error:
        raise in_file(again.seam, str(error)) from None


def _check_age(again: AgainChoice, kept_at: datetime | None, now: datetime) -> None:
    """Raise ArctrackError for a seam that a live run cannot follow, by when it was kept."""
    if kept_at is None:
        raise in_file(again.seam, "kept_at: null, a replay has kept it; track the earlier pass on this part")
    age_s = (now - kept_at).total_seconds()
    if not 0.0 <= age_s <= again.max_age_s:
        raise in_file(
            again.seam,
            f"kept_at: is {age_s:.0f} s ago, [again] max_age_s is {again.max_age_s:g}; "
            "track the earlier pass on this part",
        )
