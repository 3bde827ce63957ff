"""How many verdicts of blind checks flip where a constant of the judgement is 20 % larger or smaller.

    python benchmarks/policy_sensitivity.py CHECK ...

The posteriors of opened checks are weighed anew from the evidence that their reports hold: nothing is fitted.
So only the constants that come after the evidence are varied. `temperature` is fitted as well: the one at
which what is said has the largest probability of being right, over all recordings with an effect or without.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from sim_to_real.evidence.judgement import judge
from sim_to_real.evidence.policy import POLICY, Policy
from sim_to_real.search.probe_points import FAMILIES

SHARE = 0.2
"""By so much a constant is changed."""

VARIED = ("temperature", "ln_odds_effect", "ln_odds_further", "ln_odds_unknown", "named", "possible")

TEMPERATURES = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0)

UNKNOWN = "evidence of unknown"


@dataclass(frozen=True)
class Compared:
    """The hypotheses of a recording: effects, None for unknown, with evidence, nats, and ln prior odds.

    The odds are those that no policy holds: effects share theirs evenly, and forms of the same effects.
    `hidden` is what is right, None if that is not in the catalogue.
    """

    name: str
    hypotheses: tuple[frozenset[str] | None, ...]
    evidence: tuple[float, ...]
    ln_odds: tuple[float, ...]
    hidden: frozenset[str] | None

    def ln_posterior(self, policy: Policy) -> np.ndarray:
        """Return the ln probabilities (n,) that a policy gives."""
        ln = [
            nats / policy.temperature + odds + _ln_odds(effects, policy)
            for effects, nats, odds in zip(self.hypotheses, self.evidence, self.ln_odds, strict=True)
        ]
        return np.array(ln) - logsumexp(ln)

    def verdict(self, policy: Policy) -> tuple[Any, ...]:
        """Return the verdict, with what is named and what shares the posterior."""
        p = dict(zip(range(len(self.hypotheses)), np.exp(self.ln_posterior(policy)), strict=True))
        unknown = next(n for n, effects in enumerate(self.hypotheses) if effects is None)
        none = self.hypotheses.index(frozenset())
        ranked = sorted((n for n in p if n not in (unknown, none)), key=lambda n: -p[n])
        of_effects: dict[str, float] = {}
        for n in ranked:
            for name in self.hypotheses[n] or ():
                of_effects[name] = of_effects.get(name, 0.0) + p[n]
        posterior: Any = SimpleNamespace(
            none=SimpleNamespace(ids=()),
            hypotheses=[SimpleNamespace(ids=tuple(sorted(self.hypotheses[n] or ()))) for n in ranked],
            p=[p[n] for n in ranked],
            p_none=p[none],
            p_unknown=p[unknown],
            of_effects=of_effects,
        )
        said = judge(posterior, policy)
        return said.verdict, frozenset(said.named), frozenset(map(frozenset, said.ambiguous))


def _ln_odds(effects: frozenset[str] | None, policy: Policy) -> float:
    if effects is None:
        return policy.ln_odds_unknown
    return policy.ln_odds_effect + (len(effects) - 1) * policy.ln_odds_further if effects else 0.0


def compared(folder: Path) -> Iterator[Compared]:
    """Yield what was compared in each recording of an opened check that has a report."""
    labels = json.loads((folder / "labels.json").read_text(encoding="utf-8"))["labels"]
    for path in sorted((folder / "results").glob("*.json")):
        result = json.loads(path.read_text(encoding="utf-8"))
        if result["problem"] is not None:
            continue
        reasons = result["report"]["reasons"]
        effects = [None if r["rule"].startswith(UNKNOWN) else frozenset(r["effects"]) for r in reasons]
        if result["experiment"] is not None or frozenset() not in effects or None not in effects:
            continue
        hidden: frozenset[str] | None = frozenset(labels[result["recording"]]["label"]["effects"])
        if hidden and hidden & set(result["without"]):
            hidden = None
        forms, n_effects = Counter(effects), len(FAMILIES) - len(result["without"])
        ln_odds = [-len(e or ()) * math.log(n_effects) - math.log(forms[e]) for e in effects]
        evidence = [reason["value"] - reason["limit"] for reason in reasons]
        yield Compared(path.stem, tuple(effects), tuple(evidence), tuple(ln_odds), hidden)


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
        print(f"| {temperature:g} | {np.mean([_ln_right(recording, policy) for recording in every]):.3f} |")


def _ln_right(recording: Compared, policy: Policy) -> float:
    """Return ln of the probability that a policy gives to what is right, -30 at least."""
    ln, hidden = recording.ln_posterior(policy), recording.hidden
    right = [value for effects, value in zip(recording.hypotheses, ln, strict=True) if effects == hidden]
    return max(float(logsumexp(right)) if right else -30.0, -30.0)


if __name__ == "__main__":
    main()
