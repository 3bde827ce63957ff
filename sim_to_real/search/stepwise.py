"""Several effects: what explains a gap together with the likeliest one, and each one's share of it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from sim_to_real.fit.gauss_newton import NAMED_FROM, Refit, refit_from, settled
from sim_to_real.fit.linearized_model import Expected
from sim_to_real.search.hypothesis import (
    AT_FLOOR,
    CLEARLY_LEFT,
    HALVES,
    SHOWN_FROM,
    Candidate,
    best_first,
    judged,
    left_over,
)
from sim_to_real.search.probe_points import is_trifle
from sim_to_real.search.score_test import Screened, seen_from
from sim_to_real.search.score_test_pairs import screen_pairs
from sim_to_real.search.single_effects import (
    RESOLVED,
    Search,
    candidates,
    looked,
    nats_at_look,
    with_dear,
    with_flicker,
)

EXPLAINED = 0.12
"""A gap of which more is left is not explained by several effects."""

BESIDE_NATS = 10.0
"""With so much evidence of its own an effect is named beside others that explain the gap, or have most of it.

Beside an effect of its own form the likeliest other one gains 4 nats at most.
"""

MAY_BESIDE_NATS = 6.0
"""With less at the first look no effect is fitted beside one that leaves nothing else to be explained."""

LEAST_SHARE = 0.05
"""An effect with a smaller share of what is closed is not named beside others without `BESIDE_NATS`."""

WORTH = 0.7
"""A further effect must close this share of what the others leave."""

SEVERAL_LEAVE, SEVERAL_FORESEE = 1.2, 1.5
"""Several effects must explain all that there is: two or three mimic most of another one's gap.

The first is for frames left out; the second is, where they leave no more than the floor of those fitted, or
nothing that pixels show.
"""

PAIRS = 3
"""So many pairs are fitted where the likeliest effect does not explain the gap."""

MOST_EFFECTS = 3
"""So many effects are named at most."""


def beside(
    search: Search,
    baseline: Candidate,
    best: Candidate,
    explained: bool,
    start: Refit,
    screened: Sequence[Screened],
) -> Candidate | None:
    """Return what explains the gap together with the best effect, where that leaves something; or None.

    Of a best effect that explains the gap the pixels have been asked. Where it leaves some, it may mimic two
    others: all were looked at from `start`.
    """
    if best.is_held_back and left_over(best, baseline) <= EXPLAINED:
        # Almost all of it is one other effect's, and what is added would only lend the mimic more numbers.
        return None
    if not explained or best.left > CLEARLY_LEFT:
        return several(search, baseline, best, _pairs(search, start, screened))
    shown = best.left_in_pixels > AT_FLOOR
    if not shown and not _may_gain(search, best.refit, screened):
        return None
    found = several(search, baseline, best)
    if found is None:
        return None
    if found.of_bins - best.of_bins >= BESIDE_NATS and not is_trifle(_added(found), search.expected.stated):
        return found
    if not shown:
        return None
    # If others do not halve it, it is the effect's form that pixels show.
    left = search.asked(found).left_in_pixels - 1.0
    return None if left > HALVES * (best.left_in_pixels - 1.0) else found


def _may_gain(search: Search, fitted: Refit, screened: Sequence[Screened]) -> bool:
    """Say whether an effect beside those that were fitted seems to gain enough to be looked into."""
    looks = with_flicker(search, fitted, seen_from(fitted, screened))
    return max((nats_at_look(one, fitted) for one in looks), default=0.0) >= MAY_BESIDE_NATS


def _pairs(search: Search, start: Refit, screened: Sequence[Screened]) -> list[Candidate]:
    """Return fits of the pairs that are likeliest at the first look, the best one's settled."""
    expected, found = search.expected, []
    for pair in screen_pairs(start, with_flicker(search, start, screened), PAIRS):
        search.on_stage(f"fitting {' and '.join(pair.starts)}", 0.0)
        found.append(judged(expected, refit_from(expected, start, pair.starts)))
    found = best_first(found)
    if found and found[0].left > RESOLVED:
        found[0] = judged(expected, settled(expected, found[0].refit))
    return found


def several(
    search: Search, baseline: Candidate, best: Candidate, pairs: Sequence[Candidate] = ()
) -> Candidate | None:
    """Return effects that explain the gap together, None if none do: forward steps, then backward.

    The first step is to the best effect and another one, or to one of some `pairs`.
    """
    chosen = best
    while chosen is best or (len(chosen.ids) < MOST_EFFECTS and left_over(chosen, baseline) > EXPLAINED):
        search.on_stage("looking for further effects", 0.0)
        screened = looked(search, chosen.refit)
        if not screened:
            return None
        further = candidates(search, chosen.refit, screened, chosen.left)
        left = further[0].left
        if left > CLEARLY_LEFT or (left > RESOLVED and left_over(further[0], baseline) > EXPLAINED):
            further = with_dear(search, chosen.refit, further)
        if chosen is best:
            further = best_first([*further, *pairs])
        if further[0].evidence - chosen.of_bins < NAMED_FROM:
            return None
        if left_over(further[0], baseline) > (1.0 - WORTH) * left_over(chosen, baseline):
            return None
        chosen = further[0]
    if chosen.left > SEVERAL_FORESEE or chosen.is_held_back:
        return None
    if chosen.left > SEVERAL_LEAVE and chosen.refit.mean_square > 1.0:
        chosen = search.asked(chosen)
        if chosen.left_in_pixels > SHOWN_FROM:
            return None
    for name in chosen.ids[:-1]:
        fewer = _fewer(search.expected, chosen, name)
        if chosen.evidence - fewer.evidence < NAMED_FROM:
            chosen = fewer
    return chosen


def _added(of: Candidate) -> dict[str, dict[str, float]]:
    """Return the effect that was added last."""
    name = of.ids[-1]
    return {name: of.refit.effects[name]}


def _fewer(expected: Expected, of: Candidate, name: str) -> Candidate:
    """Return a candidate fitted again without one of its effects."""
    effects = {other: values for other, values in of.refit.effects.items() if other != name}
    return judged(expected, refit_from(expected, of.refit, effects))


def with_shares(
    expected: Expected, baseline: Candidate, chosen: Candidate
) -> tuple[Candidate, dict[str, float]]:
    """Return what is chosen without effects of a small share and little evidence, and the share of each left.

    What is large by itself hides behind what is larger still.
    """
    share = shares(expected, baseline, chosen)

    def is_worth(name: str) -> bool:
        if share[name] >= LEAST_SHARE:
            return True
        return chosen.evidence - _fewer(expected, chosen, name).evidence >= BESIDE_NATS

    worth = {name: of for name, of in chosen.refit.effects.items() if is_worth(name)}
    if not worth or len(worth) == len(chosen.ids):
        return chosen, share
    rest = judged(expected, refit_from(expected, chosen.refit, worth))
    return rest, shares(expected, baseline, rest)


def shares(expected: Expected, baseline: Candidate, chosen: Candidate) -> dict[str, float]:
    """Return each effect's share of the gap that all close together: Shapley's value (1953)."""
    names = chosen.ids
    if len(names) < 2:
        return dict.fromkeys(names, 1.0)
    left: dict[frozenset[str], float] = {frozenset(): baseline.left, frozenset(names): chosen.left}
    for number in range(1, len(names)):
        for some in itertools.combinations(names, number):
            effects = {name: chosen.refit.effects[name] for name in some}
            of_some = judged(expected, refit_from(expected, chosen.refit, effects)).left
            # One that does harm without the others would be left neutral.
            left[frozenset(some)] = min(of_some, *(of for fewer, of in left.items() if fewer < set(some)))
    # Below the model's floor all that there is is closed by what leaves least.
    floor = 1.0 if baseline.left > 1.0 else min(left.values())
    closed = {of: math.sqrt(max(value - floor, 0.0)) for of, value in left.items()}
    total = closed[frozenset()] - closed[frozenset(names)]
    if total <= 0.0:
        return dict.fromkeys(names, 1.0 / len(names))
    value = dict.fromkeys(names, 0.0)
    for order in itertools.permutations(names):
        for n, name in enumerate(order):
            value[name] += closed[frozenset(order[:n])] - closed[frozenset(order[: n + 1])]
    n_orders = math.factorial(len(names))
    return {name: float(np.clip(of / n_orders / total, 0.0, 1.0)) for name, of in value.items()}
