"""A frame's explanation in words: the verdict, and what was asked of the frame, in the step's order."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from arctrack.explain import Explanation, Look, SeamLook
from arctrack.explain_lines import NO_FIT, NO_PATH, ODD_WIDTH, READ, TOO_WEAK
from arctrack.report.diagnosis.words import listed, number, percent
from tracker import flags
from tracker.flags import Flag
from tracker.measure import (
    ARC_OFF_SIGMAS,
    GOOD_SHARE,
    JOINT_CHI2_LIMIT,
    LEAST_MARGIN_MM,
    MIN_SHARE,
    MISFIT_LIMIT,
    SEARCH_REACH_MM,
    UNEXPLAINED_LIMIT,
)
from tracker.seam.correction import UNSTATED
from tracker.step import JUMP_FLOOR_MM, JUMP_SIGMAS
from tracker.stripe.detection import LEAST_RATIO, LEAST_SEEN, evidence_ratio, path_of, seen_share
from tracker.stripe.fit import MIN_SIGNIFICANCE, WIDTH_LIMIT_LN

REFUSALS = {
    NO_PATH: "the likeliest path passes over it: no candidate there is worth the way",
    NO_FIT: "the fit ran away, or too few pixels count: an edge, saturation, the band's end",
    TOO_WEAK: f"what the fit found is less than {MIN_SIGNIFICANCE:g} of its own σ high",
    ODD_WIDTH: f"its width is off by a factor of {math.exp(WIDTH_LIMIT_LN):.1f}: two faces, or no stripe",
}
"""Why a scan line holds no stripe."""

AT_TORCH = (
    flags.OFFSET_EXTRAPOLATED,
    flags.OFFSET_UNKNOWN,
    flags.OFFSET_HELD,
    flags.OFFSET_LIMITED,
    flags.FOLLOW_STOPPED,
    flags.BEFORE_JOINT,
    flags.PAST_JOINT,
)
"""What may be said of the offset."""


@dataclass(frozen=True)
class Gate:
    """One thing that the step asked of a frame: what it found, what it asks for, and the flags raised."""

    question: str
    found: str
    asked: str
    raised: tuple[Flag, ...] = ()

    @property
    def outcome(self) -> str:
        """What it means for the seam: `passed`, `noted` or `refused`."""
        if not self.raised:
            return "passed"
        return "refused" if any(flag.invalidates for flag in self.raised) else "noted"


def headline(of: Explanation) -> str:
    """Return the verdict in one sentence."""
    track = of.track
    if track.valid:
        _, y, z = track.seam_tool_mm
        return (
            f"Frame {track.frame}: the seam is at y {pm(y, track.sigma_y_mm)}, "
            f"z {pm(z, track.sigma_z_mm)} mm in the tool frame."
        )
    why = listed([flag.meaning for flag in raised(track.flags) if flag.invalidates], "and")
    verb = "shows a seam that is not used" if math.isfinite(track.seam_tool_mm[1]) else "gives no seam"
    return f"Frame {track.frame} {verb}: {why}."


def offset_sentence(of: Explanation) -> str:
    """Return what the frame leaves for the torch, in one sentence."""
    track = of.track
    axes = (
        ("y", track.offset_y_mm, track.offset_sigma_y_mm),
        ("z", track.offset_z_mm, track.offset_sigma_z_mm),
    )
    known = ", ".join(f"{name} {pm(value, sigma)}" for name, value, sigma in axes if math.isfinite(value))
    if not known:
        return "It gives no offset for the torch."
    if of.recording.correction != UNSTATED:
        return f"For the torch it proposes {known} mm, with what [follow] says of gain, bias and limits."
    return f"At the torch the seam lies {known} mm off the programmed path."


def own_sigma(of: Explanation) -> str:
    """Return which part of the seam's sigma is the measurement's own; nothing without a seam."""
    if of.look is None or of.look.seam is None:
        return ""
    y, z = np.sqrt(of.look.seam.variance_mm2)
    return (
        f"Of the seam's σ {number(y)} mm in y and {number(z)} mm in z are the measurement's own; "
        "the rest is the stated hand-eye tolerance, much the same in all frames."
    )


def condition(of: Explanation) -> str:
    """Return what the frame was taken under."""
    frame = of.frame
    lit = [name for name, on in (("laser on", frame.laser_on), ("arc on", frame.arc_on)) if on]
    current = f", {frame.current_a:.0f} A" if frame.arc_on and math.isfinite(frame.current_a) else ""
    return (
        f"at {frame.timestamp_s:.3f} s, {' and '.join(lit) or 'laser and arc off'}{current}, "
        f"{1000 * frame.exposure_s:g} ms; before it the tracker had seen "
        f"{counted(of.before.frames, 'frame')} and knew the seam at "
        f"{counted(len(of.before.history), 'place')}"
    )


def raised(track_flags: int) -> tuple[Flag, ...]:
    """Return the flags that are set."""
    return tuple(flag for flag in flags.FLAGS if track_flags & flag.mask)


def gates(of: Explanation) -> list[Gate]:
    """Return what the step asked of a frame, as far as it went."""
    asked = list(_gates(of))
    return asked if of.look is None else [*asked, _at_torch(of, of.look)]


def arc_sentence(of: Explanation) -> str:
    """Return what the arc costs: its share of the stripe's sigma."""
    if of.look is None or of.look.stripe is None or of.track.flags & flags.STRIPE_LOST.mask:
        return ""
    if not of.use_arc_map:
        return (
            "Without the arc map one variance stands for all pixels, and the arc's share in it is not known."
        )
    parts = of.look.stripe.parts
    sigma = np.sqrt(parts.variance_px2)
    if not np.isfinite(sigma).any():
        return ""
    share = float(np.nanmedian(parts.arc_share))
    typical = number(float(np.nanmedian(sigma)))
    if of.track.flags & flags.ARC_OFF.mask:
        return f"There is no arc light to read through: σ is {typical} px in the median scan line."
    without = float(np.nanmedian(sigma * np.sqrt(1.0 - parts.arc_share)))
    return (
        f"The arc makes up {percent(share)} of the stripe's variance in the median scan line: σ is "
        f"{typical} px and would be {number(without)} px without it."
    )


def refused_lines(of: Explanation) -> list[tuple[str, str, int]]:
    """Return why scan lines hold no stripe: the reason, in words, and how many."""
    if of.look is None or of.look.stripe is None:
        return []
    refused = of.look.stripe.refusals.why
    counts = [(name, words, int((refused == name).sum())) for name, words in REFUSALS.items()]
    return [row for row in counts if row[2]]


def scan_line(of: Explanation) -> str:
    """Return what a scan line is in the image."""
    return "column" if of.geometry.along_rows else "row"


def pm(value: float, sigma: float) -> str:
    """Return value ± sigma, both to the sigma's second digit, with a sign."""
    decimals = min(4, max(0, 1 - math.floor(math.log10(sigma)))) if 0.0 < sigma < math.inf else 3
    return f"{value:+.{decimals}f} ± {sigma:.{decimals}f}".replace("-", "−")


def counted(count: int, what: str) -> str:
    """Return a number of things."""
    return f"{count} {what}" + ("" if count == 1 else "s")


def signed(value: float) -> str:
    """Return a length in mm to a hundredth, with a sign."""
    return f"{value:+.2f}".replace("-", "−")


def _gates(of: Explanation) -> Iterator[Gate]:
    track, look = of.track, of.look

    def those(*asked: Flag) -> tuple[Flag, ...]:
        return tuple(flag for flag in asked if track.flags & flag.mask)

    how = "none" if of.pose is None else "extrapolated" if of.pose.extrapolated else "between two"
    if of.pose is None:
        yield Gate("a pose at the frame's time", how, "near enough in time", those(flags.POSE_REFUSED))
        return
    yield Gate("a pose at the frame's time", how, "near enough in time", those(flags.POSE_EXTRAPOLATED))
    if look is None:
        blind = those(flags.POSE_REFUSED, flags.BELOW_SURFACE, flags.SEAM_OUT_OF_VIEW, flags.SEAM_REVERSED)
        limit = "sheet across the seam, laser above it and ahead of the torch"
        yield Gate("the joint before the sensor", "no", limit, blind)
        return
    yield _where(of, look, those(flags.SEARCHED))
    if look.expected is None:
        no_view = those(flags.BELOW_SURFACE, flags.STRIPE_LOST)
        yield Gate("the expected stripe in the image", "no", "somewhere in it", no_view)
        return
    arc = look.reading.arc
    level = (
        f"{pm(arc.level, arc.sigma)} of the expected".removeprefix("+")
        if math.isfinite(arc.level)
        else "not known"
    )
    off = those(flags.ARC_OFF, flags.ARC_LEVEL_UNKNOWN)
    yield Gate("light of the arc, off the stripe", level, f"more than {ARC_OFF_SIGMAS:g} σ", off)
    if math.isfinite(arc.misfit):
        misfit = those(flags.MAP_MISFIT)
        yield Gate("misfit of the arc map", number(arc.misfit), f"up to {MISFIT_LIMIT:g}", misfit)
    if look.stripe is None:
        yield Gate("the laser", "off", "on", those(flags.LASER_OFF))
        return
    yield from _stripe_gates(
        look,
        those(flags.STRIPE_LOST, flags.STRIPE_PARTIAL),
        those(flags.SATURATED),
        those(flags.TWO_STRIPES),
    )
    if track.flags & flags.STRIPE_LOST.mask:
        return
    joint, profile = look.joint, look.profile
    what = of.geometry.setup.joint.type.replace("_", "-")
    if look.reading.reach_mm == SEARCH_REACH_MM:
        other = those(flags.JOINT_TYPE_MISMATCH)
        yield Gate("another type of joint", "decidedly" if other else "not decidedly", "no", other)
    if joint is None or profile is None:
        yield Gate(f"a {what} in the profile", "no", "its faces seen", those(flags.JOINT_NOT_FOUND))
        return
    yield Gate(f"a {what} in the profile", "yes", "its faces seen")
    yield Gate(
        "the joint's place in the profile",
        f"y {signed(joint.y_mm)} mm in {signed(profile.y_mm[0])} to {signed(profile.y_mm[-1])} mm",
        f"more than {LEAST_MARGIN_MM:g} mm off its ends",
        those(flags.SEAM_OUT_OF_VIEW),
    )
    if look.seam is None:
        return
    found = f"{number(joint.chi2)}; {percent(joint.unexplained)} of the points near the seam lie off it"
    limit = f"up to {JOINT_CHI2_LIMIT:g}; up to {percent(UNEXPLAINED_LIMIT)}"
    yield Gate("χ² of the joint's fit, per point", found, limit, those(flags.JOINT_MISFIT))
    yield _jump(of, look.seam, those(flags.SEAM_JUMP))


def _where(of: Explanation, look: Look, searched: tuple[Flag, ...]) -> Gate:
    place = f"±{look.reading.reach_mm:.2f} mm (±{look.reach_px:.0f} px) about "
    if searched and look.reading.reach_mm < SEARCH_REACH_MM:
        place += f"where a search over ±{SEARCH_REACH_MM:g} mm had found it"
    elif len(of.before.history):
        place += "where the earlier frames put it"
    else:
        place += "its nominal place"
    return Gate("where the stripe was looked for", place, "–", searched)


def _stripe_gates(
    look: Look, too_few: tuple[Flag, ...], saturated: tuple[Flag, ...], second_flag: tuple[Flag, ...]
) -> Iterator[Gate]:
    assert look.stripe is not None
    count = int(look.stripe.reading.stripe.saturated.sum())
    yield Gate("scan lines with saturated pixels in the stripe", str(count), "none", saturated)
    read = look.stripe.refusals.why == READ
    assert look.expected is not None
    crossed = max(int(look.expected.shown.sum()), 1)
    found = f"{read.sum()} of {crossed} ({percent(float(read.sum()) / crossed)})"
    asked = f"{percent(MIN_SHARE)} at least; partial below {percent(GOOD_SHARE)}"
    yield Gate("scan lines that hold a stripe", found, asked, too_few)
    reading = look.stripe.reading
    at = path_of(reading.offsets_px, look.expected.position_px, reading.stripe.position_px)
    ratio = evidence_ratio(reading.score, at, look.expected.shown)
    against = "nothing dark" if math.isinf(ratio) else number(ratio)
    outdone = too_few if ratio < LEAST_RATIO else ()
    yield Gate(
        "evidence for the stripe over that for a dark one", against, f"{LEAST_RATIO:g} at least", outdone
    )
    stripe, band = reading.stripe, reading.band
    seen = seen_share(look.expected, stripe.position_px, stripe.amplitude_e, band.variance, band.censored)
    missed = too_few if seen < LEAST_SEEN else ()
    found = "none holds it" if math.isnan(seen) else percent(seen)
    yield Gate(
        "of the scan lines that would show it clearly, hold it",
        found,
        f"{percent(LEAST_SEEN)} at least",
        missed,
    )
    second = reading.second_share
    found = f"{percent(second)} as bright: its light is taken off" if second > 0.0 else "none"
    if second == 0.0 and second_flag:
        found = "none so near; the search saw one"
    yield Gate("a second stripe beside it", found, "none", second_flag)


def _jump(of: Explanation, seam: SeamLook, jumped: tuple[Flag, ...]) -> Gate:
    question = "the seam beside where the earlier frames put it"
    if not len(of.before.history):
        return Gate(question, "no earlier frames", "–", jumped)
    off = seam.displacement_mm - seam.expected_mm
    sigmas = np.abs(off) / np.sqrt(seam.expected_sigma_mm**2 + seam.variance_mm2)
    found = f"y {signed(off[0])} mm ({sigmas[0]:.1f} σ), z {signed(off[1])} mm ({sigmas[1]:.1f} σ)"
    y, z = seam.limit_mm
    asked = f"y {y:.2f}, z {z:.2f} mm: {JUMP_SIGMAS:g} σ, at least {JUMP_FLOOR_MM:g} mm"
    return Gate(question, found, asked, jumped)


def _at_torch(of: Explanation, look: Look) -> Gate:
    open_ = tuple(flag for flag in AT_TORCH if of.track.flags & flag.mask)
    torch = look.torch_station_mm
    history = of.after.history_at(torch)
    found = "nothing is measured yet"
    if len(history):
        first, last = history.stations_mm.min(), history.stations_mm.max()
        sigma = float(history.at(torch)[1].max())
        found = f"torch at {torch:.1f} mm, measured {first:.1f} to {last:.1f} mm; σ {number(sigma)} mm"
    asked = f"within it; σ up to {of.recording.correction.extrapolate_sigma_mm:g} mm"
    return Gate("the offset at the torch", found, asked, open_)
