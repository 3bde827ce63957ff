"""Calibrate the diagnosis' global p-value on half of the quiet recordings of blind checks, judge it on half.

    python benchmarks/model_test.py CHECK ...

Prints the quantiles of each statistic that `sim_to_real.decision.model_test.QUIET` holds, whether the
p-values of the other half are uniform (Kolmogorov and Smirnov), and how often recordings that hide something
are below 0.01, by tier.
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import logit
from scipy.stats import kstest

from noise_model.compiled.arrays import Float64
from sim_to_real.decision.model_test import PROBABILITIES, QUIET, global_p_value
from validation.blind_check.files import opened_results

SEED = 0
"""The seed of the division into halves, the folder whose name is last coming first."""

RANDOM = ("read_noise", "fixed_pattern", "laser_speckle", "spatter", "image_compression")


def statistics(folder: Path) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield each recording's tier and statistics as its report has them."""
    for result in opened_results(folder):
        if not result.without:
            yield result.tier, of_report(result.report)


def of_report(report: Mapping[str, Any]) -> dict[str, float]:
    """Return the statistics of one report."""
    others = [r["value"] for r in report["reasons"] if not r["rule"].startswith("evidence of no gap")]
    random = [entry["confidence"] for entry in report["ranking"] if entry["id"] in RANDOM]
    return {
        "held_out_gap": (report["gap"]["before"] or 0.0) / report["gap"]["floor"],
        "bins": max(others),
        # Confidences are rounded: none is nearer to 1 than this.
        "scatter": float(logit(min(max(random), 1.0 - 1e-6))) if random else math.nan,
    }


def p_value(found: Mapping[str, float]) -> float:
    """Return the global p-value of a recording's statistics."""
    return global_p_value([QUIET[name].p_value(value) for name, value in found.items()])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checks", nargs="+", type=Path, help="folders of opened checks")
    tiers: dict[str, list[dict[str, float]]] = defaultdict(list)
    for folder in sorted(parser.parse_args().checks, reverse=True):
        for tier, found in statistics(folder):
            tiers[tier].append(found)
    quiet = tiers.pop("E")
    is_fitted = np.random.default_rng(SEED).random(len(quiet)) < 0.5
    for name in QUIET:
        values: Float64 = np.array([found[name] for found in quiet])[is_fitted]
        quantiles = np.quantile(values, PROBABILITIES)
        tail = (quantiles[-2] - quantiles[-4]) / math.log(5.0)
        print(f"{name}: {', '.join(f'{q:.3f}' for q in quantiles)}; tail {tail:.3f}")
    p = np.array([p_value(found) for found, is_in in zip(quiet, is_fitted, strict=True) if not is_in])
    print(f"other half: {len(p)} quiet, KS p {kstest(p, 'uniform').pvalue:.2f}, ", end="")
    print(f"{np.sum(p < 0.05)} below 0.05, {np.sum(p < 0.01)} below 0.01")
    for tier, hiding in sorted(tiers.items()):
        print(f"{tier}: {sum(p_value(found) < 0.01 for found in hiding)} of {len(hiding)} below 0.01")


if __name__ == "__main__":
    main()
