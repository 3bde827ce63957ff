"""How many verdicts of blind checks flip where a constant of the judgement is 20 % larger or smaller.

    python benchmarks/policy_sensitivity.py CHECK ...

The posteriors of opened checks are weighed anew from the evidence that their reports hold: nothing is fitted.
So only the constants that come after the evidence are varied. `temperature` is fitted as well: the one at
which what is said has the largest probability of being right, over all recordings with an effect or without.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim_to_real.evidence.hypotheses import Posterior
from sim_to_real.evidence.judgement import judge
from sim_to_real.evidence.policy import POLICY, Policy
from sim_to_real.search.probe_points import FAMILIES

SHARE = 0.2
"""By so much a constant is changed."""

VARIED = ("temperature", "ln_odds_effect", "ln_odds_further", "ln_odds_unknown", "named", "possible")

TEMPERATURES = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0)

UNKNOWN = "evidence of unknown"
"""How the rule of an unknown cause begins in a report."""

MIN_LN = -30.0
"""What is less probable counts as improbable as this."""


@dataclass(frozen=True)
class Told:
    """A hypothesis as a report tells it: effects, and the log evidence, nats."""

    ids: tuple[str, ...]
    evidence: float


@dataclass(frozen=True)
class Compared:
    """What was compared in a recording: no gap, hypotheses with effects, an unknown cause.

    `n_effects` were candidates. `hidden` is what is right, None if that is not in the catalogue.
    """

    none: Told
    hypotheses: tuple[Told, ...]
    unknown: Told
    n_effects: int
    hidden: frozenset[str] | None

    def posterior(self, policy: Policy) -> Posterior:
        """Return the posterior that a policy gives."""
        told: Any = self
        return Posterior.of(told.none, told.hypotheses, told.unknown, self.n_effects, policy)

    def verdict(self, policy: Policy) -> tuple[Any, ...]:
        """Return the verdict, with what is named and what shares the posterior."""
        said = judge(self.posterior(policy), policy)
        return said.verdict, frozenset(said.named), frozenset(map(frozenset, said.ambiguous))

    def ln_right(self, policy: Policy) -> float:
        """Return ln of the probability that a policy gives to what is right, `MIN_LN` at least."""
        posterior = self.posterior(policy)
        each = zip(posterior.hypotheses, posterior.p, strict=True)
        right = sum(p for hypothesis, p in each if frozenset(hypothesis.ids) == self.hidden)
        if not self.hidden:
            right = posterior.p_unknown if self.hidden is None else posterior.p_none
        return max(math.log(max(right, math.exp(MIN_LN))), MIN_LN)


def compared(folder: Path) -> Iterator[Compared]:
    """Yield what was compared in each recording of an opened check that has a report."""
    labels = json.loads((folder / "labels.json").read_text(encoding="utf-8"))["labels"]
    for path in sorted((folder / "results").glob("*.json")):
        result = json.loads(path.read_text(encoding="utf-8"))
        if result["problem"] is not None or result["experiment"] is not None:
            continue
        reasons = result["report"]["reasons"]
        told = [Told(tuple(reason["effects"]), reason["value"]) for reason in reasons]
        is_unknown = [reason["rule"].startswith(UNKNOWN) for reason in reasons]
        (none,) = (h for h, is_it in zip(told, is_unknown, strict=True) if not is_it and not h.ids)
        (unknown,) = itertools.compress(told, is_unknown)
        hidden: frozenset[str] | None = frozenset(labels[result["recording"]]["label"]["effects"])
        if hidden and hidden & set(result["without"]):
            hidden = None
        n_effects = len(FAMILIES) - len(result["without"])
        yield Compared(none, tuple(h for h in told if h.ids), unknown, n_effects, hidden)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checks", nargs="+", type=Path, help="folders of opened checks")
    every = [recording for folder in parser.parse_args().checks for recording in compared(folder)]
    said = [recording.verdict(POLICY) for recording in every]
    print(f"{len(every)} diagnoses\n")
    print("| constant | value | flips at -20 % | at +20 % |\n| --- | --- | --- | --- |")
    for name in VARIED:
        value = getattr(POLICY, name)
        flips = []
        for sign in (-1.0, 1.0):
            most = 1.0 if name in ("named", "possible") else math.inf
            changed = replace(POLICY, **{name: min(value * (1.0 + sign * SHARE), most)})
            flips.append(sum(r.verdict(changed) != was for r, was in zip(every, said, strict=True)))
        print(f"| `{name}` | {value:g} | {flips[0]} | {flips[1]} |")
    print("\n| temperature | mean ln probability of what is right |\n| --- | --- |")
    for temperature in TEMPERATURES:
        policy = replace(POLICY, temperature=temperature)
        print(f"| {temperature:g} | {np.mean([recording.ln_right(policy) for recording in every]):.3f} |")


if __name__ == "__main__":
    main()
