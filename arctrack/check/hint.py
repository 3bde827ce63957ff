"""Likeliest mistake in a recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from arctrack.check.case import CheckCase
from arctrack.check.fit import LinePoints
from arctrack.check.mistakes import Mistake, common_mistakes, focal_lengths
from noise_model.setup import Setup
from tracker.joint.type_check import FAMILIES, JointFamily, family_of

FITS, GAIN = 0.8, 0.15
"""The share of a line's points that lies on the section where all is right, and what undoing must gain."""

EQUAL_SHARE = 0.02
"""Shares that differ by less are the same."""

MIN_SHOWN, SHOWN_SHARE = 2, 0.3
"""Least number of frames, and least share of them, that show another joint."""


@dataclass(frozen=True)
class Hint:
    """Likeliest mistake, and its cure; `case` is the one without that mistake.

    `share` of the bright lines' points then lie on the joint; without a case, it is that of the frames that
    show another joint.
    """

    what: str
    cure: str
    share: float
    case: CheckCase | None = None

    def __str__(self) -> str:
        return f"{self.what}; {self.cure}"


def likely_mistake(case: CheckCase, joint_is_seen: bool = False) -> Hint | None:
    """Return the mistake without which the lines lie where the stripe should be, None for none known.

    `joint_is_seen` says that the tracker finds the stated joint: then its type is not doubted.
    """
    stated = case.fit() if case.fits_camera else None
    share = 0.0 if stated is None else stated.share
    hint = None
    if share <= 1.0 - GAIN:
        hint = either(_explaining(case, common_mistakes(case.T_tool_controllertool), share))
    if hint is None and stated is not None and not joint_is_seen:
        hint = _joint_hint(case.setup, stated.lines)
    if hint is None and share <= 1.0 - GAIN:
        fitting = _explaining(case, focal_lengths(case.setup.camera), share)
        hint = fitting[len(fitting) // 2] if fitting else None
    return hint


def either(hints: Sequence[Hint]) -> Hint | None:
    """Return the first hint; its cure names the second too, which explains a recording as well."""
    if not hints:
        return None
    first, *others = hints
    return replace(first, cure=f"{first.cure}; or else {others[0]}") if others else first


def _explaining(case: CheckCase, mistakes: Sequence[Mistake], stated_share: float) -> list[Hint]:
    """Return the mistakes without which most points lie on the section, the commonest first."""
    hints = []
    for mistake in mistakes:
        undone = mistake.undo(case)
        if undone is None or not undone.fits_camera:
            continue
        try:
            hints.append(Hint(mistake.what, mistake.cure, undone.fit().share, undone))
        except ValueError:
            # Numbers that no setup can hold.
            continue
    most = max((hint.share for hint in hints), default=0.0)
    if most < max(FITS, stated_share + GAIN):
        return []
    return [hint for hint in hints if hint.share >= most - EQUAL_SHARE]


def _joint_hint(setup: Setup, lines: Sequence[LinePoints]) -> Hint | None:
    """Return the hint to the joint's type if the lines show another one."""
    if setup.joint.type == "flat":
        return Hint("[joint] type = 'flat': a plate has no seam", "recording.toml: state the joint", 0.0)
    stated = family_of(setup.joint)
    counts = Counter(line.family for line in lines)
    # Where the arc outshines a joint's faces a plate is left.
    for nothing in (None, JointFamily.FLAT):
        counts.pop(nothing, None)
    if not counts or stated is None:
        return None
    family, count = counts.most_common(1)[0]
    if (
        family is None
        or family is stated
        or count < max(min(MIN_SHOWN, len(lines)), SHOWN_SHARE * len(lines))
    ):
        return None
    types = [name for name, shown in FAMILIES.items() if shown is family]
    if family in (JointFamily.INSIDE_CORNER, JointFamily.OUTSIDE_CORNER):
        types = ["fillet"]
    what = f"[joint] type = {setup.joint.type!r}: {count} of {len(lines)} frames show {family.value}"
    return Hint(what, f"recording.toml: state {' or '.join(types)}", float(count) / len(lines))
