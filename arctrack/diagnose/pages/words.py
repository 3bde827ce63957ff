"""A diagnosis in words, for the terminal and for the page."""

import math
from collections.abc import Sequence

from noise_model.effects import REGISTRY
from sim_to_real.diagnosis import (
    NO_GAP,
    Diagnosis,
    DiagnosisVerdict,
    Gap,
    ParameterEstimate,
    RankedEffect,
    Reason,
    ReportedTrend,
    Where,
)

NO_VALUE = "–"

PLACES = {
    "source": "the arc itself",
    "illumination": "the laser, or light of the hall",
    "surface": "the metal",
    "medium": "the air between part and camera",
    "optics": "window, lens and filter",
    "sensor": "the sensor, from charge to DN",
    "geometry": "where things really are",
    "timing": "the poses' clock",
}
"""Names of the stages."""

STRATA = {
    "dark": "dark frames",
    "laser": "laser alone",
    "arc": "arc alone",
    "both": "laser and arc",
    "stripe_band": "the stripe's band",
    "rest": "off the stripe",
}
"""Names of the strata, by what is on."""

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
    "beside_sheet": "distance from the laser's sheet",
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
"""Action of a free function, by its form."""

CERTAIN_SHARE = 0.995
"""Least probability that is stated as above 99 %."""

MIN_P, DOUBTFUL_P = 1e-4, 0.05
"""P-values of the model: smaller ones are not stated exactly, and those from which on it is not in doubt."""

MIN_R2 = 0.05
"""A covariate or pattern that explains a smaller share of the residual is not worth mentioning."""

IN_PIXELS, IN_BINS = "in single pixels", "in bins"
"""Units of the share of a gap that effects close."""

MIN_CLOSED = 0.01
"""Least share of the gap that counts as closed."""


def headline(diagnosis: Diagnosis) -> str:
    """Return the verdict in one sentence."""
    gap = diagnosis.gap
    if diagnosis.verdict is DiagnosisVerdict.NO_GAP:
        return "No gap: the recording agrees with the model within noise and stated tolerances."
    if diagnosis.verdict is DiagnosisVerdict.EFFECTS:
        how_much = "most of the gap" if gap.is_clear_after else "the gap"
        if len(diagnosis.effects) == 1:
            return f"{diagnosis.effects[0].id} explains {how_much}: {summary(diagnosis.effects[0].id)}."
        what = listed([f"{effect.id} ({summary(effect.id)})" for effect in diagnosis.effects], "and")
        return f"{len(diagnosis.effects)} effects explain {how_much} together: {what}."
    if diagnosis.verdict is DiagnosisVerdict.AMBIGUOUS:
        causes = "; and ".join(_alternatives(ids) for ids in diagnosis.ambiguous_with)
        return f"There is a gap of {sigmas(gap.before)}. This recording cannot tell what causes it: {causes}."
    if diagnosis.reasons and diagnosis.reasons[0].name == NO_GAP:
        return (
            f"There is a gap of {sigmas(gap.before)} in frames held out, though no gap is likeliest of what "
            "was compared: noise is more than stated, or a nuisance such as the arc's level is off by more "
            "than its tolerance."
        )
    if diagnosis.effects:
        return _with_unknown(diagnosis)
    return f"There is a gap of {sigmas(gap.before)} that no effect of the catalogue explains."


def model_test(diagnosis: Diagnosis) -> str:
    """Return the global test of the model in one sentence, the first of a report."""
    p = diagnosis.model_test.p_value
    if not math.isfinite(p):
        return "The model could not be tested as a whole: nothing was compared."
    if p < MIN_P:
        return f"The model does not hold: p < {MIN_P:g}, a recording without a gap hardly differs as much."
    differ = f"{100.0 * p:.2g} % of recordings without a gap differ from it as much"
    return f"The model {'may not hold' if p < DOUBTFUL_P else 'holds'}: p = {p:.2g}, {differ}."


def _with_unknown(diagnosis: Diagnosis) -> str:
    """Return effects beside something unknown, each with the share of the gap that it closes."""
    gap, effects = diagnosis.gap, diagnosis.effects
    what = listed([f"{effect.id} ({summary(effect.id)})" for effect in effects], "and")
    if not math.isfinite(gap.closed):
        return f"{what} beside something unknown, in a gap of {sigmas(gap.before)}."
    closed = min(max(gap.closed, 0.0), 1.0)
    shares = listed([f"{effect.id} closes {percent(effect.share * closed)}" for effect in effects], "and")
    return f"{what} beside something unknown: {shares} of the gap of {sigmas(gap.before)}."


def how_far(diagnosis: Diagnosis) -> str:
    """Return the size of the gap in the images, and its size with the effects, in a few sentences."""
    gap = diagnosis.gap
    model_error = f"the model's own error of {sigmas(gap.floor)}"
    if diagnosis.verdict is DiagnosisVerdict.NO_GAP:
        differ = f"The images differ from the model by {sigmas(gap.before)}"
        if gap.before > gap.floor:
            return (
                f"{differ}, more than {model_error}. No effect explains the difference, and it is too "
                "small to be told from chance."
            )
        return f"{differ}, within {model_error}."
    if not shrinks(diagnosis):
        return f"{_best_alone(diagnosis)} Without a gap the images would differ by {model_error} at most."
    lead = f"With {added(diagnosis)} the gap in the images shrinks from {sigmas(gap.before)} to "
    lead += sigmas(gap.after)
    if gap.before <= gap.floor:
        return (
            f"{lead}. Both are within {model_error}, but that error hardly has the pattern of "
            f"{added(diagnosis)}."
        )
    if math.isfinite(gap.closed):
        lead = f"{lead}. In single pixels that closes {closed_share(gap)} of what exceeds {model_error}"
    if diagnosis.verdict is DiagnosisVerdict.UNKNOWN:
        return f"{lead}. {'The rest is unknown' if diagnosis.effects else 'That is too little for a cause'}."
    if diagnosis.verdict is DiagnosisVerdict.EFFECTS and gap.is_clear_after:
        return f"{lead}. The rest may be due to the effect's form, which the catalogue simplifies."
    return f"{lead}."


def named(diagnosis: Diagnosis) -> str:
    """Return the effects of a verdict in a row, or those of a set that may be it."""
    if diagnosis.verdict is DiagnosisVerdict.AMBIGUOUS:
        return "; ".join(listed(ids, "or") for ids in diagnosis.ambiguous_with)
    return ", ".join(effect.id for effect in diagnosis.effects)


def withheld(diagnosis: Diagnosis, without: Sequence[str]) -> str:
    """Return that the user left effects out of the search, and which share of the gap stays; or nothing."""
    if not without:
        return ""
    line = f"You left {listed(without, 'and')} out: the answer is among the effects that were allowed"
    if diagnosis.verdict is not DiagnosisVerdict.EFFECTS:
        return f"{line}."
    named = {effect.id for effect in diagnosis.effects}
    alone = [
        candidate for candidate in diagnosis.ranking if candidate.id in named and not candidate.is_random
    ]
    # What is left of the gap weighs more in bins than in pixels; there each effect is fitted by itself.
    if len(alone) == 1:
        stays, where = 1.0 - alone[0].gap_closed, f"{where_closed(alone[0])} with {alone[0].id}"
    else:
        stays, where = 1.0 - diagnosis.gap.closed, f"{IN_PIXELS} with {added(diagnosis)}"
    return f"{line}; {percent(max(stays, 0.0))} of the gap stays {where}."


def shrinks(diagnosis: Diagnosis) -> bool:
    """Return True if the effects in the predictions after make the gap smaller."""
    return bool(diagnosis.after_with) and diagnosis.gap.after < diagnosis.gap.before


def best_alone(diagnosis: Diagnosis) -> RankedEffect | None:
    """Return the single effect that closes most of the gap; None if none closes any of it."""
    closing = [effect for effect in diagnosis.ranking if effect.gap_closed >= MIN_CLOSED]
    return max(closing, key=lambda effect: effect.gap_closed, default=None)


def where_closed(candidate: RankedEffect) -> str:
    """Return the unit of an effect's share of the gap.

    A bin of several pixels has less noise than a pixel, so what is left weighs more there.
    """
    return IN_PIXELS if candidate.is_random else IN_BINS


def _best_alone(diagnosis: Diagnosis) -> str:
    best = best_alone(diagnosis)
    if best is None:
        return "No effect of the catalogue makes it smaller."
    share = f"{percent(best.gap_closed)} of it {where_closed(best)}"
    return f"The best single effect, {best.id}, closes {share}."


def added(diagnosis: Diagnosis) -> str:
    """Return the effects in predictions `after` that are not in those `before`."""
    return listed(diagnosis.after_with, "and")


def seam_sentence(diagnosis: Diagnosis, bears_mm: float) -> str:
    """Return the gap's influence on the seam point, of which the weld can bear `bears_mm`."""
    before_mm, after_mm = diagnosis.gap.seam_mm
    if not math.isfinite(before_mm):
        return "Its influence on the seam point is not known: the tracker found no seam."
    bears = f"the {bears_mm:g} mm that the weld can bear"
    compared = f"{'less' if before_mm <= bears_mm else 'more'} than {bears}"
    seam = f"The tracker's seam lies {number(before_mm)} mm from the seam that fits all images"
    if diagnosis.verdict is DiagnosisVerdict.UNKNOWN:
        return f"{seam} best, {compared}. While the cause is unknown, the true error may be larger."
    if (
        diagnosis.verdict is DiagnosisVerdict.NO_GAP
        or not diagnosis.after_with
        or not math.isfinite(after_mm)
    ):
        return f"{seam}, {compared}."
    if is_same_seam(before_mm, after_mm):
        both = f"{_lower(seam)} with and without {added(diagnosis)}"
        return f"The gap does not move the seam point: {both}, {compared}."
    return f"{seam}, {compared}; with {added(diagnosis)} in the setup it lies {number(after_mm)} mm from it."


def is_same_seam(before_mm: float, after_mm: float) -> bool:
    """Return True if two errors of the seam are practically equal."""
    # Errors of the seam that differ by less than either are the same.
    return abs(before_mm - after_mm) <= max(0.1 * before_mm, 0.005)


def stages(where: Where) -> str:
    """Return the stages at which an unknown cause may act, with their probabilities, the likeliest first."""
    ranked = sorted(where.stages.items(), key=lambda pair: -pair[1])
    # A less probable stage is not mentioned.
    named = [pair for pair in ranked[1:] if pair[1] >= 0.01]
    return listed([f"{name} ({probability(p)})" for name, p in (ranked[0], *named)], "and")


def follows(where: Where) -> str:
    """Return the covariates that the residual follows, or a pattern that explains more."""
    # Largest number of covariates named.
    named = [curve for curve in where.covariates if curve.r2 >= MIN_R2][:3]
    # The patterns in the image that are no functions of a covariate.
    patterns = {name: share for name, share in where.image.items() if name in ("mirrored", "fixed")}
    pattern = max(patterns, key=lambda name: patterns[name], default=None)
    text = ""
    if named:
        shares = [f"{quantity(curve.name)} ({percent(curve.r2)})" for curve in named]
        text = f"it goes with {listed(shares, 'and')}"
    elif where.covariates:
        best = where.covariates[0]
        text = f"no single quantity explains more than {percent(best.r2)} of it"
    strongest = max((curve.r2 for curve in named), default=0.0)
    if pattern is not None and patterns[pattern] > max(MIN_R2, strongest):
        explains = f"{quantity(pattern)} explains {percent(patterns[pattern])} of it"
        return f"{text}; {explains}" if text else explains
    return text


def summary(effect_id: str) -> str:
    """Return an effect in words."""
    effect = REGISTRY.get(effect_id)
    return effect_id if effect is None else effect.summary


def closed_share(gap: Gap) -> str:
    """Return the share of the gap above the floor that is closed, with its 95 % interval."""
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


ALONE = "it alone"
"""The heading over the probabilities that one effect is all that is amiss."""

PRESENT = "is there"
"""The heading over the probabilities of random effects: each may be there, whatever else is."""


def random_ranking(diagnosis: Diagnosis) -> list[RankedEffect]:
    """Return the random effects that were sought, the likeliest first."""
    return [candidate for candidate in diagnosis.ranking if candidate.is_random]


def is_likely(candidate: RankedEffect) -> bool:
    """Return True if an effect is likely enough to be listed."""
    # A random effect that is less probable is not listed.
    return candidate.confidence >= 0.05


def because(diagnosis: Diagnosis) -> str:
    """Return the evidence of the two likeliest hypotheses over no gap, empty without any."""
    if len(diagnosis.reasons) < 2:
        return ""
    best, following = diagnosis.reasons[:2]
    return f"{_over_no_gap(best)}; next {_over_no_gap(following)}"


def _over_no_gap(reason: Reason) -> str:
    return f"{reason.name} {number(reason.evidence)} nats" if reason.evidence else reason.name


def nats_behind(reason: Reason) -> str:
    """Return a hypothesis' evidence below the largest."""
    behind = reason.best - reason.evidence
    return f"{number(behind)} nats behind" if behind > 0.0 else "the most"


def probability(value: float) -> str:
    """Return a probability in percent; nothing is quite certain."""
    if math.isfinite(value) and value > CERTAIN_SHARE:
        return "> 99 %"
    return "< 1 %" if value < 1.0 - CERTAIN_SHARE else percent(value)


def estimate(value: ParameterEstimate) -> str:
    """Return value ± sigma and unit, as many digits as the sigma is worth."""
    if not math.isfinite(value.value):
        return NO_VALUE
    unit = f" {value.unit}" if value.unit else ""
    if not (math.isfinite(value.sigma) and value.sigma > 0.0):
        return f"{number(value.value, 3)}{unit}"
    decimals = min(9, max(0, 1 - math.floor(math.log10(value.sigma))))
    return f"{value.value:.{decimals}f}".replace("-", "−") + f" ± {value.sigma:.{decimals}f}{unit}"


def trend(change: ReportedTrend) -> str:
    """Return the trend of an effect's parameters over a recording."""
    runs = [
        f"{name} from {number(first, 3)} to {number(last, 3)}"
        for name, (first, last) in change.values.items()
    ]
    ends = " to ".join(number(end, 2) for end in (change.least, change.most))
    return f"changes with {change.driver}, {ends} {change.unit}: {listed(runs, 'and')}"


def as_factor(name: str, value: ParameterEstimate) -> str:
    """Return a logarithm as a factor, nothing for other parameters."""
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


def left_over(name: str, share: float) -> str:
    """Return the share of the gap that a free function closes beyond the catalogue."""
    if share < MIN_CLOSED:
        return "no free function of a single quantity closes any more of it"
    return f"{free_function(name)} would close {percent(share)} more of it"


def listed(words: Sequence[str], last: str) -> str:
    """Return words joined by commas, the last one by `and` or `or`."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"


def _lower(sentence: str) -> str:
    return sentence[0].lower() + sentence[1:]


def _alternatives(ids: Sequence[str]) -> str:
    return listed([f"{name} ({summary(name)})" for name in ids], "or")
