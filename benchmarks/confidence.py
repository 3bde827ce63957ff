"""Fit and judge the probability that a leading effect mimics nothing unknown, on opened blind checks.

    python benchmarks/confidence.py CHECK ...

Of each diagnosis in which a single effect leads, the effect is right or it mimics what is hidden: another
effect, or one that was withheld. A logistic regression of that on what the report says is fitted to one half
of the diagnoses and judged on the other. Its weights are those of `sim_to_real.evidence.policy.CausePolicy`.
Random effects are left out: they are told by scatter, not by these bins.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from noise_model.compiled.arrays import Bool, Float64
from sim_to_real.evidence.confidence import cause_features
from sim_to_real.evidence.policy import POLICY
from sim_to_real.search.score_test import FAMILIES
from validation.blind_check.files import opened_results

SEED = 0
"""The seed of the division into halves, in the order of the folders' names."""

WEIGHTS = ("ln_odds", "per_nat_added", "per_nat_alone", "per_open_share")
"""Names of the weights in `CausePolicy`."""

RIDGE = 0.05
"""Weight of the squared slopes beside the log loss: some sets of diagnoses are separable."""

EDGES = np.array([0.0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0])
"""Bins of the printed calibration curve."""


@dataclass(frozen=True)
class LeadingEffect:
    """What a report says of the single effect that leads, as `cause_probability` takes it."""

    more_nats: float
    alone_nats: float
    open_share: float
    is_right: bool
    tier: str

    @property
    def features(self) -> Float64:
        """The regression's inputs (4,)."""
        return cause_features(self.more_nats, self.alone_nats, self.open_share, POLICY.cause)


def leading_effects(folder: Path) -> Iterator[LeadingEffect]:
    """Yield the effects that lead in a check's reports."""
    for result in opened_results(folder):
        found = leading_effect(result.report, result.hidden, result.without)
        if found is not None:
            yield LeadingEffect(*found, "B" if result.without else result.tier)


def leading_effect(
    report: dict[str, Any], hidden: frozenset[str], without: frozenset[str]
) -> tuple[float, float, float, bool] | None:
    """Return what a report says of its leading effect, None where no single one leads."""
    compared = [reason for reason in report["reasons"] if reason["effects"]]
    alone = [reason for reason in compared if " beside " not in reason["rule"]]
    if report["verdict"] == "no_gap" or not alone or hidden - FAMILIES.keys():
        return None
    leader = max(alone, key=lambda reason: reason["value"])
    added = [r["value"] for r in compared if r not in alone and r["effects"] == leader["effects"]]
    closed = {entry["id"]: entry["gap_closed"] for entry in report["ranking"]}.get(leader["effects"][0])
    if len(leader["effects"]) != 1 or not added or closed is None:
        return None
    unknown = max(r["value"] for r in report["reasons"] if r["rule"].startswith("evidence of unknown"))
    right = leader["effects"][0] in hidden - without
    return max(added) - leader["value"], unknown - leader["value"], 1.0 - closed, right


def fitted(features: Float64, is_right: Bool) -> Float64:
    """Return the likeliest weights (k,) of features (n, k)."""
    signs = np.where(is_right, 1.0, -1.0)

    def loss(weights: Float64) -> float:
        return float(
            np.logaddexp(0.0, -signs * (features @ weights)).sum() + RIDGE * weights[1:] @ weights[1:]
        )

    # The nats' slopes are hundredths: without a scale the search would end early.
    scale = np.array([1.0, 0.1, 0.01, 1.0])
    best = minimize(lambda w: loss(w * scale), np.zeros(features.shape[1]))
    return np.asarray(best.x * scale)


def print_judged(name: str, p: Float64, effects: list[LeadingEffect]) -> None:
    """Print calibration and rates of probabilities (n,) of effects."""
    right = np.array([effect.is_right for effect in effects])
    place = np.clip(np.digitize(p, EDGES) - 1, 0, len(EDGES) - 2)
    print(f"\n{name}: {len(p)} leading effects, {right.mean():.0%} right")
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checks", nargs="+", type=Path, help="folders of opened checks")
    asked = parser.parse_args()
    effects = [effect for folder in sorted(asked.checks) for effect in leading_effects(folder)]
    features = np.array([effect.features for effect in effects])
    right = np.array([effect.is_right for effect in effects])
    is_fitted = np.random.default_rng(SEED).random(len(effects)) < 0.5
    weights = fitted(features[is_fitted], right[is_fitted])
    print(", ".join(f"{name} = {value:.4f}" for name, value in zip(WEIGHTS, weights, strict=True)))
    judged = [effect for effect, is_in in zip(effects, is_fitted, strict=True) if not is_in]
    p = expit(features[~is_fitted] @ POLICY.cause.weights)
    print_judged("the other half, by the policy's weights", p, judged)


if __name__ == "__main__":
    main()
