"""Filter from raw frames to accepted messages: only what is ours, passes E2E and decodes gets through."""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum
from typing import TypeVar

import can

from robot_io.protocol.codec import FRAME_LENGTH, CodecError, decode, message_type_of
from robot_io.protocol.dbc import cycle_time_s, e2e_data_id, message_layout
from robot_io.protocol.messages import BusMessage, Source
from robot_io.protocol.protect import SOURCES, Checker, counter_of, source_of

M = TypeVar("M", bound=BusMessage)

STALE_PERIODS = 10
"""A message is stale when its newest accepted frame is older than this many of its cycle times."""


class SkipReason(Enum):
    """Reason for which a frame did not become a message."""

    FOREIGN = "foreign"
    WRONG_LENGTH = "wrong_length"
    E2E_ERROR = "e2e_error"
    REPEATED = "repeated"
    WRONG_SEQUENCE = "wrong_sequence"
    OTHER_SOURCE = "other_source"
    UNDECODABLE = "undecodable"


@dataclass(frozen=True)
class Received:
    """An accepted message.

    Attributes
    ----------
    timestamp_s : float
        The frame's own time, s.
    message : BusMessage
        Its content.
    counter : int
        Its E2E counter.
    source : Source
        Where what it says comes from.
    max_age_s : float
        Largest time between the frame's arrival and its reading, s.
    """

    timestamp_s: float
    message: BusMessage
    counter: int
    source: Source = Source.LIVE
    max_age_s: float = 0.0


@dataclass(frozen=True)
class Trusted:
    """Whose frames are accepted, by the sender that the layout names.

    Parameters
    ----------
    robot, tracker : collection of Source
        The sources that are accepted of each.
    """

    robot: Collection[Source] = (Source.LIVE,)
    tracker: Collection[Source] = (Source.LIVE,)


LIVE = Trusted()
"""Live frames alone."""

ANY_SOURCE = Trusted(SOURCES, SOURCES)
"""All frames, as a reader of logs takes them; `Received.source` tells them apart."""


class Inbox:
    """Checked and decoded frames: the latest message of each type, and counts of those skipped by reason."""

    def __init__(self, trusted: Trusted = LIVE) -> None:
        self._trusted = {"ROBOT": trusted.robot, "TRACKER": trusted.tracker}
        self._checker = Checker()
        self._latest: dict[type[BusMessage], Received] = {}
        self.skipped: Counter[SkipReason] = Counter()

    def receive(self, frame: can.Message, max_age_s: float = 0.0) -> Received | None:
        """Return the message of a frame, or None (counted in `skipped`) if it must not update any state.

        `max_age_s` is how long before its reading the frame came at most, s.
        """
        outcome = self._examine(frame, max_age_s)
        if isinstance(outcome, SkipReason):
            self.skipped[outcome] += 1
            return None
        self._latest[type(outcome.message)] = outcome
        return outcome

    def latest(self, message_type: type[M], now_s: float) -> M | None:
        """Return the newest message of a type, or None if there is none or it is stale at `now_s`.

        `now_s` is on the clock of the frames' timestamps. A message from as far in the future is stale as
        well: that clock was set back, and the message's age is unknown.
        """
        received = self._latest.get(message_type)
        stale_after_s = STALE_PERIODS * cycle_time_s(message_layout(message_type.__name__))
        if received is None or not abs(now_s - received.timestamp_s) <= stale_after_s:
            return None
        assert isinstance(received.message, message_type)
        return received.message

    def _examine(self, frame: can.Message, max_age_s: float) -> Received | SkipReason:
        message_type = message_type_of(frame.arbitration_id)
        special = frame.is_extended_id or frame.is_remote_frame or frame.is_error_frame or frame.is_fd
        if message_type is None or special:
            return SkipReason.FOREIGN
        if len(frame.data) != FRAME_LENGTH:
            return SkipReason.WRONG_LENGTH
        layout = message_layout(message_type.__name__)
        source = source_of(layout, frame.data)
        if source is None:
            return SkipReason.E2E_ERROR
        if source not in self._trusted[layout.senders[0]]:
            return SkipReason.OTHER_SOURCE
        status = self._checker.check(e2e_data_id(layout, source), frame.data)
        if not status.accepted:
            return SkipReason[status.name]
        try:
            message = decode(frame.arbitration_id, frame.data)
        except CodecError:
            return SkipReason.UNDECODABLE
        return Received(frame.timestamp, message, counter_of(frame.data), source, max_age_s)
