"""Fit and judge the probabilities that stand behind a confidence, on opened blind checks.

    python benchmarks/confidence.py CHECK ...

Of each diagnosis in which a single effect leads, the effect is right or it mimics what is hidden: another
effect, or one that was withheld. A logistic regression of that on what the report says is fitted to one half
of the diagnoses and judged on the other. Its weights are those of `sim_to_real.evidence.policy.CausePolicy`.
Of two effects that lead, one of them right, each is there or not: the weights of `NeedPolicy` are fitted and
judged alike. Random effects are left out: they are told by scatter, not by these bins.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from noise_model.compiled.arrays import Bool, Float64
from sim_to_real.evidence.confidence import cause_features, need_features
from sim_to_real.evidence.policy import POLICY
from sim_to_real.search.score_test import FAMILIES
from validation.blind_check.files import opened_results

SEED = 0
"""The seed of the division into halves, in the order of the folders' names."""

WEIGHTS = ("ln_odds", "per_nat_added", "per_nat_alone", "per_open_share")
"""Names of the weights in `CausePolicy`."""

NEED_WEIGHTS = ("ln_odds", "per_ln_nat", "per_nat_added")
"""Names of the weights in `NeedPolicy`."""

RIDGE = 0.05
"""Weight of the squared slopes beside the log loss: some sets of diagnoses are separable."""

BESIDE = " beside "
"""What the rule of effects with an unknown cause says."""

EDGES = np.array([0.0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0])
"""Bins of the printed calibration curve."""


@dataclass(frozen=True)
class Judged:
    """What a report says of an effect, as a regression takes it: its inputs (k,), and whether it is there."""

    features: Float64
    is_right: bool
    tier: str


def led(folder: Path) -> Iterator[tuple[list[Judged], list[Judged]]]:
    """Yield of each report of a check the single effect that leads, and each of two that lead; or nothing."""
    for result in opened_results(folder):
        compared = [reason for reason in result.report["reasons"] if reason["effects"]]
        alone = [reason for reason in compared if BESIDE not in reason["rule"]]
        is_random = result.hidden - FAMILIES.keys()
        if result.report["verdict"] == "no_gap" or not alone or is_random:
            continue
        leader = max(alone, key=lambda reason: reason["value"])
        added = [r["value"] for r in compared if r not in alone and r["effects"] == leader["effects"]]
        more_nats = max(added, default=-math.inf) - leader["value"]
        true, tier = result.hidden - result.without, "B" if result.without else result.tier
        if len(leader["effects"]) == 1:
            features = single_features(result.report, leader, more_nats)
            if added and features is not None:
                yield [Judged(features, leader["effects"][0] in true, tier)], []
        elif true.intersection(leader["effects"]):
            yield (
                [],
                [
                    Judged(
                        need_features(needed_nats(name, leader, alone), more_nats, POLICY.need),
                        name in true,
                        tier,
                    )
                    for name in leader["effects"]
                ],
            )


def single_features(report: dict[str, Any], leader: dict[str, Any], more_nats: float) -> Float64 | None:
    """Return what a report says of its leading effect (4,), None where it does not say what that closes."""
    closed = {entry["id"]: entry["gap_closed"] for entry in report["ranking"]}.get(leader["effects"][0])
    if closed is None:
        return None
    unknown = max(r["value"] for r in report["reasons"] if r["rule"].startswith("evidence of unknown"))
    return cause_features(more_nats, unknown - leader["value"], 1.0 - closed, POLICY.cause)


def needed_nats(name: str, leader: dict[str, Any], alone: list[dict[str, Any]]) -> float:
    """Return by how many nats two effects are likelier than the other one alone, or than no gap."""
    fewer = [r["value"] for r in alone if r["effects"] == [e for e in leader["effects"] if e != name]]
    return float(leader["value"] - max([0.0, *fewer]))


def fitted(features: Float64, is_right: Bool, scale: Float64) -> Float64:
    """Return the likeliest weights (k,) of features (n, k); they are of the size of `scale` (k,)."""
    signs = np.where(is_right, 1.0, -1.0)

    def loss(weights: Float64) -> float:
        return float(
            np.logaddexp(0.0, -signs * (features @ weights)).sum() + RIDGE * weights[1:] @ weights[1:]
        )

    # Nats' slopes are hundredths: without a scale the search would end early.
    best = minimize(lambda w: loss(w * scale), np.zeros(features.shape[1]))
    return np.asarray(best.x * scale)


def print_judged(name: str, p: Float64, effects: list[Judged]) -> None:
    """Print calibration and rates of probabilities (n,) of effects."""
    right = np.array([effect.is_right for effect in effects])
    place = np.clip(np.digitize(p, EDGES) - 1, 0, len(EDGES) - 2)
    print(f"\n{name}: {len(p)} effects, {right.mean():.0%} right")
    print("| stated | effects | mean | right |\n| --- | --- | --- | --- |")
    error = 0.0
    for n in np.unique(place):
        of_bin = place == n
        error += of_bin.mean() * abs(right[of_bin].mean() - p[of_bin].mean())
        row = f"{EDGES[n]:g} to {EDGES[n + 1]:g} | {of_bin.sum()} | {p[of_bin].mean():.3f}"
        print(f"| {row} | {right[of_bin].mean():.3f} |")
    print(f"calibration error {error:.3f}")
    for tier in sorted({effect.tier for effect in effects}):
        of_tier = np.array([effect.tier == tier for effect in effects])
        sure = of_tier & (p > 0.95)
        print(
            f"{tier}: {(of_tier & right).sum()} of {of_tier.sum()} right, "
            f"{(of_tier & right & (p < 0.5)).sum()} right ones below 0.5, "
            f"{(of_tier & ~right & (p >= 0.5)).sum()} wrong ones from 0.5 on, "
            f"{(sure & ~right).sum()} above 0.95"
        )


def judge_weights(
    what: str, groups: list[list[Judged]], names: tuple[str, ...], weights: Float64, scale: Float64
) -> None:
    """Print the weights that one half of the reports gives, and how the policy's do on the other."""
    is_fitted = np.random.default_rng(SEED).random(len(groups)) < 0.5
    first = [effect for group, is_in in zip(groups, is_fitted, strict=True) if is_in for effect in group]
    other = [effect for group, is_in in zip(groups, is_fitted, strict=True) if not is_in for effect in group]
    best = fitted(np.array([e.features for e in first]), np.array([e.is_right for e in first]), scale)
    print(f"\n{what}: " + ", ".join(f"{name} = {value:.4f}" for name, value in zip(names, best, strict=True)))
    p = expit(np.array([effect.features for effect in other]) @ weights)
    print_judged("the other half, by the policy's weights", p, other)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checks", nargs="+", type=Path, help="folders of opened checks")
    asked = parser.parse_args()
    every = [led_by for folder in sorted(asked.checks) for led_by in led(folder)]
    singles, pairs = ([group for group in side if group] for side in zip(*every, strict=True))
    judge_weights("single effects", singles, WEIGHTS, POLICY.cause.weights, np.array([1.0, 0.1, 0.01, 1.0]))
    judge_weights("each of two effects", pairs, NEED_WEIGHTS, POLICY.need.weights, np.array([1.0, 1.0, 0.1]))


if __name__ == "__main__":
    main()
