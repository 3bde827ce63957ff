"""A frame's explanation in words: the verdict, and the tests of the frame, in the step's order."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from arctrack.diagnose.pages.words import listed, number, percent
from arctrack.replay.explain_lines import NO_FIT, NO_PATH, ODD_WIDTH, TOO_WEAK, UNLIT
from tracker import flags
from tracker.checks import Check, Question
from tracker.flags import Flag
from tracker.seam.correction import UNSTATED
from tracker.stripe.line_fit.block import MIN_SIGNIFICANCE

if TYPE_CHECKING:
    from arctrack.replay.explain import Explanation

REFUSALS = {
    UNLIT: "the laser's fan does not reach it",
    NO_PATH: "the likeliest path passes over it: no candidate there is worth the way",
    NO_FIT: "the fit ran away, or too few pixels count: an edge, saturation, the band's end",
    TOO_WEAK: f"what the fit found is less than {MIN_SIGNIFICANCE:g} of its own σ high",
    ODD_WIDTH: "its width is none that the stripe has: two faces, or no stripe",
}
"""Why a scan line holds no stripe."""


def headline(explanation: Explanation) -> str:
    """Return the verdict in one sentence."""
    track = explanation.track
    if track.valid:
        _, y, z = track.seam_tool_mm
        return (
            f"Frame {track.frame}: the seam is at y {pm(y, track.sigma_y_mm)}, "
            f"z {pm(z, track.sigma_z_mm)} mm in the tool frame (1 σ of measurement and calibration)."
        )
    why = listed([flag.meaning for flag in raised(track.flags) if flag.invalidates], "and")
    verb = "shows a seam that is not used" if math.isfinite(track.seam_tool_mm[1]) else "gives no seam"
    return f"Frame {track.frame} {verb}: {why}."


def offset_sentence(explanation: Explanation) -> str:
    """Return what the frame leaves for the torch, in one sentence."""
    track = explanation.track
    axes = (
        ("y", track.offset_y_mm, track.offset_sigma_y_mm),
        ("z", track.offset_z_mm, track.offset_sigma_z_mm),
    )
    known = ", ".join(f"{name} {pm(value, sigma)}" for name, value, sigma in axes if math.isfinite(value))
    if not known:
        return "It gives no offset for the torch."
    if explanation.recording.correction != UNSTATED:
        return f"For the torch it proposes {known} mm, with what [follow] says of gain, bias and limits."
    return f"At the torch the seam lies {known} mm off the programmed path (1 σ of the measurement)."


def places(explanation: Explanation) -> list[tuple[str, str, str, str]]:
    """Return the seam's position in each coordinate frame: the frame, its origin, y and z in mm."""
    track, rows = explanation.track, []
    _, y, z = track.seam_tool_mm
    if math.isfinite(y):
        origin = "from the electrode's working point; x along the travel"
        rows.append(("tool frame", origin, pm(y, track.sigma_y_mm), pm(z, track.sigma_z_mm)))
    if (
        explanation.look is not None
        and explanation.look.seam is not None
        and explanation.look.joint is not None
    ):
        seam, joint = explanation.look.seam, explanation.look.joint
        y_sigma, z_sigma = np.sqrt(seam.variance_mm2)
        origin = "from where the seam was expected, across it and along the surface normal"
        rows.append(("profile", origin, pm(joint.y_mm, y_sigma), pm(joint.z_mm, z_sigma)))
        y, z = seam.displacement_mm
        origin = f"from the programmed path, where the stripe crosses it at {seam.station_mm:.1f} mm"
        rows.append(("path, at the stripe", origin, pm(y, y_sigma), pm(z, z_sigma)))
    if math.isfinite(track.offset_y_mm) or math.isfinite(track.offset_z_mm):
        assert explanation.look is not None
        origin = (
            f"from the programmed path, where the torch stands at {explanation.look.torch_station_mm:.1f} mm"
        )
        y_text = pm(track.offset_y_mm, track.offset_sigma_y_mm) if math.isfinite(track.offset_y_mm) else "–"
        z_text = pm(track.offset_z_mm, track.offset_sigma_z_mm) if math.isfinite(track.offset_z_mm) else "–"
        rows.append(("path, at the torch", origin, y_text, z_text))
    return rows


def own_sigma(explanation: Explanation) -> str:
    """Return the measurement's part of the seam's sigma, mm; nothing without a seam."""
    if explanation.look is None or explanation.look.seam is None:
        return ""
    y, z = np.sqrt(explanation.look.seam.variance_mm2)
    return (
        f"Of the seam's σ {number(y)} mm in y and {number(z)} mm in z are of the measurement; "
        "the rest is of the calibration, as [tolerance] states it, much the same in all frames."
    )


def condition(explanation: Explanation) -> str:
    """Return what the frame was taken under."""
    frame = explanation.frame
    lit = [name for name, on in (("laser on", frame.laser_on), ("arc on", frame.arc_on)) if on]
    current = f", {frame.current_a:.0f} A" if frame.arc_on and math.isfinite(frame.current_a) else ""
    return (
        f"at {frame.timestamp_s:.3f} s, {' and '.join(lit) or 'laser and arc off'}{current}, "
        f"{1000 * frame.exposure_s:g} ms; before it the tracker had seen "
        f"{counted(explanation.before.frames, 'frame')} and knew the seam at "
        f"{counted(explanation.before.history.n, 'place')}"
    )


def raised(track_flags: int) -> tuple[Flag, ...]:
    """Return the flags that are set, those that invalidate the seam first."""
    raised_flags = (flag for flag in flags.FLAGS if track_flags & flag.mask)
    return tuple(sorted(raised_flags, key=lambda flag: not flag.invalidates))


def by_severity(checks: Iterable[Check]) -> list[Check]:
    """Return a frame's answers, those that refuse its seam first, then those that flag it; each in order."""
    return sorted(checks, key=lambda check: ("refused", "noted", "passed").index(check.outcome))


def value_text(check: Check) -> str:
    """Return what a frame answered to a question, with its unit."""
    if check.question.demand == "yes":
        return "yes" if check.passed else "no"
    return _quantity(check.question, check.value)


def limit_text(check: Check) -> str:
    """Return what a question demands."""
    if check.question.demand == "yes":
        return "yes"
    return f"{check.question.demand.replace('_', ' ')} {_quantity(check.question, check.limit)}"


def outcome_text(check: Check) -> str:
    """Return what an answer means, with the flag of one that failed."""
    return check.outcome if check.passed else f"{check.outcome}: {check.flag.name}"


def _quantity(question: Question, value: float) -> str:
    if math.isnan(value):
        return "not known"
    if math.isinf(value):
        return "without limit" if value > 0.0 else number(value)
    match question.unit:
        case "mm":
            return f"{value:.2f} mm".replace("-", "−")
        case "share":
            return percent(value)
        case "lines":
            return f"{value:.0f}"
        case _:
            return number(value)


def arc_sentence(explanation: Explanation) -> str:
    """Return what the arc costs: its share of the stripe's sigma."""
    if (
        explanation.look is None
        or explanation.look.stripe is None
        or explanation.track.flags & flags.STRIPE_LOST.mask
    ):
        return ""
    if not explanation.use_arc_map:
        return (
            "Without the arc map one variance stands for all pixels, and the arc's share in it is not known."
        )
    parts, sigma = explanation.look.stripe.parts, explanation.look.stripe.reading.stripe.sigma_px
    if not np.isfinite(sigma).any():
        return ""
    share = float(np.nanmedian(parts.arc_share))
    typical = number(float(np.nanmedian(sigma)))
    contradicts = flags.ARC_LEVEL_UNKNOWN.mask | flags.MAP_MISFIT.mask
    if not explanation.look.reading.arc.is_on and explanation.track.flags & contradicts:
        return (
            "The frame contradicts the arc map and shows no seam over it. So the stripe was read over an "
            f"even background: σ is {typical} px in the median scan line."
        )
    if explanation.track.flags & flags.ARC_OFF.mask:
        return f"There is no arc light to read through: σ is {typical} px in the median scan line."
    without = float(np.nanmedian(sigma * np.sqrt(1.0 - parts.arc_share)))
    return (
        f"The arc makes up {percent(share)} of the stripe's variance in the median scan line: σ is "
        f"{typical} px and would be {number(without)} px without it."
    )


def refused_lines(explanation: Explanation) -> list[tuple[str, str, int]]:
    """Return why scan lines hold no stripe: the reason, in words, and how many."""
    if explanation.look is None or explanation.look.stripe is None:
        return []
    refused = explanation.look.stripe.refusals.why
    counts = [(name, words, int((refused == name).sum())) for name, words in REFUSALS.items()]
    return [row for row in counts if row[2]]


def scan_line(explanation: Explanation) -> str:
    """Return what a scan line is in the image."""
    return "column" if explanation.geometry.along_rows else "row"


def pm(value: float, sigma: float) -> str:
    """Return value ± sigma, both to the sigma's second digit, with a sign."""
    decimals = min(4, max(0, 1 - math.floor(math.log10(sigma)))) if 0.0 < sigma < math.inf else 3
    return f"{value:+.{decimals}f} ± {sigma:.{decimals}f}".replace("-", "−")


def counted(count: int, what: str) -> str:
    """Return a number of things."""
    return f"{count} {what}" + ("" if count == 1 else "s")
