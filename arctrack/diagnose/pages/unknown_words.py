"""An unknown cause in sentences: its likeliest form, place, frames, covariate, and what comes near."""

import math

from arctrack.diagnose.pages import words
from sim_to_real.diagnosis import Curve, Diagnosis, Gap, RankedEffect, UnknownDescription

EVEN_SPREAD, EVEN_FRAMES = 0.2, 0.35
"""Shares of the view and of the frames from which on an excess counts as even: evenly it is 1/4, 1/2."""

MIN_FRAMES = 4
"""Fewest frames that say when something comes."""

FORMS = {"adds": "added light", "times_arc": "the arc's light", "times_laser": "the laser's light"}


def described(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Return what is known of an unknown cause, a heading and a sentence each; nothing of another verdict."""
    unknown = diagnosis.unknown
    if unknown is None:
        return []
    lines = [
        ("it is like", _likeliest(unknown)),
        ("it lies", _place(unknown, diagnosis)),
        ("it comes", _frames(unknown)),
        ("it goes with", _covariate(unknown.curve)),
        ("near to it", _nearest(diagnosis)),
        ("the seam", _seam(unknown, diagnosis.gap)),
    ]
    return [(heading, text) for heading, text in lines if text]


def nearest(diagnosis: Diagnosis) -> list[RankedEffect]:
    """Return the three effects that close most of the gap, each alone."""
    single = [candidate for candidate in diagnosis.ranking if not candidate.is_random]
    return sorted(single, key=lambda candidate: -candidate.gap_closed)[:3]


def _likeliest(unknown: UnknownDescription) -> str:
    first, *others = unknown.terms
    text = (
        f"{first.words} (stage {first.stage}), the likeliest single term by "
        f"{words.probability(first.probability)}: it explains {words.percent(first.share)} of what is left."
    )
    others = [term for term in others if term.words != first.words and term.share >= words.MIN_R2][:2]
    if others:
        also = [f"{term.words} ({words.percent(term.share)})" for term in others]
        text += f" Next come {words.listed(also, 'and')}."
    return text


def _place(unknown: UnknownDescription, diagnosis: Diagnosis) -> str:
    strata = {name: gap for name, gap in diagnosis.where.strata.items() if name in words.STRATA}
    lit = {name: gap for name, gap in strata.items() if name in ("dark", "laser", "arc", "both")}
    known = {name: gap for name, gap in lit.items() if math.isfinite(gap)}
    text = "all over the image"
    if unknown.spread < EVEN_SPREAD:
        rows, columns = _between("rows", unknown.rows_px), _between("columns", unknown.columns_px)
        text = f"mostly between {rows}, and {columns}"
    if math.isfinite(unknown.along_mm[0]):
        along, aside = _ends(unknown.along_mm), _ends(unknown.aside_mm)
        text += f"; on the part {along} mm along the seam, {aside} mm to its left"
    if len(known) > 1:
        largest = max(known, key=lambda name: known[name])
        text += f"; most in frames of {words.STRATA[largest]} ({words.sigmas(known[largest])} in bins)"
    return f"{text}."


def _frames(unknown: UnknownDescription) -> str:
    if unknown.n_frames < MIN_FRAMES:
        return f"too few frames to say when: {unknown.n_frames} fitted."
    if len(unknown.frames) > EVEN_FRAMES * unknown.n_frames:
        return "in all frames that were fitted alike."
    frames = words.listed([str(n) for n in unknown.frames], "and")
    return f"half of it in frames {frames}, of {unknown.n_frames} that were fitted."


def _covariate(curve: Curve | None) -> str:
    if curve is None or curve.r2 < words.MIN_R2:
        return "no single quantity."
    low, high = (int(n) for n in (curve.mean.argmin(), curve.mean.argmax()))
    unit, scale = ("DN", 1.0) if curve.form == "adds" else ("%", 100.0)

    def at(n: int) -> str:
        half_band = 0.5 * (curve.high[n] - curve.low[n])
        place = f"{words.number(curve.centers[n], 3)} {curve.unit}".rstrip()
        return f"{words.number(scale * curve.mean[n])} ± {words.number(scale * half_band)} {unit} at {place}"

    return (
        f"{words.quantity(curve.name)}, which explains {words.percent(curve.r2)} of it: "
        f"{FORMS.get(curve.form, 'all light')}, about its mean, goes from {at(low)} to {at(high)} (95 %)."
    )


def _nearest(diagnosis: Diagnosis) -> str:
    parts = []
    for effect in nearest(diagnosis):
        if effect.gap_closed < words.MIN_CLOSED:
            parts.append(f"{effect.id} alone closes nothing")
            continue
        share, size = 1.0 - effect.gap_closed, words.sigmas(effect.left_sigma)
        before = f" of {words.sigmas(effect.left_sigma / share)}" if share > 0.01 else ""
        parts.append(f"{effect.id} alone leaves {words.percent(share)}, {size}{before} in bins")
    return f"{'; '.join(parts)}." if parts else ""


def _seam(unknown: UnknownDescription, gap: Gap) -> str:
    lateral, vertical = unknown.seam_off_mm
    if not math.isfinite(lateral):
        return ""
    side, up = "left" if lateral >= 0.0 else "right", "above" if vertical >= 0.0 else "below"
    sheet = words.number(abs(unknown.sheet_mm))
    return (
        f"lies {words.number(abs(lateral))} mm to the {side} of its stated line and "
        f"{words.number(abs(vertical))} mm {up} it; a laser sheet {sheet} mm off its place would look like "
        f"that height. The tracker is off it by {words.number(gap.seam_lateral_mm[0])} mm to "
        f"the side and {words.number(gap.seam_vertical_mm[0])} mm in height."
    )


def _between(name: str, span: tuple[float, float]) -> str:
    return f"{name} {span[0]:.0f} and {span[1]:.0f} px"


def _ends(span: tuple[float, float]) -> str:
    return " to ".join(words.number(end) for end in span)
