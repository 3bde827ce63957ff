"""Health of a run, for whatever restarts it."""

import math

from arctrack.live.monitor.feed import Feed
from arctrack.live.monitor.words import headline
from robot_io import TrackerState

MAX_AGE_S = 1.0
"""Older statuses and frames say that the loop, or the camera, stands."""


def health_problem(feed: Feed) -> str | None:
    """Return why a run does not work, None where it does."""
    status = feed.status
    if status is None:
        return "the tracker has not said yet how it stands"
    if not feed.is_alive:
        return "the tracker's process has ended"
    if feed.status_age_s > MAX_AGE_S:
        return f"the tracker has said nothing for {feed.status_age_s:.1f} s"
    if status.state is TrackerState.FAULT:
        return f"FAULT, {status.fault.name}: {headline(status.state, status.fault, status.reason)}"
    if math.isnan(feed.frame_age_s):
        return "no frame has come yet"
    if feed.frame_age_s > MAX_AGE_S:
        return f"no frame has come for {feed.frame_age_s:.1f} s"
    return None
