"""How many verdicts of blind checks flip where a constant of the judgement is 20 % larger or smaller.

    python benchmarks/policy_sensitivity.py CHECK ... [--again N --workers N]

The posteriors of opened checks are weighed anew from the evidence that their reports hold: nothing is fitted.
So the constants that come after the evidence are varied. `--again` diagnoses N recordings anew, once for each
change of the others. `temperature` is fitted as well: the one at which what is said has the largest
probability of being right, over all recordings with an effect or without.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import random
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from arctrack.recording import BadFrame, pose_at, read_recording
from sim_to_real.diagnose import diagnose
from sim_to_real.evidence.hypotheses import Posterior
from sim_to_real.evidence.policy import POLICY, Policy
from sim_to_real.evidence.weigh import judge
from sim_to_real.search.score_test import FAMILIES
from validation.blind_check.files import opened_results

SHARE = 0.2
"""By so much a constant is changed."""

AFTER_EVIDENCE = ("temperature", "ln_odds_effect", "ln_odds_further", "ln_odds_unknown", "named", "possible")

NEED_FITS = tuple(field.name for field in fields(Policy) if field.name not in AFTER_EVIDENCE)

SEED = 0
"""The seed of the choice of recordings that are diagnosed anew."""

TEMPERATURES = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0)

UNKNOWN, BESIDE = "evidence of unknown", " beside unknown"
"""How the rule of an unknown cause begins in a report, and what it says of one beside effects."""

MIN_LN = -30.0
"""What is less probable counts as improbable as this."""


@dataclass(frozen=True)
class Told:
    """A hypothesis as a report tells it: effects, log evidence, nats, and an unknown cause beside them."""

    ids: tuple[str, ...]
    evidence: float
    with_unknown: Told | None = None


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
    for result in opened_results(folder):
        reasons = result.report["reasons"]
        every = {reason["rule"]: Told(tuple(reason["effects"]), reason["value"]) for reason in reasons}
        (unknown,) = (told for rule, told in every.items() if rule.startswith(UNKNOWN))
        (none,) = (told for told in every.values() if not told.ids and told is not unknown)
        beside = {rule.partition(BESIDE)[0]: told for rule, told in every.items() if BESIDE in rule}
        hypotheses = tuple(
            replace(told, with_unknown=beside.get(rule.partition(",")[0]))
            for rule, told in every.items()
            if told.ids and BESIDE not in rule
        )
        hidden = None if result.hidden & result.without else result.hidden
        n_effects = len(FAMILIES) - len(result.without)
        yield Compared(none, hypotheses, unknown, n_effects, hidden)


def changes(names: Sequence[str]) -> Iterator[tuple[str, Policy]]:
    """Yield each constant's name with the policies in which it is smaller, then larger."""
    for name in names:
        value = getattr(POLICY, name)
        for factor in (1.0 - SHARE, 1.0 + SHARE):
            if isinstance(value, tuple):
                changed: Any = tuple(factor * size for size in value)
            elif isinstance(value, int):
                changed = round(factor * value)
            else:
                changed = min(factor * value, 1.0 if name in ("named", "possible") else math.inf)
            yield name, replace(POLICY, **{name: changed})


def diagnosed(job: tuple[Path, tuple[str, ...], Policy]) -> tuple[Any, ...]:
    """Return the verdict on a recording, with what is named and what shares the posterior."""
    path, without, policy = job
    recording = read_recording(path)
    frames = [frame for frame in recording.frames() if not isinstance(frame, BadFrame)]
    poses = partial(pose_at, recording.pose_buffer())
    said = diagnose(recording.setup, frames, poses, without=without, policy=policy)
    named = frozenset(effect.id for effect in said.effects)
    return said.verdict, named, frozenset(map(frozenset, said.ambiguous_with))


def print_row(name: str, flips: Sequence[int]) -> None:
    """Print a constant, its value, and how many verdicts flip where it is smaller, then larger."""
    print(f"| `{name}` | {getattr(POLICY, name)} | {flips[0]} | {flips[1]} |", flush=True)


def print_again(folders: Sequence[Path], count: int, workers: int) -> None:
    """Diagnose some recordings anew with each change of the constants that the evidence needs."""
    results = [path for folder in folders for path in sorted((folder / "results").glob("*.json"))]
    chosen = random.Random(SEED).sample(results, min(count, len(results)))
    told = [json.loads(path.read_text(encoding="utf-8")) for path in chosen]
    recordings = [
        (path.parents[1] / "recordings" / result["recording"], tuple(result["without"]))
        for path, result in zip(chosen, told, strict=True)
    ]
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        was = list(pool.map(diagnosed, [(*recording, POLICY) for recording in recordings]))
        print(f"\n{len(was)} diagnosed anew\n")
        print("| constant | value | flips at -20 % | at +20 % |\n| --- | --- | --- | --- |")
        for name, pair in itertools.groupby(changes(NEED_FITS), key=lambda change: change[0]):
            flips = []
            for _, policy in pair:
                now = pool.map(diagnosed, [(*recording, policy) for recording in recordings])
                flips.append(sum(said != before for said, before in zip(now, was, strict=True)))
            print_row(name, flips)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checks", nargs="+", type=Path, help="folders of opened checks")
    parser.add_argument("--again", type=int, default=0, help="so many recordings are diagnosed anew")
    parser.add_argument("--workers", type=int, default=1, help="processes that diagnose")
    asked = parser.parse_args()
    every = [recording for folder in asked.checks for recording in compared(folder)]
    said = [recording.verdict(POLICY) for recording in every]
    print(f"{len(every)} diagnoses\n")
    print("| constant | value | flips at -20 % | at +20 % |\n| --- | --- | --- | --- |")
    for name, pair in itertools.groupby(changes(AFTER_EVIDENCE), key=lambda change: change[0]):
        flips = [sum(r.verdict(p) != was for r, was in zip(every, said, strict=True)) for _, p in pair]
        print_row(name, flips)
    print("\n| temperature | mean ln probability of what is right |\n| --- | --- |")
    for temperature in TEMPERATURES:
        policy = replace(POLICY, temperature=temperature)
        print(f"| {temperature:g} | {np.mean([recording.ln_right(policy) for recording in every]):.3f} |")
    if asked.again:
        print_again(asked.checks, asked.again, asked.workers)


if __name__ == "__main__":
    main()
