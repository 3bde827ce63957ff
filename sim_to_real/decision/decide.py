"""No gap, named effects, an ambiguity set, or unknown: what the candidates' scores amount to.

All scores are mean squares R of residuals that are whitened with noise and the model's floor. The floor is a
generous one: a model without a gap stays below 1. The gap that is left above it is (R - 1) / (R_0 - 1).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.arrays import Bool, Float64
from sim_to_real.diagnosis import Verdict
from sim_to_real.fit.gauss_newton import FLICKER, NAMED_FROM, Refit, refit, settled
from sim_to_real.fit.linearized_model import Expected
from sim_to_real.search.hypothesis import (
    AT_FLOOR,
    CLEARLY_LEFT,
    SHOWN_FROM,
    Candidate,
    confidences,
    cost_nats,
    is_explained,
    judged,
    likelihood_nats,
)
from sim_to_real.search.identifiability import not_resolvable, own_signatures
from sim_to_real.search.score_test import Screened
from sim_to_real.search.single_effects import (
    ALIKE_NATS,
    RESOLVED,
    Search,
    candidates,
    looked,
    told_apart,
    with_changes,
    with_dear,
)
from sim_to_real.search.stepwise import beside

PULLED_FROM = 10.0
"""A mean square from which the baseline's nuisances are not believed."""

UNEXPLAINED_FROM = 2.0
"""A mean square from which there is a gap though nothing in the catalogue helps."""

SURE = 0.9
"""A candidate that is less probable than this is not named alone."""

IN_SET = 0.05
"""Candidates that are at least as probable are in the ambiguity set."""


@dataclass(frozen=True, eq=False)
class Decision:
    """The verdict, the candidate it rests on, all single effects that were fitted, the look at all.

    `confidence` (n,) is how probable each single effect is, `sure` how probable the candidate. `signatures`
    are what effects do from where they all started, `alike` the pairs of which these look the same.
    """

    verdict: Verdict
    chosen: Candidate
    sure: float
    singles: tuple[Candidate, ...]
    confidence: Float64
    ambiguous: tuple[tuple[str, ...], ...]
    screened: tuple[Screened, ...]
    signatures: Mapping[str, Float64]
    alike: tuple[tuple[str, str], ...]


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


def decide(search: Search, baseline: Candidate) -> Decision:
    """Look for the effects that explain what a baseline leaves."""
    expected, start = search.expected, baseline.refit
    if baseline.left > PULLED_FROM:
        # A large gap pulls nuisances far off, where no effect could fit: candidates start from the stated.
        expected.take_tangents(expected.neutral, {})
        start = refit(expected, {}, expected.neutral, steps=0)
    search.on_stage("looking at every effect", 0.0)
    screened = tuple(looked(search, start))
    signatures = own_signatures(start, screened)
    alike = not_resolvable(signatures)
    if not screened or likelihood_nats(0.0) - cost_nats(1) - baseline.evidence < NAMED_FROM:
        # There is nothing to be tried, or none could leave so little that it would be preferred.
        verdict = without_help(baseline)
        return Decision(verdict, baseline, math.nan, (), np.zeros(0), (), screened, signatures, alike)
    found, baseline, is_trifling = _fitted(search, start, screened, baseline)
    explained = is_explained(expected, found[0], baseline)
    singles = tuple(found)
    p = confidences(singles, baseline)
    # Below the floor one of many that are looked at is better by chance.
    gained = singles[0].evidence - baseline.evidence
    by_chance = baseline.left <= 1.0 and gained < NAMED_FROM + math.log(len(screened))

    def said(verdict: Verdict, chosen: Candidate, *ambiguous: tuple[str, ...]) -> Decision:
        others = [single for single in singles if single.ids != chosen.ids]
        sure = float(confidences([chosen, *others], baseline)[0]) if chosen.ids else math.nan
        return Decision(verdict, chosen, sure, singles, p, ambiguous, screened, signatures, alike)

    if is_trifling:
        return said(Verdict.NO_GAP, baseline)
    if gained < NAMED_FROM:
        return said(without_help(baseline), baseline)
    if by_chance and search.asked(baseline).left_in_pixels <= SHOWN_FROM:
        return said(Verdict.NO_GAP, baseline)
    best = singles[0]
    if explained:
        best = search.asked(best)
        if best.left_in_pixels > AT_FLOOR:
            # Pixels are finer than bins: a fit that has not quite settled shows in them.
            best = search.asked(_again(expected, best))
        singles = (best, *singles[1:])
    several = beside(search, baseline, best, explained, start, screened)
    rivals = _rivals(singles, alike)
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


def _fitted(
    search: Search, start: Refit, screened: Sequence[Screened], baseline: Candidate
) -> tuple[list[Candidate], Candidate, bool]:
    """Return single effects, likeliest first, and the baseline; pixels are asked where bins leave it open.

    And whether what bins still show, and nothing explains, is too little to be seen in pixels.
    """
    expected = search.expected
    found = candidates(search, start, screened, baseline.left)
    found, baseline = told_apart(search, found, baseline)
    found = _free_first(expected, found, baseline)
    explained = is_explained(expected, found[0], baseline)
    is_open = found[0].left > RESOLVED and not explained
    is_small = baseline.left < UNEXPLAINED_FROM and baseline.left_in_pixels <= AT_FLOOR
    helps = explained and found[0].evidence - baseline.evidence >= NAMED_FROM
    if not is_open and not helps:
        # Light that bounces stays near the root: of all bins' mean it is little, and pixels show it.
        baseline = search.asked(baseline)
        if baseline.left_in_pixels > SHOWN_FROM:
            found = with_dear(search, start, found)
            found, baseline = told_apart(search, found, baseline)
    elif is_open and not is_small:
        found = with_dear(search, start, found)
        if not is_explained(expected, found[0], baseline):
            found, baseline = _with_changes(search, start, screened, found, baseline)
    elif explained and found[0].ids == (FLICKER,):
        # A level of its own for each frame takes on much of what grows from frame to frame.
        found, baseline = _with_changes(search, start, screened, found, baseline)
    return _free_first(expected, found, baseline), baseline, is_open and is_small


def _with_changes(
    search: Search,
    start: Refit,
    screened: Sequence[Screened],
    found: Sequence[Candidate],
    baseline: Candidate,
) -> tuple[list[Candidate], Candidate]:
    """Return single effects of which some may change, likeliest first, and the baseline; pixels are asked."""
    every = with_changes(search, start, screened, found)
    if not every[0].refit.change:
        return every, baseline
    # What pixels said of it as long as it stayed they have not said of its change.
    every, baseline = told_apart(search, every, baseline)
    return [search.asked(every[0]), *every[1:]], search.asked(baseline)


def _rivals(singles: Sequence[Candidate], alike: Sequence[tuple[str, str]]) -> Bool:
    """Return which effects (n,) stay in question beside the likeliest, the first, however improbable.

    They explain all that there is, though at a higher price, where the likeliest does not; or as much as it
    does, and the recording cannot tell them from it: then the price alone makes them improbable.
    """
    first = singles[0]
    is_left, like = first.left > CLEARLY_LEFT, _like(first.ids[-1], alike)
    as_much = likelihood_nats(first.left) - NAMED_FROM

    def is_rival(one: Candidate) -> bool:
        if one.is_held_back or one is first:
            return False
        explains_all = is_left and one.left <= RESOLVED
        return explains_all or (one.ids[-1] in like and likelihood_nats(one.left) > as_much)

    return np.array([is_rival(one) for one in singles])


def _like(name: str, alike: Sequence[tuple[str, str]]) -> set[str]:
    """Return the effects that make a pair with one."""
    return {other for pair in alike if name in pair for other in pair} - {name}


def _among_rivals(confidence: Float64, rivals: Bool) -> Float64:
    """Return confidences (n,) in which the first has no more than each of its rivals: they share evenly."""
    alike = rivals.copy()
    alike[0] = True
    return np.where(alike, confidence[alike].mean(), confidence)


def _again(expected: Expected, of: Candidate) -> Candidate:
    """Return a candidate whose fit has settled."""
    return replace(judged(expected, settled(expected, of.refit)), against=of.against)


def in_question(decision: Decision) -> tuple[Candidate, Candidate] | None:
    """Return the two single effects that a measurement should tell apart; None if nothing is open.

    Of an ambiguity set they are its two likeliest; beside what is named it is the likeliest of those that the
    recording cannot tell from it.
    """
    singles = list(decision.singles)
    if decision.verdict is Verdict.NO_GAP:
        return None
    if decision.verdict is Verdict.AMBIGUOUS:
        singles = [one for one in singles if one.ids[0] in decision.ambiguous[0]]
    elif decision.verdict is Verdict.EFFECTS and singles:
        named = next((one for one in singles if one.ids[-1] in decision.chosen.ids), None)
        if named is None:
            return None
        others = _like(named.ids[-1], decision.alike) - set(decision.chosen.ids)
        singles = [named, *(one for one in singles if one.ids[-1] in others)]
    return (singles[0], singles[1]) if len(singles) > 1 else None
