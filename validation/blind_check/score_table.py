"""The blind check's scores as Markdown."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from validation.blind_check.blind_check import CheckPlan, CheckScores
from validation.blind_check.case import VERDICTS
from validation.blind_check.score import Confusion, Rate, Scores

NONE = "–"


def table(opened: CheckScores) -> str:
    """Return all scores, a table an effect's and what went wrong, as Markdown."""
    scores = opened.scores
    parts = [
        f"{', '.join(map(_options, opened.asked))}: "
        f"{opened.n_planned} recordings planned, {opened.n_made} made; "
        f"diagnoses that failed or are missing, counted as wrong: {len(scores.failures)}.",
        _rows(("tier", "score", "right", "rate", "95 % bounds", "cosine"), _rates(scores)),
        _rows(("tiers", "figure", "n", "value", "95 % bounds", "cosine"), _figures(scores)),
        "Calibration of the confidence of what is named first:",
        _rows(
            ("confidence", "right", "share", "95 % bounds", "cause withheld: right", "share of all"),
            _calibration(scores),
        ),
        _rows(("tier", "effect", "n", "named first", "best three", "cosine", *VERDICTS), _by_effect(scores)),
    ]
    if scores.confusions:
        parts += ["Wrong answers:", _rows(("recording", "tier", "hidden", "answered"), _confusions(scores))]
    if scores.failures:
        parts += ["Without a diagnosis:", "\n".join(f"- {name}: {why}" for name, why in scores.failures)]
    return "\n\n".join(parts) + "\n"


def _options(asked: CheckPlan) -> str:
    options = (f"--{name.replace('_', '-')} {value}" for name, value in vars(asked).items())
    return f"`{' '.join(options)}`"


def _rows(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    every = [head, ["---"] * len(head), *lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in every)


def _rates(scores: Scores) -> Iterable[Sequence[str]]:
    for score in scores.rates:
        rate = score.rate
        bounds = " to ".join(map(_percent, rate.bounds)) if rate.of else NONE
        yield (
            score.tiers,
            score.text,
            _count(rate),
            _percent(rate.share),
            bounds,
            _percent(score.cosine.share),
        )


def _figures(scores: Scores) -> Iterable[Sequence[str]]:
    for figure in scores.figures:
        bounds = " to ".join(map(_number, figure.bounds)) if figure.of else NONE
        yield figure.tiers, figure.text, str(figure.of), _number(figure.value), bounds, _number(figure.cosine)


def _calibration(scores: Scores) -> Iterable[Sequence[str]]:
    for kept in scores.calibration:
        known, withheld = kept.in_catalogue, kept.withheld
        bounds = " to ".join(map(_percent, known.bounds)) if known.of else NONE
        pooled = Rate(known.right + withheld.right, known.of + withheld.of)
        confidence = f"{kept.low:g} to {kept.high:g}"
        yield (
            confidence,
            _count(known),
            _percent(known.share),
            bounds,
            _count(withheld),
            _percent(pooled.share),
        )


def _by_effect(scores: Scores) -> Iterable[Sequence[str]]:
    for score in scores.by_effect:
        counts = [str(score.verdicts[verdict] or "") for verdict in VERDICTS]
        rights = [str(rate.right) for rate in (score.top1, score.top3, score.cosine)]
        yield score.tier, score.effect, str(score.top1.of), *rights, *counts


def _confusions(scores: Scores) -> Iterable[Sequence[str]]:
    for confusion in scores.confusions:
        yield confusion.name, confusion.tier, " + ".join(confusion.hidden) or "nothing", _answered(confusion)


def _answered(confusion: Confusion) -> str:
    apart = ", a pair declared not resolvable" if confusion.unresolvable else ""
    return " ".join((confusion.verdict, " + ".join(confusion.named))).strip() + apart


def _count(rate: Rate) -> str:
    return f"{rate.right} of {rate.of}"


def _percent(share: float) -> str:
    return NONE if math.isnan(share) else f"{100.0 * share:.0f} %"


def _number(value: float) -> str:
    return NONE if math.isnan(value) else f"{value:.3g}"
