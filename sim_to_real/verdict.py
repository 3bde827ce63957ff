"""No gap, named effects, an ambiguity set, or unknown: what the candidates' scores amount to.

All scores are mean squares R of residuals that are whitened with noise and the model's floor. The floor is a
generous one: a model without a gap stays below 1. The gap that is left above it is (R - 1) / (R_0 - 1).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.frames import Float64
from sim_to_real.diagnosis import Verdict
from sim_to_real.expected import Expected
from sim_to_real.pixels import Bool
from sim_to_real.refit import FLICKER, NAMED_FROM, Refit, refit, refit_from, settled
from sim_to_real.screen import Screened, is_trifle, seen_from
from sim_to_real.select import (
    ALIKE_NATS,
    RESOLVED,
    Candidate,
    beyond_form,
    candidates,
    confidences,
    cost_nats,
    flicker_at_look,
    judged,
    likelihood_nats,
    looked,
    nats_at_look,
    told_apart,
    with_changes,
    with_dear,
)

EXPLAINED = 0.12
"""A gap of which more is left is not explained by several effects."""

ONE_EXPLAINS = 0.08
"""Nor by one if more is left beyond what its form may be off."""

PIXELS_EXPLAINED = 0.05
"""Of a gap that pixels show one effect may leave so much: bins are predicted by a coarse camera."""

AT_FLOOR = 1.5
"""What leaves less in pixels shows no gap there: the model's floor is 1."""

SHOWN_FROM = 0.7
"""What leaves less in pixels, and in bins no more than the model's floor, is no gap."""

HALVES = 0.5
"""What explains bins must leave no more of what pixels show; nor must others beside it of what it leaves."""

BESIDE_NATS = 10.0
"""With so much evidence of its own an effect is named beside others that explain the gap, or have most of it.

Beside an effect of its own form the likeliest other one gains 4 nats at most.
"""

MAY_BESIDE_NATS = 6.0
"""With less at the first look no effect is fitted beside one that leaves nothing else to be explained."""

LEAST_SHARE = 0.05
"""An effect with a smaller share of what is closed is not named beside others without `BESIDE_NATS`."""

WORTH = 0.7
"""A further effect must close this share of what the others leave."""

CLEARLY_LEFT = 1.3
"""A mean square from which there is more to be explained even where one effect explains most of a gap."""

SEVERAL_LEAVE, SEVERAL_FORESEE = 1.2, 1.5
"""Several effects must explain all that there is: two or three mimic most of another one's gap.

The first is for frames left out; the second is, where they leave no more than the floor of those fitted, or
nothing that pixels show.
"""

PULLED_FROM = 10.0
"""A mean square from which the baseline's nuisances are not believed."""

UNEXPLAINED_FROM = 2.0
"""A mean square from which there is a gap though nothing in the catalogue helps."""

MOST_EFFECTS = 3
"""So many effects are named at most."""

SURE = 0.9
"""A candidate that is less probable than this is not named alone."""

IN_SET = 0.05
"""Candidates that are at least as probable are in the ambiguity set."""


@dataclass(frozen=True, eq=False)
class Decision:
    """The verdict, the candidate it rests on, all single effects that were fitted, the look at all.

    `confidence` (n,) is how probable each single effect is, `sure` how probable the candidate; `start` is
    what was left where they all started.
    """

    verdict: Verdict
    chosen: Candidate
    sure: float
    singles: tuple[Candidate, ...]
    confidence: Float64
    ambiguous: tuple[tuple[str, ...], ...]
    screened: tuple[Screened, ...]
    start: Refit


def left_over(candidate: Candidate, baseline: Candidate) -> float:
    """Return the share of the baseline's gap that a candidate leaves above the model's floor, 0 to 1."""
    gap = max(baseline.left - 1.0, 0.0)
    return min(max(candidate.left - 1.0, 0.0) / gap, 1.0) if gap > 0.0 else 0.0


def is_explained(expected: Expected, candidate: Candidate, baseline: Candidate) -> bool:
    """Say whether one effect explains a gap: it leaves little beyond what its form may be off.

    Or it leaves hardly anything in pixels, and they showed the gap. If they were asked it must halve that.
    What would explain it better beyond its bounds does not.
    """
    if candidate.is_held_back:
        return False
    shown = baseline.left_in_pixels
    if shown > AT_FLOOR and math.isfinite(candidate.left_in_pixels):
        share = (candidate.left_in_pixels - 1.0) / (shown - 1.0)
        if share <= PIXELS_EXPLAINED:
            return True
        if share > HALVES:
            return False
    return beyond_form(expected, candidate) - 1.0 <= ONE_EXPLAINS * max(baseline.left - 1.0, 0.0)


def _free_first(expected: Expected, found: Sequence[Candidate], baseline: Candidate) -> list[Candidate]:
    """Return single effects, likeliest first; but one that its bounds hold back behind one that explains all.

    As long as that is about as likely.
    """
    first = found[0]
    if not first.is_held_back:
        return list(found)
    near = [one for one in found if first.evidence - one.evidence < ALIKE_NATS]
    explain = [one for one in near if is_explained(expected, one, baseline)][:1]
    return [*explain, *(one for one in found if one not in explain)]


def without_help(baseline: Candidate) -> Verdict:
    """Return the verdict if nothing in the catalogue helps: a large gap is something else's."""
    return Verdict.NO_GAP if baseline.left < UNEXPLAINED_FROM else Verdict.UNKNOWN


def decide(
    expected: Expected,
    baseline: Candidate,
    without: Sequence[str],
    in_pixels: Callable[[Sequence[Refit]], Float64],
    on_stage: Callable[[str, float], None],
) -> Decision:
    """Look for the effects that explain what a baseline leaves.

    `in_pixels` gives the mean squares (n,) that fits leave in the pixels of frames left aside.
    """
    start = baseline.refit
    if baseline.left > PULLED_FROM:
        # A large gap pulls nuisances far off, where no effect could fit: candidates start from the stated.
        expected.take_tangents(expected.neutral, {})
        start = refit(expected, {}, expected.neutral, steps=0)
    on_stage("looking at every effect", 0.0)
    screened = tuple(looked(expected, start, without))
    if not screened or likelihood_nats(0.0) - cost_nats(1) - baseline.evidence < NAMED_FROM:
        # There is nothing to be tried, or none could leave so little that it would be preferred.
        return Decision(without_help(baseline), baseline, math.nan, (), np.zeros(0), (), screened, start)
    found = candidates(expected, start, screened, baseline.left, without, on_stage)
    found, baseline = told_apart(found, baseline, in_pixels)
    found = _free_first(expected, found, baseline)
    explained = is_explained(expected, found[0], baseline)
    is_open = found[0].left > RESOLVED and not explained
    is_small = baseline.left < UNEXPLAINED_FROM and baseline.left_in_pixels <= AT_FLOOR
    helps = explained and found[0].evidence - baseline.evidence >= NAMED_FROM
    if not is_open and not helps:
        # Light that bounces stays near the root: of all bins' mean it is little, and pixels show it.
        baseline = _asked(baseline, in_pixels)
        if baseline.left_in_pixels > SHOWN_FROM:
            found = with_dear(expected, start, found, without, on_stage)
            found, baseline = told_apart(found, baseline, in_pixels)
    elif is_open and not is_small:
        found = with_dear(expected, start, found, without, on_stage)
        if not is_explained(expected, found[0], baseline):
            found, baseline = _with_changes(expected, start, screened, found, baseline, in_pixels, on_stage)
    elif explained and found[0].ids == (FLICKER,):
        # A level of its own for each frame takes on much of what grows from frame to frame.
        found, baseline = _with_changes(expected, start, screened, found, baseline, in_pixels, on_stage)
    found = _free_first(expected, found, baseline)
    explained = is_explained(expected, found[0], baseline)
    singles = tuple(found)
    p = confidences(singles, baseline)
    # Below the floor one of many that are looked at is better by chance.
    gained = singles[0].evidence - baseline.evidence
    by_chance = baseline.left <= 1.0 and gained < NAMED_FROM + math.log(len(screened))

    def said(verdict: Verdict, chosen: Candidate, *ambiguous: tuple[str, ...]) -> Decision:
        others = [single for single in singles if single.ids != chosen.ids]
        sure = float(confidences([chosen, *others], baseline)[0]) if chosen.ids else math.nan
        return Decision(verdict, chosen, sure, singles, p, ambiguous, screened, start)

    if is_open and is_small:
        # What bins still show and nothing explains is too little to be seen in pixels.
        return said(Verdict.NO_GAP, baseline)
    if gained < NAMED_FROM:
        return said(without_help(baseline), baseline)
    if by_chance and _asked(baseline, in_pixels).left_in_pixels <= SHOWN_FROM:
        return said(Verdict.NO_GAP, baseline)
    best = singles[0]
    if explained:
        best = _asked(best, in_pixels)
        if best.left_in_pixels > AT_FLOOR:
            # Pixels are finer than bins: a fit that has not quite settled shows in them.
            best = _asked(_again(expected, best), in_pixels)
        singles = (best, *singles[1:])
    several = _beside(expected, baseline, best, explained, screened, without, in_pixels, on_stage)
    rivals = _rivals(singles)
    is_likely = (p >= IN_SET) | rivals
    likely = tuple(single.ids[0] for single, is_one in zip(singles, is_likely, strict=True) if is_one)
    if explained and (several is None or len(several.ids) == 1):
        if len(likely) == 1 or (p[0] >= SURE and not rivals.any()):
            return said(Verdict.EFFECTS, best)
        even = _among_rivals(p, rivals)
        return replace(said(Verdict.AMBIGUOUS, best, likely), sure=float(even[0]), confidence=even)
    if several is None:
        return said(Verdict.UNKNOWN, best)
    if len(several.ids) == 1 and len(likely) > 1:
        # One is enough once it has been fitted beside another, but no likelier than that one.
        return said(Verdict.AMBIGUOUS, several, tuple(dict.fromkeys((*several.ids, *likely))))
    return said(Verdict.EFFECTS, several)


def _with_changes(
    expected: Expected,
    start: Refit,
    screened: Sequence[Screened],
    found: Sequence[Candidate],
    baseline: Candidate,
    in_pixels: Callable[[Sequence[Refit]], Float64],
    on_stage: Callable[[str, float], None],
) -> tuple[list[Candidate], Candidate]:
    """Return single effects of which some may change, likeliest first, and the baseline; pixels are asked."""
    every = with_changes(expected, start, screened, found, on_stage)
    if not every[0].refit.change:
        return every, baseline
    # What pixels said of it as long as it stayed they have not said of its change.
    every, baseline = told_apart(every, baseline, in_pixels)
    return [_asked(every[0], in_pixels), *every[1:]], _asked(baseline, in_pixels)


def _rivals(singles: Sequence[Candidate]) -> Bool:
    """Return which effects (n,) stay in question beside the likeliest, the first, however improbable.

    They explain all that there is, though at a higher price, where the likeliest does not.
    """
    is_left = singles[0].left > CLEARLY_LEFT
    return np.array([is_left and one.left <= RESOLVED and not one.is_held_back for one in singles])


def _among_rivals(confidence: Float64, rivals: Bool) -> Float64:
    """Return confidences (n,) in which the first has no more than each of its rivals: they share evenly."""
    alike = rivals.copy()
    alike[0] = True
    return np.where(alike, confidence[alike].mean(), confidence)


def _again(expected: Expected, of: Candidate) -> Candidate:
    """Return a candidate whose fit has settled."""
    return replace(judged(expected, settled(expected, of.refit)), against=of.against)


def _beside(
    expected: Expected,
    baseline: Candidate,
    best: Candidate,
    explained: bool,
    screened: Sequence[Screened],
    without: Sequence[str],
    in_pixels: Callable[[Sequence[Refit]], Float64],
    on_stage: Callable[[str, float], None],
) -> Candidate | None:
    """Return what explains the gap together with the best effect, where that leaves something; or None.

    Of a best effect that explains the gap the pixels have been asked.
    """
    if best.is_held_back and left_over(best, baseline) <= EXPLAINED:
        # Almost all of it is one other effect's, and what is added would only lend the mimic more numbers.
        return None
    if not explained:
        return _several(expected, baseline, best, without, in_pixels, on_stage)
    shown = best.left_in_pixels > AT_FLOOR
    if not shown and best.left <= CLEARLY_LEFT and not _may_gain(expected, best.refit, screened, without):
        return None
    several = _several(expected, baseline, best, without, in_pixels, on_stage)
    if several is None or best.left > CLEARLY_LEFT:
        return several
    if several.of_bins - best.of_bins >= BESIDE_NATS and not is_trifle(_added(several), expected.stated):
        return several
    if not shown:
        return None
    # If others do not halve it, it is the effect's form that pixels show.
    left = _asked(several, in_pixels).left_in_pixels - 1.0
    return None if left > HALVES * (best.left_in_pixels - 1.0) else several


def _may_gain(
    expected: Expected, fitted: Refit, screened: Sequence[Screened], without: Sequence[str]
) -> bool:
    """Say whether an effect beside those that were fitted seems to gain enough to be looked into."""
    gains = [nats_at_look(one, fitted) for one in seen_from(fitted, screened)]
    if FLICKER not in without:
        gains.append(flicker_at_look(expected, fitted))
    return max(gains, default=-math.inf) >= MAY_BESIDE_NATS


def _asked(of: Candidate, in_pixels: Callable[[Sequence[Refit]], Float64]) -> Candidate:
    """Return a candidate of which it is known what it leaves in pixels."""
    if not math.isnan(of.left_in_pixels):
        return of
    return replace(of, left_in_pixels=float(in_pixels([of.refit])[0]))


def _several(
    expected: Expected,
    baseline: Candidate,
    best: Candidate,
    without: Sequence[str],
    in_pixels: Callable[[Sequence[Refit]], Float64],
    on_stage: Callable[[str, float], None],
) -> Candidate | None:
    """Return effects that explain the gap together, None if none do: forward steps, then backward."""
    chosen = best
    while chosen is best or (len(chosen.ids) < MOST_EFFECTS and left_over(chosen, baseline) > EXPLAINED):
        on_stage("looking for further effects", 0.0)
        screened = looked(expected, chosen.refit, without)
        if not screened:
            return None
        further = candidates(expected, chosen.refit, screened, chosen.left, without, on_stage)
        left = further[0].left
        if left > CLEARLY_LEFT or (left > RESOLVED and left_over(further[0], baseline) > EXPLAINED):
            further = with_dear(expected, chosen.refit, further, without, on_stage)
        if further[0].evidence - chosen.of_bins < NAMED_FROM:
            return None
        if left_over(further[0], baseline) > (1.0 - WORTH) * left_over(chosen, baseline):
            return None
        chosen = further[0]
    if chosen.left > SEVERAL_FORESEE or chosen.is_held_back:
        return None
    if chosen.left > SEVERAL_LEAVE and chosen.refit.mean_square > 1.0:
        chosen = _asked(chosen, in_pixels)
        if chosen.left_in_pixels > SHOWN_FROM:
            return None
    for name in chosen.ids[:-1]:
        fewer = _fewer(expected, chosen, name)
        if chosen.evidence - fewer.evidence < NAMED_FROM:
            chosen = fewer
    return chosen


def _added(of: Candidate) -> dict[str, dict[str, float]]:
    """Return the effect that was added last."""
    name = of.ids[-1]
    return {name: of.refit.effects[name]}


def _fewer(expected: Expected, of: Candidate, name: str) -> Candidate:
    """Return a candidate fitted again without one of its effects."""
    effects = {other: values for other, values in of.refit.effects.items() if other != name}
    return judged(expected, refit_from(expected, of.refit, effects))


def with_shares(
    expected: Expected, baseline: Candidate, decision: Decision
) -> tuple[Decision, dict[str, float]]:
    """Return the verdict without effects of a small share and little evidence, and the share of each left.

    What is large by itself hides behind what is larger still.
    """
    share = shares(expected, baseline, decision.chosen)

    def is_worth(name: str) -> bool:
        if share[name] >= LEAST_SHARE:
            return True
        return decision.chosen.evidence - _fewer(expected, decision.chosen, name).evidence >= BESIDE_NATS

    worth = {name: of for name, of in decision.chosen.refit.effects.items() if is_worth(name)}
    if not worth or len(worth) == len(decision.chosen.ids):
        return decision, share
    chosen = judged(expected, refit_from(expected, decision.chosen.refit, worth))
    return replace(decision, chosen=chosen), shares(expected, baseline, chosen)


def shares(expected: Expected, baseline: Candidate, chosen: Candidate) -> dict[str, float]:
    """Return each effect's share of the gap that all close together: Shapley's value (1953)."""
    names = chosen.ids
    if len(names) < 2:
        return dict.fromkeys(names, 1.0)
    left: dict[frozenset[str], float] = {frozenset(): baseline.left, frozenset(names): chosen.left}
    for number in range(1, len(names)):
        for some in itertools.combinations(names, number):
            effects = {name: chosen.refit.effects[name] for name in some}
            of_some = judged(expected, refit_from(expected, chosen.refit, effects)).left
            # One that does harm without the others would be left neutral.
            left[frozenset(some)] = min(of_some, *(of for fewer, of in left.items() if fewer < set(some)))
    # Below the model's floor all that there is is closed by what leaves least.
    floor = 1.0 if baseline.left > 1.0 else min(left.values())
    closed = {of: math.sqrt(max(value - floor, 0.0)) for of, value in left.items()}
    total = closed[frozenset()] - closed[frozenset(names)]
    if total <= 0.0:
        return dict.fromkeys(names, 1.0 / len(names))
    value = dict.fromkeys(names, 0.0)
    for order in itertools.permutations(names):
        for n, name in enumerate(order):
            value[name] += closed[frozenset(order[:n])] - closed[frozenset(order[: n + 1])]
    n_orders = math.factorial(len(names))
    return {name: float(np.clip(of / n_orders / total, 0.0, 1.0)) for name, of in value.items()}


def in_question(decision: Decision, alike: Sequence[tuple[str, str]]) -> tuple[Candidate, Candidate] | None:
    """Return the two single effects that a measurement should tell apart; None if nothing is open.

    Of an ambiguity set they are its two likeliest; beside what is named it is the likeliest of those that the
    recording cannot tell from it, `alike` being its pairs.
    """
    singles = list(decision.singles)
    if decision.verdict is Verdict.NO_GAP:
        return None
    if decision.verdict is Verdict.AMBIGUOUS:
        singles = [one for one in singles if one.ids[0] in decision.ambiguous[0]]
    elif decision.verdict is Verdict.EFFECTS and singles:
        name = singles[0].ids[-1]
        like = {other for pair in alike if name in pair for other in pair} - {name}
        singles = [singles[0], *(one for one in singles[1:] if one.ids[-1] in like)]
    return (singles[0], singles[1]) if len(singles) > 1 else None
