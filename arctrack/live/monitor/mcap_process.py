"""Live runs as MCAP: a process that reads a run's journal and writes what it holds as messages over time.

So a run is open to Foxglove, and to programs beside ROS, without either in arctrack.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING

from arctrack.errors import in_file, without_extra
from arctrack.live.black_box.recorder import JobSetup
from arctrack.live.journal.journal import JournalReader
from arctrack.live.journal.records import Status
from arctrack.live.monitor.options import McapOptions
from arctrack.live.monitor.picture import RunViewers

if TYPE_CHECKING:
    from arctrack.replay.pages.mcap_file import McapFile

LOOK_S, STATE_S = 0.01, 0.2
"""Period of looking for a new frame, s, and least time between two states."""

STATE = {
    "type": "object",
    "title": "arctrack.State",
    "properties": {
        "timestamp": {
            "type": "object",
            "properties": {name: {"type": "integer"} for name in ("sec", "nsec")},
        },
        **{name: {"type": "string"} for name in ("state", "fault", "laser", "gate_reason", "command")},
        **{name: {"type": "integer"} for name in ("job_number", "frames", "valid", "dropped")},
    },
}


def run_mcap(options: McapOptions, parent: Connection) -> None:
    """Write a run's MCAP file until the parent ends it, or is gone; it is sent that the file can be written.

    Times in the file are times of day. Every frame is written that there is time for. ArctrackError where the
    package mcap is missing, or the folder cannot be written.
    """
    try:
        from arctrack.replay.pages.mcap_file import McapFile
    except ModuleNotFoundError as error:
        raise without_extra("[mcap] folder", error, "mcap") from None
    reader = JournalReader(options.run)
    path = options.folder / f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{options.run}.mcap"
    try:
        options.folder.mkdir(parents=True, exist_ok=True)
        path.touch()
    except OSError as error:
        reason = f"cannot be written: {error.strerror}; state another [mcap] folder"
        raise in_file(options.folder, reason) from None
    parent.send("")
    status = None
    while status is None:
        if wait([parent], LOOK_S):
            return
        status = reader.status()
    setups = {f"job_{number}.toml": job.toml.encode() for number, job in options.jobs.items()}
    setup = options.jobs[min(options.jobs)].setup
    late_s = status.wall_s - status.now_s
    with McapFile(path, setup, setups, status.now_s, late_s, {"run": options.run}) as file:
        bridge = _Bridge(file, reader, options.jobs)
        while not wait([parent], LOOK_S):
            bridge.look()
        bridge.look()


class _Bridge:
    """A run's way from its journal into its file."""

    def __init__(self, file: McapFile, reader: JournalReader, jobs: Mapping[int, JobSetup]) -> None:
        self._file, self._reader = file, reader
        self._viewers = RunViewers({number: job.setup for number, job in jobs.items()})
        self._position, self._state_s = -1, -math.inf

    def look(self) -> None:
        """Write the newest frame and the newest state where they are new."""
        status = self._reader.status()
        if status is not None and not 0.0 <= status.now_s - self._state_s < STATE_S:
            self._write_state(status)
        view = self._reader.newest_view()
        if view is None or view.position == self._position:
            return
        self._position = view.position
        entry = self._reader.entry(view.position)
        if entry is not None:
            self._file.add(entry.frame, *self._viewers.view(entry, view), None)

    def _write_state(self, status: Status) -> None:
        self._state_s = status.now_s
        message = {
            "state": status.state.name,
            "fault": status.fault.name,
            "laser": status.laser.name,
            "gate_reason": status.reason.name,
            "command": "" if status.command is None else status.command.command.name,
            "job_number": status.job_number,
            "frames": status.frames,
            "valid": status.valid,
            "dropped": status.dropped,
        }
        self._file.add_message("/state", STATE, message, status.now_s)
