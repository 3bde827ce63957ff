"""Scores of the blind check: what was answered held against what was hidden, with confidence bounds.

A recording that could not be diagnosed, or was not, is a wrong answer in every score that it belongs to. The
cosine baseline (`cosine`) always names an effect, so its scores say what chance and brute likeness achieve.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.effects import REGISTRY
from validation.blind_check.case import FAILED, MIN_SURE, VERDICTS, Case, stage_of
from validation.blind_check.plan import AGAIN

Z95 = 1.959963984540054
"""A normal variable lies within so many sigmas in 95 %."""

SEVERAL, QUIET = "DH", "EI"
"""Tiers whose recordings hide several effects, and none."""

CONFIDENCE_BINS = 10
"""Of the calibration error."""

CURVE_EDGES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 1.0)
"""Of the calibration curve: most confidences lie near 1."""

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
class Claim:
    """The confidence of what an answer names first, and whether it is hidden."""

    confidence: float
    is_right: bool


@dataclass(frozen=True)
class CalibrationBin:
    """Answers that name an effect first with a confidence above `low` up to `high`: how many are right.

    `withheld` are those whose hidden effect is not in the catalogue: none can be right.
    """

    low: float
    high: float
    in_catalogue: Rate
    withheld: Rate


@dataclass(frozen=True)
class Scores:
    """All that the opened labels say. `failures` are the recordings without a diagnosis and why."""

    rates: tuple[BlindScore, ...]
    figures: tuple[Figure, ...]
    calibration: tuple[CalibrationBin, ...]
    by_effect: tuple[EffectScore, ...]
    confusions: tuple[Confusion, ...]
    failures: tuple[tuple[str, str], ...]


def score(cases: Sequence[Case], tiers: str) -> Scores:
    """Return the scores of the tiers that were asked for."""
    rates: list[BlindScore] = []
    for tier in "ACG":
        if tier in tiers:
            rates += _one_effect(tier, _of(cases, tier))
    for tier in AGAIN:
        if "B" in tiers and tier in tiers:
            rates += _withheld(tier, _of(cases, tier))
    for tier in SEVERAL:
        if tier in tiers:
            rates += _several_effects(tier, _of(cases, tier))
    for tier in QUIET:
        if tier in tiers:
            rates += _quiet(tier, _of(cases, tier))
    if "F" in tiers:
        rates += _plain_run(_of(cases, "F"))
    if hiding := _present("ACDFGH", tiers):
        of_hiding = [case for case in cases if case.tier in hiding]
        rates += _overstated(tiers, cases, hiding, of_hiding)
        rates += _next_experiment(hiding, of_hiding)
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
        tuple(_figures(cases, tiers)),
        tuple(_calibration_curve(cases)),
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


def _present(some: str, tiers: str) -> str:
    """Return those of some tiers that were asked for."""
    return "".join(tier for tier in some if tier in tiers)


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
        row("top1", "named first, alone or beside something unknown", cases, NAMED_FIRST, cosine),
        row(
            "top1_sure",
            "named first, and nothing unknown beside it",
            cases,
            lambda c: c.named_first_for_sure,
            cosine,
        ),
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


def _withheld(tier: str, cases: list[Case]) -> list[BlindScore]:
    again = [case for case in cases if case.again is not None]
    truly = [case for case in again if case.is_truly_withheld]
    counted = [c for c in truly if c.again is not None and not c.is_unresolvable(c.again.named)]
    clear = [case for case in counted if case.answer.is_clear]

    def is_unknown(case: Case) -> bool:
        return case.again is not None and case.again.verdict == "unknown"

    def names_for_sure(case: Case) -> bool:
        again = case.again
        return again is not None and again.alone is not None and again.confidence > MIN_SURE

    mark, text_of_tier = ("B", "B") if tier == "A" else (f"B{tier}", f"B of {tier}")

    def row(name: str, text: str, rate: Rate, beside: Rate) -> BlindScore:
        return BlindScore(f"{name}_{mark}", text_of_tier, text, rate, beside)

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
            "wrong_sure",
            "one effect named alone, wrongly, with a confidence above 0.95 (less is better)",
            _rate(counted, names_for_sure),
            Rate(0, 0),
        ),
        row(
            "apart",
            "of those withheld, counted apart: a pair declared not resolvable",
            Rate(n_apart, len(truly)),
            Rate(0, 0),
        ),
        row(
            "wrongly_withheld",
            f"of {tier}, counted apart: another effect was withheld than the hidden one",
            Rate(n_wrong, len(cases)),
            Rate(0, 0),
        ),
        row(
            "not_withheld",
            f"of {tier}, not run again: no effect was named alone",
            Rate(len(cases) - len(again), len(cases)),
            Rate(0, 0),
        ),
    ]


def _several_effects(tier: str, cases: list[Case]) -> list[BlindScore]:
    def cosine_named(case: Case) -> set[str]:
        return {name for name, _ in case.cosines[: len(case.effects)]}

    all_named = "both effects" if tier == "D" else "all three effects"
    naming = [case for case in cases if case.answer.acting]
    cosine = _rate(cases, lambda c: cosine_named(c) == set(c.effects))
    row = partial(_score, tier)
    return [
        row(
            "exact",
            f"{all_named} and no other named for sure",
            _rate(cases, lambda c: c.answer.is_for_sure and c.names_all),
            cosine,
        ),
        row(
            "exact_open",
            f"{all_named} and no other, alone or beside something unknown",
            _rate(cases, lambda c: c.names_all),
            cosine,
        ),
        row(
            "no_wrong",
            "of those that name effects: no wrong one among them",
            _rate(naming, lambda c: c.names_no_wrong),
            _rate(naming, lambda c: cosine_named(c) <= set(c.effects)),
        ),
        row("top1", "one of them named first", _rate(cases, NAMED_FIRST), _rate(cases, COSINE_FIRST)),
        row(
            "detected",
            "gap found",
            _rate(cases, lambda c: c.answer.says_gap),
            Rate(len(cases), len(cases)),
        ),
    ]


def _quiet(tier: str, cases: list[Case]) -> list[BlindScore]:
    always = Rate(len(cases), len(cases))
    # E's have been named so since there was no other quiet tier.
    mark = "" if tier == "E" else f"_{tier}"
    return [
        BlindScore(
            f"false_alarm{mark}",
            tier,
            "false alarms: anything but no gap (less is better)",
            _rate(cases, lambda c: c.answer.verdict != "no_gap"),
            always,
        ),
        BlindScore(
            f"false_name{mark}",
            tier,
            "of these, an effect named (less is better)",
            _rate(cases, lambda c: bool(c.answer.named) or c.answer.verdict == FAILED),
            always,
        ),
    ]


def _overstated(
    tiers: str, cases: Sequence[Case], hiding: str, of_hiding: Sequence[Case]
) -> list[BlindScore]:
    """Return how often answers of all tiers say more than is so."""
    answers = [case.answer for case in cases] + [case.again for case in cases if case.again is not None]
    unclosed = sum(answer.says_more_than_it_closes for answer in answers)
    return [
        BlindScore(
            "unclosed",
            tiers,
            "effects named without something unknown while less than 90 % is closed (never)",
            Rate(unclosed, len(answers)),
            Rate(0, 0),
        ),
        BlindScore(
            "false_second",
            hiding,
            "a false second: an effect that is not hidden named next to one that is (less is better)",
            _rate(of_hiding, lambda c: c.names_false_second),
            Rate(0, 0),
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
            "named first and for sure with the next experiment (D and H: all and no other)",
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


def _figures(cases: Sequence[Case], tiers: str) -> list[Figure]:
    hiding = [case for case in _of(cases, "A") if case.answer.is_clear]
    closed = [c.answer.gap_closed for c in hiding]
    ratio = [_closed_over_true(c) for c in hiding]
    likeness = [case for case in cases if case.tier not in SEVERAL and case.cosines]
    cosine_error = expected_calibration_error(
        np.array([abs(case.cosines[0][1]) for case in likeness]),
        np.array([case.cosine_named_first for case in likeness], dtype=np.float64),
    )
    claims, claims_withheld = _claims(cases), _claims_withheld(cases)
    one_cause, again, timed = (_present(some, tiers) for some in ("ACEFGI", "B", "ACDEFGHI"))
    return [
        _figure("gap_closed", "A", "share of the held-out gap closed, median, gap ≥ 3 floors", closed),
        _figure(
            "closed_over_true",
            "A",
            "share closed by the best over that by the hidden effect, median, gap ≥ 3 floors",
            ratio,
        ),
        replace(
            _calibration("calibration_error", one_cause, "calibration error of the confidence", claims),
            cosine=cosine_error,
        ),
        _calibration(
            "calibration_error_withheld",
            again,
            "the same with the cause withheld: no name is right",
            claims_withheld,
        ),
        _calibration(
            "calibration_error_all",
            one_cause + again,
            "the same, with the cause and with it withheld",
            [*claims, *claims_withheld],
        ),
        _figure("wall_s", timed, "time of a diagnosis, s, median", [c.answer.wall_s for c in cases]),
        _figure("cpu_s", timed, "processor time of it, s, median", [c.answer.cpu_s for c in cases]),
    ]


def _claims(cases: Iterable[Case]) -> list[Claim]:
    """Return the confidence of what is named first, alone or beside something unknown, and if it is right.

    Several hidden effects share one ranking: which of them a confidence is about cannot be said.
    """
    return [
        Claim(case.answer.confidence, case.named_first)
        for case in cases
        if case.tier not in SEVERAL and case.answer.named
    ]


def _claims_withheld(cases: Iterable[Case]) -> list[Claim]:
    """Return the same with the hidden effect withheld. The unknown has no name, so no claim is right."""
    return [
        Claim(case.again.confidence, False)
        for case in cases
        if case.is_truly_withheld and case.again is not None and case.again.named
    ]


def _calibration(name: str, tiers: str, text: str, claims: Sequence[Claim]) -> Figure:
    confidence = np.array([claim.confidence for claim in claims])
    is_right = np.array([claim.is_right for claim in claims], dtype=np.float64)
    bounds = _drawn_again(
        len(claims), lambda drawn: expected_calibration_error(confidence[drawn], is_right[drawn])
    )
    error = expected_calibration_error(confidence, is_right)
    return Figure(name, tiers, text, error, bounds, len(claims))


def _calibration_curve(cases: Sequence[Case]) -> Iterator[CalibrationBin]:
    """Yield the bins of the reported confidence; the first one begins with 0 itself."""
    claims, claims_withheld = _claims(cases), _claims_withheld(cases)
    for low, high in itertools.pairwise(CURVE_EDGES):
        rates = [
            Rate(sum(claim.is_right for claim in within), len(within))
            for within in (
                [c for c in some if low < c.confidence <= high or c.confidence == low == 0.0]
                for some in (claims, claims_withheld)
            )
        ]
        yield CalibrationBin(low, high, *rates)


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
    for tier in "ACFG":
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
