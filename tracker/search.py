"""The looks of a search: a wide one that says where the joint is, then one where it is.

The map for another place misleads, near its edges most. So a search looks again where it has found the joint.
If the map misled the search itself, the joint is placed without it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.arrays import Float64
from noise_model.kernel import kernel
from noise_model.surface.joint import SeamLine
from tracker import checks, flags
from tracker.checks import Asked, ask_as, ask_whether, nothing_asked, take_answer
from tracker.frame_pieces import SEARCHED, Aim, Begun, FrameGiven, Seen, aim_at, nothing_seen
from tracker.geometry import SEARCH_REACH_MM, TRACK_REACH_MM
from tracker.joint.measured import undetermined
from tracker.look import MIN_HELD_SHARE
from tracker.seam.locate import locate
from tracker.stripe.scatter import Scatter

ONLY, WIDE, WIDE_WITHOUT_MAP, AT_JOINT, DONE = 0, 1, 2, 3, 4
"""Which look of a frame is next: the only one, where the seam is known, one of a search's, or none."""

_UNLIKELY = flags.JOINT_TYPE_MISMATCH.mask | flags.JOINT_MISFIT.mask
_BY_LINE = flags.SEAM_BY_LINE.mask
_SECOND = flags.TWO_STRIPES.mask


class Turn(NamedTuple):
    """Where a frame's looks stand: the next look, and what it is asked of.

    `seen` is what counts so far. Of the look that placed the joint `placed` has the answers, and `n_held` the
    number of scan lines that held a stripe.
    """

    looks: int
    asked: Asked
    aim: Aim
    seen: Seen
    placed: Asked
    n_held: int


@kernel(allocates=True)
def first_turn(asked: Asked, given: FrameGiven, begun: Begun) -> Turn:
    """Return the turn of a frame's first look."""
    is_search = begun.ends == SEARCHED
    of_look = nothing_asked() if is_search else asked
    seen = nothing_seen(of_look, given, begun)
    return Turn(WIDE if is_search else ONLY, of_look, begun.aim, seen, of_look, 0)


@kernel(allocates=True)
def after_look(given: FrameGiven, begun: Begun, turn: Turn, seen: Seen) -> Turn:
    """Return the turn after a look."""
    if turn.looks == ONLY:
        return _done(turn, seen)
    if turn.looks == AT_JOINT:
        return _done(turn, _as_placed(given, turn, seen))
    is_joint = not math.isnan(seen.joint.y_mm)
    has_stripe = seen.stripe.position_px.shape[0] > 0
    if turn.looks == WIDE and not is_joint and has_stripe and given.use_arc_map:
        aim = Aim(seen.aim.scene, seen.aim.seam, SEARCH_REACH_MM, False, seen.aim.scatter)
        asked = nothing_asked()
        return Turn(WIDE_WITHOUT_MAP, asked, aim, seen, asked, 0)
    first = seen if turn.looks == WIDE else turn.seen
    if not is_joint:
        return _done(turn, first)
    return Turn(
        AT_JOINT,
        nothing_asked(),
        _aim_at_joint(given, begun, seen),
        first,
        seen.asked,
        _lines_held(seen.stripe.position_px),
    )


@kernel(allocates=True)
def _done(turn: Turn, seen: Seen) -> Turn:
    """Return the turn after the last look, of which this counts."""
    return Turn(DONE, turn.asked, turn.aim, seen, turn.placed, turn.n_held)


@kernel(allocates=True)
def _aim_at_joint(given: FrameGiven, begun: Begun, placed: Seen) -> Aim:
    """Return the aim of the look at the joint that a wide look has placed."""
    seam, scatter = begun.aim.seam, given.state.scatter
    located = locate(
        given.source.seam,
        begun.expected.scene.T_joint_tool,
        placed.aim.scene,
        placed.joint.y_mm,
        placed.joint.z_mm,
    )
    y_mm, z_mm = located.displacement_mm
    there = SeamLine(located.station_mm, y_mm, z_mm, seam.slope_y, seam.slope_z, seam.slope_sigma)
    # A first frame's scatter is known from the look before.
    known = scatter if scatter.frames > 0 else placed.scatter
    return aim_at(given, there, TRACK_REACH_MM, given.use_arc_map, known)


@kernel(allocates=True)
def _as_placed(given: FrameGiven, turn: Turn, seen: Seen) -> Seen:
    """Return what counts after the look at the joint.

    What only a wrong map shows is no stripe: most of its lines are gone with the right one. Then this look
    counts, else one that shows no joint does not.
    """
    n_held = _lines_held(seen.stripe.position_px)
    if math.isnan(seen.joint.y_mm) and n_held >= MIN_HELD_SHARE * turn.n_held:
        return turn.seen
    # The narrow look does not see as far beside the stripe.
    take_answer(seen.asked, turn.placed, checks.JOINT_TYPE)
    if turn.placed.told[1] & _SECOND:
        take_answer(seen.asked, turn.placed, checks.SECOND_STRIPE)
    # It is the same frame's second look.
    scatter = Scatter(seen.scatter.average, given.state.scatter.frames + 1)
    return Seen(seen.asked, seen.aim, seen.arc, seen.stripe, scatter, seen.joint, seen.margin_mm)


@kernel
def _lines_held(position_px: Float64) -> int:
    """Return how many scan lines (n,) hold a stripe."""
    count = 0
    for i in range(position_px.shape[0]):
        if math.isfinite(position_px[i]):
            count += 1
    return count


@kernel(allocates=True)
def as_stated(seen: Seen) -> Seen:
    """Return what a search has shown without its joint where that is neither of its shape nor of its type.

    Of pieces of two stripes, or of one that the map has broken, a section can be made that no plate explains.
    A seam that is read off its line in the image does not stand on the section.
    """
    if math.isnan(seen.joint.y_mm):
        return seen
    is_stated = seen.asked.told[1] & (_UNLIKELY | _BY_LINE) != _UNLIKELY
    if ask_whether(seen.asked, checks.JOINT_AS_STATED, is_stated):
        return seen
    return Seen(seen.asked, seen.aim, seen.arc, seen.stripe, seen.scatter, undetermined(), seen.margin_mm)


@kernel(allocates=True)
def settled(asked: Asked, begun: Begun, turn: Turn) -> Seen:
    """Return what counts of a frame's looks; what a search's looks were asked is noted."""
    if begun.ends != SEARCHED:
        return turn.seen
    seen = as_stated(turn.seen)
    ask_as(asked, seen.asked)
    return seen
