"""The process that keeps a live run's black box: it saves the latest frames on a fault, or on request."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path

from arctrack.black_box.save import JobSetup, NothingToSaveError, save_window
from arctrack.errors import ArctrackError
from arctrack.journal.journal import JournalReader, remove_dead_journal
from arctrack.journal.records import Status
from arctrack.journal.ring import RingError
from robot_io import Fault, GateReason, Validity

LOOK_S = 0.05
"""So often the run's status is looked at: half as long as it is written."""

AFTERMATH_S = 2.0
"""So long after a fault the window ends: what followed is of interest too. The journal has room for it."""

MIN_BETWEEN_S, MAX_FAULTS_SAVED = 60.0, 20
"""A fault that comes again fills no disk: so long between two, so many in a run. Requests are not counted."""

COMMANDED = frozenset(
    {
        GateReason.NONE,
        GateReason.NOT_ARMED,
        GateReason.EMERGENCY_STOP,
        GateReason.NOT_AUTOMATIC,
        GateReason.CORRECTION_OFF,
        GateReason.ARC_OFF,
        GateReason.NO_AXIS_ENABLED,
        GateReason.ROBOT_NOT_MOVING,
        GateReason.NOT_WELDING,
        GateReason.SEARCH_ONLY,
        GateReason.SHUTTING_DOWN,
    }
)
"""Reasons for a refusal that the robot's program or a person gives: no fault."""

END = "end"
"""What is told to a recorder whose run has ended as it should."""


@dataclass(frozen=True)
class RecorderOptions:
    """What a black box keeps, and where it goes.

    Parameters
    ----------
    run : str
        The run's name.
    folder : Path
        Where recordings go.
    kept_s : float
        How far back they reach, s.
    rate_hz : float
        The frames' rate, by which their video is played.
    jobs : mapping of int to JobSetup
        The jobs' setups.
    saves_faults : bool
        Whether faults are saved too, and not requests alone.
    """

    run: str
    folder: Path
    kept_s: float
    rate_hz: float
    jobs: Mapping[int, JobSetup]
    saves_faults: bool = True


class FaultWatch:
    """Says when a run's status shows a fault that nobody commanded."""

    def __init__(self) -> None:
        self._was_valid = False
        self._fault = Fault.NONE

    def look(self, status: Status) -> str | None:
        """Take the newest status, and return why its frames are to be saved; None while they are not."""
        before, self._fault = self._fault, status.fault
        was_valid = self._was_valid
        offset = status.offset
        self._was_valid = offset is not None and offset.validity is Validity.VALID
        if status.fault is not Fault.NONE:
            return f"fault_{status.fault.name.lower()}" if before is Fault.NONE else None
        is_refused = offset is not None and offset.validity is Validity.REFUSED
        if was_valid and is_refused and status.reason not in COMMANDED:
            return f"refused_{status.reason.name.lower()}"
        return None


def run_recorder(options: RecorderOptions, told: Connection, *asked: Connection) -> None:
    """Keep a run's black box until its other end says so, or is gone.

    Over `told` it says that it is ready. It, and each connection of `asked`, may send {"save": reason}; that
    is answered by {"saved": path} or {"error": text}. Where the run's process ends without a word, its last
    frames are saved.
    """
    reader = JournalReader(options.run)
    told.send([])
    recorder = _Recorder(options, reader)
    open_ends = [told, *asked]
    while True:
        for end in wait(open_ends, LOOK_S):
            assert isinstance(end, Connection)
            try:
                message = end.recv()
            except (EOFError, ConnectionResetError):
                open_ends.remove(end)
                if end is told:
                    if options.saves_faults:
                        recorder.save("run_ended_by_itself")
                    remove_dead_journal(options.run)
                    return
                continue
            if message == END:
                recorder.finish()
                return
            answer = recorder.save(str(message["save"]))
            with suppress(BrokenPipeError):
                end.send(answer)
        if options.saves_faults:
            recorder.look()


class _Recorder:
    def __init__(self, options: RecorderOptions, reader: JournalReader) -> None:
        self._options, self._reader = options, reader
        self._watch = FaultWatch()
        self._due: tuple[float, str] | None = None
        self._saved_s = float("-inf")
        self._faults_saved = 0

    def look(self) -> None:
        """Look at the run's status, and save what a fault has left once its aftermath is over."""
        status = self._reader.status()
        reason = None if status is None else self._watch.look(status)
        now_s = time.monotonic()
        is_rare = now_s - self._saved_s > MIN_BETWEEN_S and self._faults_saved < MAX_FAULTS_SAVED
        if reason is not None and self._due is None and is_rare:
            self._due = (now_s + AFTERMATH_S, reason)
        if self._due is not None and now_s >= self._due[0]:
            self.finish()

    def finish(self) -> None:
        """Save what waits for its aftermath."""
        if self._due is not None:
            _, reason = self._due
            self._due = None
            self._faults_saved += 1
            self.save(reason)

    def save(self, reason: str) -> dict[str, str]:
        """Save the window, and return what the one who asked is told."""
        options = self._options
        name = "".join(letter if letter.isalnum() else "_" for letter in reason)[:60]
        path = options.folder / f"{time.strftime('%Y-%m-%dT%H-%M-%S')}_{name}"
        self._saved_s = time.monotonic()
        try:
            save_window(self._reader, options.kept_s, dict(options.jobs), options.rate_hz, path, reason)
        except (NothingToSaveError, ArctrackError, OSError, RingError) as error:
            return {"error": str(error)}
        return {"saved": str(path)}
