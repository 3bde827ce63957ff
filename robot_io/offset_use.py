"""Robot's use of the offsets: when one may be used, as `docs/reference/can.md` requires of every robot."""

from robot_io.link.inbox import STALE_PERIODS, Received
from robot_io.protocol.dbc import cycle_time_s, message_layout
from robot_io.protocol.messages import CommandHeard, SeamOffset, TrackerHeartbeat, TrackerState, Validity

COUNTING = (TrackerState.SEARCHING, TrackerState.TRACKING, TrackerState.HOLDING)
"""The states in which a tracker's offsets count."""


class OffsetUse:
    """Selection of the offset that a robot may use now.

    One that counts is VALID or HELD, came in the last ten cycles, and stands on a heartbeat: the newest one
    is no later than one and a half cycles, follows the one before by one, and says that the tracker tracks.
    So a tracker that was killed ends its offsets within 150 ms, and two trackers on one bus give none.
    """

    def __init__(self) -> None:
        heartbeat, offset = (cycle_time_s(message_layout(m.__name__)) for m in (TrackerHeartbeat, SeamOffset))
        # A heartbeat that is later than 1.5 periods has been missed.
        self._max_heartbeat_age_s, self._max_offset_age_s = 1.5 * heartbeat, STALE_PERIODS * offset
        self._heartbeat: tuple[TrackerHeartbeat, float] | None = None
        self._follows = False
        self._offset: tuple[SeamOffset, float] | None = None

    def on_message(self, received: Received, now_s: float) -> None:
        """Take an accepted message.

        Parameters
        ----------
        received : Received
            The message, as an inbox accepted it.
        now_s : float
            The time of its reading, s, on the robot's clock.
        """
        message, came_at_s = received.message, now_s - received.max_age_s
        if isinstance(message, TrackerHeartbeat):
            before = self._heartbeat
            self._follows = before is not None and (message.rolling - before[0].rolling) % 256 == 1
            self._heartbeat = message, came_at_s
        elif isinstance(message, SeamOffset):
            self._offset = message, came_at_s

    def offset(self, now_s: float) -> SeamOffset | None:
        """Return the offset that counts.

        Parameters
        ----------
        now_s : float
            The time, s, on the robot's clock.

        Returns
        -------
        SeamOffset or None
            The offset to be used, None if none counts.
        """
        heartbeat = self._fresh_heartbeat(now_s)
        if heartbeat is None or self._offset is None:
            return None
        offset, offset_at_s = self._offset
        if heartbeat.state not in COUNTING:
            return None
        if not 0.0 <= now_s - offset_at_s <= self._max_offset_age_s:
            return None
        return offset if offset.validity in (Validity.VALID, Validity.HELD) else None

    def is_disarm_acknowledged(self, request_number: int, now_s: float) -> bool:
        """Return True if the tracker has acknowledged DISARM: only then may TRACK follow.

        Parameters
        ----------
        request_number : int
            That of the DISARM, new with each: no late heartbeat is taken for its answer.
        now_s : float
            The time, s, on the robot's clock.

        Returns
        -------
        bool
            True while the heartbeat that acknowledges it is fresh.
        """
        heartbeat = self._fresh_heartbeat(now_s)
        if heartbeat is None or heartbeat.request_number != request_number:
            return False
        return heartbeat.command_heard is CommandHeard.DISARM

    def _fresh_heartbeat(self, now_s: float) -> TrackerHeartbeat | None:
        if self._heartbeat is None or not self._follows:
            return None
        heartbeat, heartbeat_at_s = self._heartbeat
        return heartbeat if 0.0 <= now_s - heartbeat_at_s <= self._max_heartbeat_age_s else None
