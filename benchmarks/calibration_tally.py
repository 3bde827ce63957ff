"""Errors of calibrated values over worlds of known truth: bias, coverage, error and sigma over the bound."""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import norm

FAMILY_ALARM = 0.0027
"""The probability that any of the values is called biased without being so: 3 sigma."""


@dataclass
class Tally:
    """Of each value: errors over sigma, whether intervals hold the truth, both over the bound."""

    off: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    inside: dict[str, list[bool]] = field(default_factory=lambda: defaultdict(list))
    over_bound: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: defaultdict(list))

    def add(self, name: str, error: float, sigma: float, is_inside: bool, bound: float | None) -> None:
        """Add a world's value; `bound` is the least sigma that it could have, None where none is known."""
        self.off[name].append(error / sigma)
        self.inside[name].append(is_inside)
        if bound is not None:
            self.over_bound[name].append((error / bound, sigma / bound))

    def report(self) -> None:
        """Print a line a value."""
        limit = norm.isf(0.5 * FAMILY_ALARM / len(self.off))
        print(f"bias in standard errors of the mean (Bonferroni's limit {limit:.1f}); error over the bound")
        for name, z in self.off.items():
            bias = np.mean(z) / np.std(z) * math.sqrt(len(z))
            over = ""
            if name in self.over_bound:
                errors, sigmas = np.sqrt(np.mean(np.square(self.over_bound[name]), axis=0))
                over = f"error/bound {errors:.2f}  sigma/bound {sigmas:.2f}"
            print(
                f"{name:16} {len(z)} worlds  bias {bias:+5.2f} ({np.mean(z):+.2f} sigma)  "
                f"covered {100.0 * np.mean(self.inside[name]):5.1f} %  {over}".rstrip()
            )


def judge_worlds(judge: Callable[[int, int], None], about: str | None) -> None:
    """Read --worlds and --seed, and judge so many worlds."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--worlds", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    judge(chosen.worlds, chosen.seed)
