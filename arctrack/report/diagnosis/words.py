"""A diagnosis in words: what a welding engineer reads on the terminal and on the page."""

from __future__ import annotations

import math
from collections.abc import Sequence

from noise_model.effects import REGISTRY
from sim_to_real.diagnosis import Diagnosis, Estimate, Gap, ReportedTrend, Verdict

NO_VALUE = "–"

PLACES = {
    "source": "the arc itself",
    "illumination": "the laser",
    "surface": "the metal",
    "medium": "the air between part and camera",
    "optics": "window, lens and filter",
    "sensor": "the sensor, from charge to DN",
    "geometry": "where things really are",
    "timing": "the poses' clock",
}
"""What a stage is."""

STRATA = {
    "dark": "dark frames",
    "laser": "laser alone",
    "arc": "arc alone",
    "both": "laser and arc",
    "stripe_band": "the stripe's band",
    "rest": "off the stripe",
}
"""What is on in a stratum."""

COVARIATES = {
    "distance": "distance from the arc",
    "theta_i": "angle of incidence of the arc's light",
    "theta_r": "viewing angle",
    "phi_r": "viewing direction about the normal, 0 opposite the arc",
    "half_angle": "angle off the mirror direction",
    "field_angle": "field angle",
    "gray_level": "grey level",
    "velocity_sign": "direction of the weave",
    "concavity": "how much the joint's faces see of each other",
    "radius": "distance from the principal point",
    "row, column": "row and column",
    "mirrored": "the arc's mirror image",
    "fixed": "a pattern fixed in the image",
    "radial": "distance from the image's centre",
    "stripe_band": "the stripe's band",
}
"""Covariates and patterns in the image whose names say too little."""

FORMS = {
    "adds": "that adds to the image",
    "times_arc": "that multiplies the arc's light",
    "times_laser": "that multiplies the laser's light",
    "times_light": "that multiplies all light",
}
"""How a free function acts."""

CERTAIN_SHARE = 0.995
"""From here on a probability is said to be above 99 %."""


def headline(diagnosis: Diagnosis) -> str:
    """Return the verdict in one sentence."""
    gap = diagnosis.gap
    if diagnosis.verdict is Verdict.NO_GAP:
        return "No gap: the recording agrees with the model within noise and stated tolerances."
    if diagnosis.verdict is Verdict.EFFECTS:
        how_much = "most of the gap" if gap.is_clear_after else "the gap"
        if len(diagnosis.effects) == 1:
            return f"{diagnosis.effects[0].id} explains {how_much}: {summary(diagnosis.effects[0].id)}."
        what = listed([f"{effect.id} ({summary(effect.id)})" for effect in diagnosis.effects], "and")
        return f"{len(diagnosis.effects)} effects explain {how_much} together: {what}."
    if diagnosis.verdict is Verdict.AMBIGUOUS:
        alike = "; and ".join(_alternatives(ids) for ids in diagnosis.ambiguous_with)
        return f"There is a gap of {sigmas(gap.before)}, and this recording cannot tell which it is: {alike}."
    held_back = [candidate.id for candidate in diagnosis.ranking[:1] if candidate.is_bound_limited]
    if held_back:
        return (
            f"There is a gap of {sigmas(gap.before)} that nothing in the catalogue of effects explains: "
            f"{held_back[0]} closes most, but would have to go beyond its bounds."
        )
    return f"There is a gap of {sigmas(gap.before)} that nothing in the catalogue of effects closes."


def how_far(diagnosis: Diagnosis) -> str:
    """Return how large the gap is and how far it shrinks, in one sentence."""
    gap = diagnosis.gap
    if diagnosis.verdict is Verdict.NO_GAP and gap.before > gap.floor:
        return (
            f"What differs is {sigmas(gap.before)}, more than the {sigmas(gap.floor)} by which the model may "
            "be off by itself, but no effect explains it, and it is too little to be told from chance."
        )
    if diagnosis.verdict is Verdict.NO_GAP:
        return (
            f"What differs is {sigmas(gap.before)}; up to {sigmas(gap.floor)} the model may be off by itself."
        )
    if not diagnosis.after_with or gap.after >= gap.before:
        return f"No effect that was fitted makes it smaller; {sigmas(gap.floor)} would be no gap."
    closed = f", {closed_share(gap)} of it is closed" if math.isfinite(gap.closed) else ""
    lead = f"With {added(diagnosis)} the gap shrinks from {sigmas(gap.before)} to {sigmas(gap.after)}{closed}"
    if gap.before <= gap.floor:
        return (
            f"{lead}; by {sigmas(gap.floor)} the model may be off by itself, but hardly in the pattern of "
            f"{added(diagnosis)}."
        )
    lead += f"; {sigmas(gap.floor)} would be no gap."
    if diagnosis.verdict is Verdict.EFFECTS and gap.is_clear_after:
        return f"{lead} What is left may be a form that the catalogue simplifies."
    return lead


def added(diagnosis: Diagnosis) -> str:
    """Return what the model holds in predictions `after` and not in those `before`."""
    return listed(diagnosis.after_with, "and")


def seam_sentence(diagnosis: Diagnosis, bears_mm: float) -> str:
    """Return what the gap does to the seam point, of which the weld can bear `bears_mm`."""
    moves, after_mm = diagnosis.gap.seam_mm
    if not math.isfinite(moves):
        return "What it does to the seam point is not known."
    if diagnosis.verdict is Verdict.NO_GAP:
        return f"The seam point moves by {number(moves)} mm; the weld bears {bears_mm:g} mm."
    compared = "less" if moves <= bears_mm else "more"
    lead = f"The gap moves the seam point by {number(moves)} mm, {compared} than the {bears_mm:g} mm "
    lead += "that the weld bears"
    return f"{lead}; {number(after_mm)} mm are left." if math.isfinite(after_mm) else f"{lead}."


def summary(effect_id: str) -> str:
    """Return what an effect is, in words."""
    effect = REGISTRY.get(effect_id)
    return effect_id if effect is None else effect.summary


def closed_share(gap: Gap) -> str:
    """Return the share of the gap that is closed, with its 95 % interval; below the floor all of it is."""
    low, high = (min(end, 1.0) for end in gap.ci95)
    text = percent(min(gap.closed, 1.0))
    if math.isfinite(low) and math.isfinite(high) and low < high:
        text += f" ({100.0 * low:.0f} to {percent(high)})"
    return text


def sigmas(value: float) -> str:
    """Return a size in noise sigmas."""
    return f"{number(value)} σ"


def number(value: float, digits: int = 2) -> str:
    """Return a number in a few digits, with a true minus."""
    if not math.isfinite(value):
        return NO_VALUE
    if 10**digits <= abs(value) < 1e5:
        return f"{value:.0f}".replace("-", "−")
    # The trailing zeros of 4.0 count, the point behind 18 does not.
    return f"{value:#.{digits}g}".rstrip(".").replace("-", "−")


def percent(share: float) -> str:
    """Return a share in percent."""
    return f"{100.0 * share:.0f} %".replace("-", "−") if math.isfinite(share) else NO_VALUE


def probable(verdict: Verdict) -> str:
    """Return the heading over how probable the candidates are: unknown says that it is hardly one of them."""
    return "if one of these" if verdict is Verdict.UNKNOWN else "probable"


def probability(value: float) -> str:
    """Return a probability in percent; nothing is quite certain."""
    if math.isfinite(value) and value > CERTAIN_SHARE:
        return "> 99 %"
    return "< 1 %" if value < 1.0 - CERTAIN_SHARE else percent(value)


def estimate(value: Estimate) -> str:
    """Return value ± sigma and unit, as many digits as the sigma is worth."""
    if not math.isfinite(value.value):
        return NO_VALUE
    unit = f" {value.unit}" if value.unit else ""
    if not (math.isfinite(value.sigma) and value.sigma > 0.0):
        return f"{number(value.value, 3)}{unit}"
    decimals = min(9, max(0, 1 - math.floor(math.log10(value.sigma))))
    return f"{value.value:.{decimals}f}".replace("-", "−") + f" ± {value.sigma:.{decimals}f}{unit}"


def trend(change: ReportedTrend) -> str:
    """Return how an effect's parameters run over a recording."""
    runs = [
        f"{name} from {number(first, 3)} to {number(last, 3)}"
        for name, (first, last) in change.values.items()
    ]
    ends = " to ".join(number(end, 2) for end in (change.least, change.most))
    return f"changes with {change.driver}, {ends} {change.unit}: {listed(runs, 'and')}"


def as_factor(name: str, value: Estimate) -> str:
    """Return what a logarithm means as a factor, nothing for other parameters."""
    return f"× {number(math.exp(value.value), 3)}" if name.endswith("_ln") and abs(value.value) < 50.0 else ""


def quantity(name: str, unit: str = "") -> str:
    """Return a covariate's or a pattern's name for people."""
    return COVARIATES.get(name, name.replace("_", " ")) + (f" [{unit}]" if unit else "")


def free_function(name: str) -> str:
    """Return in words what closes a gap beyond the catalogue, named `covariate` or `covariate form`."""
    covariate, _, form = name.rpartition(" ")
    if form not in FORMS:
        return f"a free function of {quantity(name)}"
    return f"a free function of {quantity(covariate)} {FORMS[form]}"


def listed(words: Sequence[str], last: str) -> str:
    """Return words joined by commas, the last one by `and` or `or`."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"


def _alternatives(ids: Sequence[str]) -> str:
    return listed([f"{name} ({summary(name)})" for name in ids], "or")
