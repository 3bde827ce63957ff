"""applied.html: how far effects that were added to a setup close the gap, to be read in ten seconds."""

from pathlib import Path

from arctrack.diagnose.applied_files import AppliedEffects
from arctrack.diagnose.diagnosis_files import ADDED_JSON, ADDED_NPZ
from arctrack.diagnose.pages import words
from arctrack.diagnose.pages.page import frame_pictures, telling_frame
from arctrack.output import write_whole
from arctrack.report.template import environment
from sim_to_real.evidence.policy import POLICY

CLOSED, IN_PART, NOT_CLOSED, NO_GAP_THERE = "gap closed", "closed in part", "not closed", "no gap to close"
"""Outcomes of adding effects to a setup."""

MARKS = {CLOSED: "effects", IN_PART: "ambiguous", NOT_CLOSED: "unknown", NO_GAP_THERE: "no_gap"}
"""Colour of each outcome."""


def write_applied_page(applied: AppliedEffects, path: Path) -> None:
    """Write the page to a file; ArctrackError if it cannot be written."""
    write_whole(path, page(applied))


def page(applied: AppliedEffects) -> str:
    """Return the page, which needs no other file and no network."""
    pages = environment()
    pages.globals.update(words=words)
    gap, predicted = applied.gap, applied.predicted
    largest = max(gap.before, gap.after, gap.floor, 1e-9)
    return pages.get_template("applied.html.j2").render(
        applied=applied,
        gap=gap,
        label=outcome(applied),
        mark=MARKS[outcome(applied)],
        headline=headline(applied),
        counted=counted(applied),
        with_what=added(applied),
        shown=frame_pictures(predicted, telling_frame(predicted), applied.setup.sensor),
        bars=[
            (f"without {added(applied)}", gap.before, gap.before / largest),
            (f"with {added(applied)}", gap.after, gap.after / largest),
            ("the model's own error", gap.floor, gap.floor / largest),
        ],
        bears_mm=applied.setup.tolerance.seam_mm,
        files=(ADDED_JSON, ADDED_NPZ),
    )


def outcome(applied: AppliedEffects) -> str:
    """Return the outcome of adding the effects, a key of `MARKS`."""
    gap = applied.gap
    if gap.before <= gap.floor and gap.after <= gap.floor:
        return NO_GAP_THERE
    if gap.explains_nothing or not gap.after < gap.before:
        return NOT_CLOSED
    is_all = gap.closed >= POLICY.explained or gap.after <= gap.floor
    return CLOSED if is_all else IN_PART


def headline(applied: AppliedEffects) -> str:
    """Return in one sentence how far the effects close the gap."""
    gap, what = applied.gap, added(applied)
    sizes = f"{words.sigmas(gap.before)} without, {words.sigmas(gap.after)} with"
    floor = f"the model's own error is {words.sigmas(gap.floor)}"
    if outcome(applied) == NO_GAP_THERE:
        return f"{applied.on} has no gap, with {what} or without: {sizes}; {floor}."
    if outcome(applied) == NOT_CLOSED and gap.before <= gap.floor:
        return f"{what} makes a gap on {applied.on}, which has none without: {sizes}; {floor}."
    if outcome(applied) == NOT_CLOSED:
        grows = "makes the gap larger" if gap.after > gap.before else "does not close the gap"
        return f"{what} {grows} on {applied.on}: {sizes}; {floor}. Its cause there is another one."
    part = "" if outcome(applied) == CLOSED else "a part of "
    return (
        f"{what} closes {part}the gap on {applied.on}, from {words.sigmas(gap.before)} to "
        f"{words.sigmas(gap.after)}: {words.closed_share(gap)} of what exceeds the model's own error of "
        f"{words.sigmas(gap.floor)}."
    )


def counted(applied: AppliedEffects) -> str:
    """Return which frames were predicted, and what was fitted to which others."""
    n, fitted = len(applied.predicted.frames), applied.n_fitted
    if applied.is_other:
        return (
            f"Measured on {n} frames of {applied.on}. The effect comes from {applied.fitted_on} as it is; "
            f"nuisances within their tolerances were fitted anew, both times, to {fitted} other frames."
        )
    return (
        f"Measured on {n} frames of {applied.on} that were held out; the effect was fitted to its {fitted} "
        "other frames. --on RECORDING tries it on a recording that no fit has seen."
    )


def added(applied: AppliedEffects) -> str:
    """Return the names of the effects that were added."""
    return words.listed([effect.id for effect in applied.effects], "and")
