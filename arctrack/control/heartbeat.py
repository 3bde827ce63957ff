"""Periodic messages of a tracker: the layout's version and its heartbeat."""

from dataclasses import replace

from robot_io import (
    BusMessage,
    CommandHeard,
    DbcVersion,
    Source,
    TrackerHeartbeat,
    cycle_time_s,
    dbc_version,
    message_layout,
)
from robot_io.offset_use import COUNTING
from tracker.state import NAN


class HeartbeatSchedule:
    """Schedule of version and heartbeat messages; both are due at first.

    A heartbeat is due at once where it changes whether offsets count or which command is obeyed: a robot that
    heard of it late would join in the middle of a soft start.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._due_at_s = {DbcVersion: NAN, TrackerHeartbeat: NAN}
        self._rolling = 0
        self._state_sent: tuple[bool, CommandHeard] | None = None

    def hurry(self) -> None:
        """Let the next heartbeat be due at once."""
        self._due_at_s[TrackerHeartbeat] = NAN

    def due(self, heartbeat: TrackerHeartbeat, now_s: float) -> list[BusMessage]:
        """Return version and heartbeat where their time, s, has come; the heartbeat with its number."""
        state_sent = heartbeat.state in COUNTING, heartbeat.command_heard
        if state_sent != self._state_sent:
            self._state_sent = state_sent
            self.hurry()
        due: list[BusMessage] = []
        for kind, due_at_s in self._due_at_s.items():
            cycle_s = cycle_time_s(message_layout(kind.__name__))
            # Written so that it is due at first, and where the clock has run backwards.
            if 0.0 < due_at_s - now_s <= cycle_s:
                continue
            # The beat is kept, but nothing is made up for.
            on_time = 0.0 <= now_s - due_at_s < cycle_s
            self._due_at_s[kind] = (due_at_s if on_time else now_s) + cycle_s
            due.append(dbc_version(self._source) if kind is DbcVersion else self._numbered(heartbeat))
        return due

    def _numbered(self, heartbeat: TrackerHeartbeat) -> TrackerHeartbeat:
        self._rolling = (self._rolling + 1) % 256
        return replace(heartbeat, rolling=self._rolling)
