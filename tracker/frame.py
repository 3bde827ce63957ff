"""A frame tracked in one compiled call: from image and pose to the new state and the track.

There is one such call for each shape of joint, and one for its search: what joins the pieces is compiled
too. A kernel takes no other as an argument, so each shape's is written out. A frame whose seam is known goes
without the search's loop: what a loop carries on is counted at each turn, 3 to 6 % of a step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from noise_model.entry import entry_for, types_within
from noise_model.kernel import kernel
from tracker.checks import Asked
from tracker.frame_pieces import (
    BY_PIECES,
    REFUSED,
    SEARCHED,
    Begun,
    FrameGiven,
    FrameTracked,
    begin,
    end,
    look_by,
    not_tracked,
    seen_by,
)
from tracker.joint.evidence import MIN_EVIDENCE_NATS
from tracker.joint.fillet import fit_fillet
from tracker.joint.groove import fit_groove
from tracker.joint.half_v import fit_half_v
from tracker.joint.lap import fit_lap
from tracker.joint.measured import MeasuredJoint, undetermined
from tracker.joint.slot import fit_slot
from tracker.search import DONE, after_look, first_turn, settled


@kernel(allocates=True)
def track_groove(asked: Asked, given: FrameGiven) -> FrameTracked:
    """Track a frame of a groove with a bevel on either side."""
    begun, fitted = begin(asked, given), undetermined()
    if begun.ends == REFUSED:
        return not_tracked(asked, given, begun, REFUSED)
    if begun.ends == SEARCHED:
        return search_groove(asked, given, begun)
    look = look_by(asked, given, begun.aim)
    if look.is_stripe:
        fitted = fit_groove(look.section, given.stated)
    return end(asked, given, begun, seen_by(asked, given, begun.aim, look, fitted))


@kernel(allocates=True)
def search_groove(asked: Asked, given: FrameGiven, begun: Begun) -> FrameTracked:
    """Search a frame for a groove with a bevel on either side."""
    turn = first_turn(asked, given, begun)
    while turn.looks != DONE:
        look, fitted = look_by(turn.asked, given, turn.aim), undetermined()
        if look.is_stripe:
            fitted = fit_groove(look.section, given.stated)
        turn = after_look(given, begun, turn, seen_by(turn.asked, given, turn.aim, look, fitted))
    return end(asked, given, begun, settled(asked, begun, turn))


@kernel(allocates=True)
def track_lap(asked: Asked, given: FrameGiven) -> FrameTracked:
    """Track a frame of a lap, plain or corrugated."""
    begun, fitted = begin(asked, given), undetermined()
    if begun.ends == REFUSED:
        return not_tracked(asked, given, begun, REFUSED)
    if begun.ends == SEARCHED:
        return search_lap(asked, given, begun)
    look = look_by(asked, given, begun.aim)
    if look.is_stripe:
        fitted = fit_lap(look.section, given.stated)
    return end(asked, given, begun, seen_by(asked, given, begun.aim, look, fitted))


@kernel(allocates=True)
def search_lap(asked: Asked, given: FrameGiven, begun: Begun) -> FrameTracked:
    """Search a frame for a lap, plain or corrugated."""
    turn = first_turn(asked, given, begun)
    while turn.looks != DONE:
        look, fitted = look_by(turn.asked, given, turn.aim), undetermined()
        if look.is_stripe:
            fitted = fit_lap(look.section, given.stated)
        turn = after_look(given, begun, turn, seen_by(turn.asked, given, turn.aim, look, fitted))
    return end(asked, given, begun, settled(asked, begun, turn))


@kernel(allocates=True)
def track_half_v(asked: Asked, given: FrameGiven) -> FrameTracked:
    """Track a frame of a half V."""
    begun, fitted = begin(asked, given), undetermined()
    if begun.ends == REFUSED:
        return not_tracked(asked, given, begun, REFUSED)
    if begun.ends == SEARCHED:
        return search_half_v(asked, given, begun)
    look = look_by(asked, given, begun.aim)
    if look.is_stripe:
        fitted = fit_half_v(look.section, given.stated)
    return end(asked, given, begun, seen_by(asked, given, begun.aim, look, fitted))


@kernel(allocates=True)
def search_half_v(asked: Asked, given: FrameGiven, begun: Begun) -> FrameTracked:
    """Search a frame for a half V."""
    turn = first_turn(asked, given, begun)
    while turn.looks != DONE:
        look, fitted = look_by(turn.asked, given, turn.aim), undetermined()
        if look.is_stripe:
            fitted = fit_half_v(look.section, given.stated)
        turn = after_look(given, begun, turn, seen_by(turn.asked, given, turn.aim, look, fitted))
    return end(asked, given, begun, settled(asked, begun, turn))


@kernel(allocates=True)
def track_fillet(asked: Asked, given: FrameGiven) -> FrameTracked:
    """Track a frame of a fillet."""
    begun, fitted = begin(asked, given), undetermined()
    if begun.ends == REFUSED:
        return not_tracked(asked, given, begun, REFUSED)
    if begun.ends == SEARCHED:
        return search_fillet(asked, given, begun)
    look = look_by(asked, given, begun.aim)
    if look.is_stripe:
        fitted = fit_fillet(look.section, given.stated)
    return end(asked, given, begun, seen_by(asked, given, begun.aim, look, fitted))


@kernel(allocates=True)
def search_fillet(asked: Asked, given: FrameGiven, begun: Begun) -> FrameTracked:
    """Search a frame for a fillet."""
    turn = first_turn(asked, given, begun)
    while turn.looks != DONE:
        look, fitted = look_by(turn.asked, given, turn.aim), undetermined()
        if look.is_stripe:
            fitted = fit_fillet(look.section, given.stated)
        turn = after_look(given, begun, turn, seen_by(turn.asked, given, turn.aim, look, fitted))
    return end(asked, given, begun, settled(asked, begun, turn))


@kernel(allocates=True)
def track_slot(asked: Asked, given: FrameGiven) -> FrameTracked:
    """Track a frame of a butt or an edge joint.

    Of a butt joint whose gap is not told the image may show a line: that is read by pieces.
    """
    begun, fitted = begin(asked, given), undetermined()
    if begun.ends == REFUSED:
        return not_tracked(asked, given, begun, REFUSED)
    if begun.ends == SEARCHED:
        return search_slot(asked, given, begun)
    look = look_by(asked, given, begun.aim)
    if look.is_stripe:
        fitted = fit_slot(look.section, given.stated, given.image_dn, given.source.image.along_rows)
        if _may_show_line(given, fitted):
            return not_tracked(asked, given, begun, BY_PIECES)
    return end(asked, given, begun, seen_by(asked, given, begun.aim, look, fitted))


@kernel(allocates=True)
def search_slot(asked: Asked, given: FrameGiven, begun: Begun) -> FrameTracked:
    """Search a frame for a butt or an edge joint, see `track_slot`."""
    turn = first_turn(asked, given, begun)
    while turn.looks != DONE:
        look, fitted = look_by(turn.asked, given, turn.aim), undetermined()
        if look.is_stripe:
            fitted = fit_slot(look.section, given.stated, given.image_dn, given.source.image.along_rows)
            if _may_show_line(given, fitted):
                return not_tracked(asked, given, begun, BY_PIECES)
        turn = after_look(given, begun, turn, seen_by(turn.asked, given, turn.aim, look, fitted))
    return end(asked, given, begun, settled(asked, begun, turn))


@kernel
def _may_show_line(given: FrameGiven, fitted: MeasuredJoint) -> bool:
    """Say whether a stripe does not tell a joint whose line the image may show."""
    return not given.stated.is_edge and not fitted.evidence_nats >= MIN_EVIDENCE_NATS


TRACKS: Mapping[str, Callable[[Asked, FrameGiven], FrameTracked]] = {
    "v_groove": track_groove,
    "u_groove": track_groove,
    "half_v": track_half_v,
    "fillet": track_fillet,
    "butt": track_slot,
    "edge": track_slot,
    "lap": track_lap,
    "corrugation": track_lap,
}
"""What tracks a frame of a type of joint in one call."""


class FrameCall:
    """The one call of a setup's frames, which asks for the types of its arguments where they may be others.

    numba asks for the type of each number and array at each call: 45 us of a step. What is the same object as
    before has the same types, and so has a state that the call has returned.

    Parameters
    ----------
    joint_type : str
        One of TRACKS.
    given : FrameGiven
        Any frame's: the call is made for its setup, its scratch and its types.
    """

    def __init__(self, joint_type: str, given: FrameGiven) -> None:
        self._call = TRACKS[joint_type]
        once = self._call(Asked.nothing(), given)
        again = given._replace(state=once.state)
        twice = self._call(Asked.nothing(), again)
        self._types = types_within(once.state)
        returns_its_own = types_within(twice.state) == self._types
        self._entry = entry_for(self._call, Asked.nothing(), again) if returns_its_own else self._call
        self._source, self._stated, self._work = given.source, given.stated, given.work
        self._correction, self._dtype = given.correction, given.image_dn.dtype
        self._returned = twice.state

    def __call__(self, asked: Asked, given: FrameGiven) -> FrameTracked:
        """Track a frame, whose other numbers and arrays have their types by `tracker.step`."""
        is_known = (
            given.source is self._source
            and given.stated is self._stated
            and given.work is self._work
            and given.correction is self._correction
            and given.image_dn.dtype == self._dtype
            and (given.state is self._returned or types_within(given.state) == self._types)
        )
        if not is_known:
            return self._call(asked, given)
        tracked = self._entry(asked, given)
        self._returned = tracked.state
        return tracked
