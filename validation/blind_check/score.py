"""Scores of the blind check: what was answered held against what was hidden, with confidence bounds.

A recording that could not be diagnosed, or was not, is a wrong answer in every score that it belongs to. The
cosine baseline (`cosine`) always names an effect, so its scores say what chance and brute likeness achieve.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.effects import REGISTRY
from validation.blind_check.case import FAILED, VERDICTS, Case, stage_of

Z95 = 1.959963984540054
"""A normal variable lies within so many sigmas in 95 %."""

CONFIDENCE_BINS = 10
"""Of the calibration error."""

N_BOOTSTRAP = 1000
"""How often cases are drawn again for an interval that has no closed form."""

NAMED_FIRST, IN_THREE, BEST = map(attrgetter, ("named_first", "in_best_three", "best_is_hidden"))
COSINE_FIRST, COSINE_THREE = map(attrgetter, ("cosine_named_first", "cosine_in_best_three"))


@dataclass(frozen=True)
class Rate:
    """So many right of so many."""

    right: int
    of: int

    @property
    def share(self) -> float:
        """The rate, NaN of none."""
        return self.right / self.of if self.of else math.nan

    @property
    def bounds(self) -> tuple[float, float]:
        """Wilson's 95 % bounds (1927, J. Am. Stat. Assoc. 22, 209), NaN of none."""
        if not self.of:
            return math.nan, math.nan
        p, n = self.share, self.of
        middle = p + Z95**2 / (2.0 * n)
        half = Z95 * math.sqrt(p * (1.0 - p) / n + Z95**2 / (4.0 * n**2))
        scale = 1.0 + Z95**2 / n
        return max((middle - half) / scale, 0.0), min((middle + half) / scale, 1.0)


@dataclass(frozen=True)
class BlindScore:
    """A rate, and the baseline's beside it."""

    id: str
    tiers: str
    text: str
    rate: Rate
    cosine: Rate


@dataclass(frozen=True)
class Figure:
    """A number of `of` cases that is no rate, with its 95 % bounds; `cosine` is the baseline's, or NaN."""

    id: str
    tiers: str
    text: str
    value: float
    bounds: tuple[float, float]
    of: int
    cosine: float = math.nan


@dataclass(frozen=True)
class EffectScore:
    """How one hidden effect was answered in a tier."""

    tier: str
    effect: str
    top1: Rate
    top3: Rate
    cosine: Rate
    verdicts: Mapping[str, int]


@dataclass(frozen=True)
class Confusion:
    """A wrong answer; `unresolvable` if what was named cannot be told from what was hidden."""

    name: str
    tier: str
    hidden: tuple[str, ...]
    verdict: str
    named: tuple[str, ...]
    unresolvable: bool


@dataclass(frozen=True)
class Scores:
    """All that the opened labels say. `failures` are the recordings without a diagnosis and why."""

    rates: tuple[BlindScore, ...]
    figures: tuple[Figure, ...]
    by_effect: tuple[EffectScore, ...]
    confusions: tuple[Confusion, ...]
    failures: tuple[tuple[str, str], ...]


def score(cases: Sequence[Case], tiers: str) -> Scores:
    """Return the scores of the tiers that were asked for."""
    rates: list[BlindScore] = []
    for tier in "AC":
        if tier in tiers:
            rates += _one_effect(tier, _of(cases, tier))
    if "B" in tiers:
        rates += _withheld(_of(cases, "A"))
    if "D" in tiers:
        rates += _two_effects(_of(cases, "D"))
    if "E" in tiers:
        rates += _quiet(_of(cases, "E"))
    if "F" in tiers:
        rates += _plain_run(_of(cases, "F"))
    if hiding := "".join(tier for tier in "ACDF" if tier in tiers):
        rates += _next_experiment(hiding, [case for case in cases if case.tier in hiding])
    failures = [(case.name, case.answer.problem) for case in cases if case.answer.verdict == FAILED]
    failures += [
        (f"{case.name} without {case.answer.alone}", case.again.problem)
        for case in cases
        if case.again is not None and case.again.verdict == FAILED
    ]
    failures += [
        (f"{case.name} then {case.answer.experiment}", case.longer.problem)
        for case in cases
        if case.longer is not None and case.longer.verdict == FAILED
    ]
    return Scores(
        tuple(rates),
        tuple(_figures(cases)),
        tuple(_by_effect(cases)),
        tuple(_confusions(cases)),
        tuple(failures),
    )


def expected_calibration_error(confidence: Float64, is_right: Float64) -> float:
    """Return sum_b n_b / n |mean is_right - mean confidence| over ten equal bins b of the confidence (n,).

    Naeini, Cooper and Hauskrecht, AAAI 2015. NaN of none.
    """
    if not len(confidence):
        return math.nan
    in_bin = np.minimum((confidence * CONFIDENCE_BINS).astype(np.int64), CONFIDENCE_BINS - 1)
    off = np.bincount(in_bin, weights=is_right - confidence, minlength=CONFIDENCE_BINS)
    return float(np.abs(off).sum() / len(confidence))


def _of(cases: Iterable[Case], tier: str) -> list[Case]:
    return [case for case in cases if case.tier == tier]


def _rate(cases: Sequence[Case], is_right: Callable[[Case], bool]) -> Rate:
    return Rate(sum(map(is_right, cases)), len(cases))


def _score(tier: str, name: str, text: str, rate: Rate, beside: Rate) -> BlindScore:
    return BlindScore(f"{name}_{tier}", tier, text, rate, beside)


def _one_effect(tier: str, cases: list[Case]) -> list[BlindScore]:
    cosine = _rate(cases, COSINE_FIRST)
    clear = [case for case in cases if case.answer.is_clear or case.answer.verdict == FAILED]
    resolvable = [
        case for case in cases if case.named_first or not case.is_unresolvable(case.answer.named[:1])
    ]
    always = Rate(len(clear), len(clear))

    def row(
        name: str, text: str, chosen: list[Case], right: Callable[[Case], bool], beside: Rate
    ) -> BlindScore:
        return _score(tier, name, text, _rate(chosen, right), beside)

    return [
        row("top1", "named first", cases, NAMED_FIRST, cosine),
        row("top3", "among the best three", cases, IN_THREE, _rate(cases, COSINE_THREE)),
        row("alone", "named alone and for sure", cases, lambda c: c.answer.alone == c.effects[0], cosine),
        row("best", "named first, or ranked first where nothing is named", cases, BEST, cosine),
        row(
            "top1_resolvable",
            "named first, but for pairs declared not resolvable",
            resolvable,
            NAMED_FIRST,
            _rate(resolvable, COSINE_FIRST),
        ),
        row("top1_clear", "named first where gap ≥ 3 floors", clear, NAMED_FIRST, _rate(clear, COSINE_FIRST)),
        row("detected_clear", "gap found where gap ≥ 3 floors", clear, lambda c: c.answer.says_gap, always),
        row(
            "stage",
            "stage of the gap",
            cases,
            lambda c: c.answer.stage == stage_of(c.effects[0]),
            _rate(cases, lambda c: stage_of(c.cosine_first) == stage_of(c.effects[0])),
        ),
        row(
            "false_unknown",
            "called unknown (less is better)",
            cases,
            lambda c: c.answer.verdict in ("unknown", FAILED),
            Rate(0, len(cases)),
        ),
    ]


def _withheld(cases: list[Case]) -> list[BlindScore]:
    again = [case for case in cases if case.again is not None]
    truly = [case for case in again if case.answer.alone == case.effects[0]]
    counted = [c for c in truly if c.again is not None and not c.is_unresolvable(c.again.named)]
    clear = [case for case in counted if case.answer.is_clear]

    def is_unknown(case: Case) -> bool:
        return case.again is not None and case.again.verdict == "unknown"

    row = partial(_score, "B")
    n_apart, n_wrong = len(truly) - len(counted), len(again) - len(truly)
    return [
        row(
            "unknown",
            "unknown where the effect is withheld",
            _rate(counted, is_unknown),
            Rate(0, len(counted)),
        ),
        row(
            "unknown_clear",
            "unknown where the effect is withheld and gap ≥ 3 floors",
            _rate(clear, is_unknown),
            Rate(0, len(clear)),
        ),
        row(
            "apart",
            "of those withheld, counted apart: a pair declared not resolvable",
            Rate(n_apart, len(truly)),
            Rate(0, 0),
        ),
        row(
            "wrongly_withheld",
            "of A, counted apart: another effect was withheld than the hidden one",
            Rate(n_wrong, len(cases)),
            Rate(0, 0),
        ),
        row(
            "not_withheld",
            "of A, not run again: no effect was named alone",
            Rate(len(cases) - len(again), len(cases)),
            Rate(0, 0),
        ),
    ]


def _two_effects(cases: list[Case]) -> list[BlindScore]:
    def cosine_named(case: Case) -> set[str]:
        return {name for name, _ in case.cosines[:2]}

    row = partial(_score, "D")
    return [
        row(
            "exact",
            "both effects and no other named for sure",
            _rate(cases, lambda c: c.answer.verdict == "effects" and set(c.answer.named) == set(c.effects)),
            _rate(cases, lambda c: cosine_named(c) == set(c.effects)),
        ),
        row("top1", "one of the two named first", _rate(cases, NAMED_FIRST), _rate(cases, COSINE_FIRST)),
        row(
            "detected",
            "gap found",
            _rate(cases, lambda c: c.answer.says_gap),
            Rate(len(cases), len(cases)),
        ),
    ]


def _quiet(cases: list[Case]) -> list[BlindScore]:
    always = Rate(len(cases), len(cases))
    return [
        BlindScore(
            "false_alarm",
            "E",
            "false alarms: anything but no gap (less is better)",
            _rate(cases, lambda c: c.answer.verdict != "no_gap"),
            always,
        ),
        BlindScore(
            "false_name",
            "E",
            "of these, an effect named (less is better)",
            _rate(cases, lambda c: bool(c.answer.named) or c.answer.verdict == FAILED),
            always,
        ),
    ]


def _plain_run(cases: list[Case]) -> list[BlindScore]:
    cosine = _rate(cases, COSINE_FIRST)

    row = partial(_score, "F")
    return [
        row("top1", "named first", _rate(cases, NAMED_FIRST), cosine),
        row(
            "in_set",
            "named first, or in the ambiguity set",
            _rate(cases, lambda c: c.named_first or c.in_question),
            cosine,
        ),
        row(
            "wrong",
            "another effect named first and for sure (less is better)",
            _rate(cases, attrgetter("is_wrongly_sure")),
            Rate(cosine.of - cosine.right, cosine.of),
        ),
        row(
            "no_gap",
            "called no gap",
            _rate(cases, lambda c: c.answer.verdict == "no_gap"),
            Rate(0, len(cases)),
        ),
    ]


def _next_experiment(tiers: str, cases: list[Case]) -> list[BlindScore]:
    asked = [case for case in cases if case.answer.experiment]
    telling = [case for case in asked if case.asks_for_hidden]
    of_menu = [case for case in telling if not case.answer.asks_for_witness]
    measured = [case for case in of_menu if case.longer is not None]
    in_question = [case for case in measured if case.in_question]
    was_open = [case for case in measured if case.answer.verdict != "effects"]
    n_neither, n_missing = len(asked) - len(telling), len(of_menu) - len(measured)

    def row(name: str, text: str, rate: Rate) -> BlindScore:
        return BlindScore(f"next_{name}", tiers, text, rate, Rate(0, 0))

    return [
        row(
            "resolves",
            "named first and for sure with the next experiment (D: both and no other)",
            _rate(measured, attrgetter("is_resolved")),
        ),
        row(
            "resolves_open",
            "of these, where the first verdict was ambiguous or unknown",
            _rate(was_open, attrgetter("is_resolved")),
        ),
        row(
            "resolves_set",
            "of these, where it was ambiguous and the hidden effect in the set",
            _rate(in_question, attrgetter("is_resolved")),
        ),
        row("asked", "a next experiment asked for", Rate(len(asked), len(cases))),
        row(
            "neither",
            "of those that asked, counted apart: neither effect that it would separate is hidden",
            Rate(n_neither, len(asked)),
        ),
        row(
            "witness",
            "of those that asked, counted apart: no experiment tells, a witness is to be added",
            Rate(len(telling) - len(of_menu), len(asked)),
        ),
        row(
            "missing",
            "of those that asked, counted apart: one of them is hidden, but `more` has not measured it",
            Rate(n_missing, len(asked)),
        ),
    ]


def _figures(cases: Sequence[Case]) -> list[Figure]:
    hiding = [case for case in _of(cases, "A") if case.answer.is_clear]
    closed = [c.answer.gap_closed for c in hiding]
    ratio = [_closed_over_true(c) for c in hiding]
    # Two hidden effects share one ranking: which of them a confidence is about cannot be said.
    claims = [case for case in cases if case.tier != "D" and case.answer.named]
    is_right = np.array([case.named_first for case in claims], dtype=np.float64)
    likeness = [case for case in cases if case.tier != "D" and case.cosines]
    cosine_error = expected_calibration_error(
        np.array([abs(case.cosines[0][1]) for case in likeness]),
        np.array([case.cosine_named_first for case in likeness], dtype=np.float64),
    )
    confidence = np.array([case.answer.confidence for case in claims])
    return [
        _figure("gap_closed", "A", "share of the held-out gap closed, median, gap ≥ 3 floors", closed),
        _figure(
            "closed_over_true",
            "A",
            "share closed by the best over that by the hidden effect, median, gap ≥ 3 floors",
            ratio,
        ),
        Figure(
            "calibration_error",
            "ACEF",
            "calibration error of the confidence",
            expected_calibration_error(confidence, is_right),
            _drawn_again(
                len(claims), lambda drawn: expected_calibration_error(confidence[drawn], is_right[drawn])
            ),
            len(claims),
            cosine_error,
        ),
        _figure("wall_s", "ACDEF", "time of a diagnosis, s, median", [c.answer.wall_s for c in cases]),
        _figure("cpu_s", "ACDEF", "processor time of it, s, median", [c.answer.cpu_s for c in cases]),
    ]


def _closed_over_true(case: Case) -> float:
    """Return what the best effect closes over what the hidden one does, NaN if one was not fitted."""
    closes, hidden = case.answer.closes, case.effects[0]
    if hidden not in closes or not closes[hidden] > 0.0:
        return math.nan
    return closes.get(case.answer.best or hidden, math.nan) / closes[hidden]


def _figure(name: str, tiers: str, text: str, values: Sequence[float]) -> Figure:
    """Return the median of those values that are known."""
    known = np.array([value for value in values if math.isfinite(value)])
    bounds = _drawn_again(len(known), lambda drawn: float(np.median(known[drawn])))
    return Figure(name, tiers, text, float(np.median(known)) if len(known) else math.nan, bounds, len(known))


def _drawn_again(
    n: int, statistic: Callable[[np.ndarray[tuple[int], np.dtype[np.int64]]], float]
) -> tuple[float, float]:
    """Return the 95 % interval of a statistic over n cases that are drawn again; NaN of none."""
    if not n:
        return math.nan, math.nan
    draw = np.random.default_rng(0)
    low, high = np.percentile([statistic(draw.integers(n, size=n)) for _ in range(N_BOOTSTRAP)], [2.5, 97.5])
    return float(low), float(high)


def _by_effect(cases: Sequence[Case]) -> Iterator[EffectScore]:
    for tier in "ACF":
        for effect in REGISTRY:
            with_effect = [case for case in _of(cases, tier) if case.effects == (effect,)]
            if with_effect:
                verdicts = Counter(case.answer.verdict for case in with_effect)
                yield EffectScore(
                    tier,
                    effect,
                    _rate(with_effect, NAMED_FIRST),
                    _rate(with_effect, IN_THREE),
                    _rate(with_effect, COSINE_FIRST),
                    {verdict: verdicts[verdict] for verdict in VERDICTS},
                )


def _confusions(cases: Sequence[Case]) -> Iterator[Confusion]:
    """Yield every answer that does not name just what was hidden."""
    for case in sorted(cases, key=lambda of_case: (of_case.tier, of_case.effects, of_case.name)):
        named = case.answer.named if case.answer.verdict != "ambiguous" else case.answer.named[:1]
        is_right = set(named) == set(case.effects) and (named or case.answer.verdict == "no_gap")
        if not is_right:
            yield Confusion(
                case.name,
                case.tier,
                case.effects,
                case.answer.verdict,
                named,
                case.is_unresolvable(named),
            )
