"""Which effects explain a gap: looked at, the best of them fitted, compared in bins and in pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.arrays import Float64
from noise_model.effects import REGISTRY, Values
from sim_to_real.fit.gauss_newton import FLICKER, NAMED_FROM, Refit, refit, refit_from, settled
from sim_to_real.fit.linearized_model import RENDERING, Effects, Expected
from sim_to_real.search.hypothesis import (
    LEAST_LEFT,
    Candidate,
    best_first,
    cost_nats,
    judged,
    likelihood_nats,
)
from sim_to_real.search.probe_points import DEAR, FAMILIES
from sim_to_real.search.score_test import Screened, screen, screen_changes, screen_flicker

SETTLED = 3
"""So many of the best are fitted again where they came to."""

IN_REACH = 4.0
"""But not if they leave so many times what the best one leaves of a gap."""

DEAR_FRAMES, DEAR_CLOSES = 4, 0.3
"""What is dear is fitted to all frames if in so many of them it closes this share of the gap."""

RESOLVED = 1.1
"""What leaves a mean square below this, and closes a good part of the gap, explains all that there is."""

REFITTED, REFITTED_BESIDE = 8, 4
"""How many candidates are refitted after the first look, alone and beside effects that were chosen."""

HOPELESS, HOPELESS_NATS = 0.3, 20.0
"""What leaves this share of the gap at the first look is not refitted once another explains all of it.

Unless it is so much cheaper that its evidence there is no more than so many nats less.
"""

HALF = 0.5
"""A good part of the gap."""

HARDLY_CLOSES = 0.9
"""But for the first one, what leaves more of the gap at the first look is not refitted."""

MOST_CHANGING = 3
"""So many effects, or drivers of one, are fitted with a size that changes from frame to frame."""

ALIKE_NATS, MOST_ALIKE = 5.0, 3
"""Candidates whose evidence in bins differs by less, so many at most, are compared in pixels.

If none explains the bins, the first ones are, however they differ.
"""


@dataclass(frozen=True, eq=False)
class Search:
    """What effects are sought in: frames as expected, with a catalogue.

    `without` are effects left out of it. `in_pixels` gives the mean squares (n,) that fits leave in pixels of
    frames left aside; `on_stage` hears what is being done and how much of all is done.
    """

    expected: Expected
    without: Sequence[str]
    in_pixels: Callable[[Sequence[Refit]], Float64]
    on_stage: Callable[[str, float], None]

    def has(self, name: str, beside: Refit) -> bool:
        """Say whether an effect may be added to those of a fit."""
        return name not in self.without and name not in beside.ids

    def asked(self, of: Candidate) -> Candidate:
        """Return a candidate of which it is known what it leaves in pixels."""
        if not math.isnan(of.left_in_pixels):
            return of
        return replace(of, left_in_pixels=float(self.in_pixels([of.refit])[0]))


def looked(search: Search, baseline: Refit) -> list[Screened]:
    """Look at every effect that might be added to a baseline; those that leave least first."""
    ids = [name for name in FAMILIES if search.has(name, baseline)]
    if set(DEAR) & set(baseline.ids):
        # Bounced light stays as it was computed: it would not go with what changes what is rendered.
        ids = [name for name in ids if name not in RENDERING]
    return screen(search.expected, baseline, ids)


def with_flicker(search: Search, baseline: Refit, screened: Sequence[Screened]) -> list[Screened]:
    """Return looks at effects that may be added to a baseline, with that at arc_flicker."""
    if not search.has(FLICKER, baseline) or not _shows_arc(search.expected):
        return list(screened)
    return [*screened, screen_flicker(search.expected, baseline)]


def candidates(search: Search, baseline: Refit, screened: Sequence[Screened], left: float) -> list[Candidate]:
    """Return the best candidates to add one effect to a baseline, likeliest first.

    `left` is the mean square without any: a baseline may stand where nuisances have not been fitted.
    """
    expected, left = search.expected, min(left, baseline.mean_square)
    gap = left - LEAST_LEFT
    # What no effect at all leaves at the first look, where nuisances were not fitted yet.
    unaided = baseline.quadratic.mean_square(baseline.quadratic.solve())
    gap_at_look = max(unaided - LEAST_LEFT, gap)
    found: list[Candidate] = []
    if search.has(FLICKER, baseline) and _shows_arc(expected):
        effects: dict[str, Values] = {**baseline.effects, FLICKER: REGISTRY[FLICKER].neutral}
        found.append(judged(expected, refit_from(expected, baseline, effects)))
    most = REFITTED_BESIDE if baseline.ids else REFITTED
    for n, one in enumerate(screened[:most]):
        of_gap = HOPELESS if _is_resolved(found, left) and _is_worse(one, found, baseline) else HARDLY_CLOSES
        if n and one.left * baseline.mean_square - LEAST_LEFT > of_gap * gap_at_look:
            continue
        search.on_stage(f"fitting {one.id}", 0.2 + 0.6 * n / most)
        # What must be rendered for each step is dear: that is started once.
        is_rendered = bool(RENDERING & {one.id, *baseline.ids})
        starts = one.starts[:1] if is_rendered else one.starts
        fits = [refit_from(expected, baseline, {**baseline.effects, one.id: start}) for start in starts]
        found.append(judged(expected, min(fits, key=lambda fit: fit.mean_square)))
    found = best_first(found)
    if not _is_resolved(found, left):
        # The best come nearer where light is rendered anew: which of them is best shows only then.
        for n, near in enumerate(found[:SETTLED]):
            reach = min(gap, IN_REACH * (min(one.left for one in found) - LEAST_LEFT))
            if near.left - LEAST_LEFT > reach:
                continue
            search.on_stage(f"fitting {near.ids[-1]} again", 0.8 + 0.05 * n)
            found[n] = judged(expected, settled(expected, near.refit))
    return best_first(found)


def with_dear(search: Search, baseline: Refit, found: Sequence[Candidate]) -> list[Candidate]:
    """Return candidates, likeliest first, with those that take longer than all others together."""
    expected, every = search.expected, list(found)
    if expected.observed.setup.joint.type == "flat":
        return every
    expected.take_tangents(baseline.nuisance, baseline.effects, baseline.change)
    for name, start in DEAR.items():
        search.on_stage(f"looking at {name}", 0.95)
        effects = {**baseline.effects, name: start}
        if not search.has(name, baseline) or not _worth_it(expected, baseline, effects):
            continue
        every.append(judged(expected, settled(expected, refit_from(expected, baseline, effects))))
    return best_first(every)


def with_changes(
    search: Search, baseline: Refit, screened: Sequence[Screened], found: Sequence[Candidate]
) -> list[Candidate]:
    """Return single effects, likeliest first, of which some may change from frame to frame.

    They were looked at from a baseline: one that closes nothing as long as it stays is among them, too. What
    pixels said against an effect that stays they have not said against its change.
    """
    expected, single = search.expected, {one.ids[0]: one for one in found}
    for look in screen_changes(expected, baseline, screened)[:MOST_CHANGING]:
        name, driver = look.change.effect, look.change.driver
        search.on_stage(f"fitting {name} that changes with {driver.value}", 0.97)
        if name not in single:
            start = next(one.start for one in screened if one.id == name)
            single[name] = judged(expected, refit_from(expected, baseline, {name: start}))
        fitted = refit(expected, {name: look.start}, baseline.nuisance, change=look.change)
        changed = judged(expected, settled(expected, fitted))
        stays = single[name]
        worth = 0.0 if stays.refit.change else NAMED_FROM
        if changed.of_bins - stays.of_bins > worth:
            single[name] = changed
    return best_first(single.values())


def told_apart(
    search: Search, found: Sequence[Candidate], baseline: Candidate
) -> tuple[list[Candidate], Candidate]:
    """Return candidates, likeliest first, those that bins find alike weighed by the pixels; and the baseline.

    Nothing is asked if the baseline is likelier than all.
    A bin sees no blur: what widens a stripe and what dims it are much the same to it.
    """
    best, alike = found[0].evidence, list(found[:MOST_ALIKE])
    if best <= baseline.evidence:
        return list(found), baseline
    if _is_resolved(found, baseline.left):
        alike = [one for one in alike if best - one.evidence < ALIKE_NATS]
        if len(alike) < 2:
            return list(found), baseline
    of_baseline, *left = search.in_pixels([one.refit for one in (baseline, *alike)]).tolist()
    # In pixels 1 is the model's floor, and what lies below is chance.
    nats = [likelihood_nats(max(of, 1.0)) for of in left]
    weighed = [
        replace(one, left_in_pixels=of, against=max(nats) - of_one)
        for one, of, of_one in zip(alike, left, nats, strict=True)
    ]
    every = best_first([*weighed, *found[len(alike) :]])
    return every, replace(baseline, left_in_pixels=of_baseline)


def _worth_it(expected: Expected, baseline: Refit, effects: Effects) -> bool:
    """Say whether effects close a good part of the gap in a few of the frames that the arc lights."""
    lit = np.flatnonzero(expected.observed.shows_arc)
    if not len(lit):
        return False
    few = expected.some(
        np.isin(np.arange(len(expected.observed.frames)), lit[:: -(-len(lit) // DEAR_FRAMES)])
    )
    before = refit_from(few, baseline, baseline.effects).mean_square
    after = refit_from(few, baseline, effects).mean_square
    # To a few frames alone nuisances may be bent until they leave less than the model's floor.
    least = 1.0 if before > 1.0 else LEAST_LEFT
    return before - max(after, least) > DEAR_CLOSES * (before - least)


def _is_resolved(found: Sequence[Candidate], left: float) -> bool:
    """Say whether one of the candidates leaves nothing worth looking for of what is left without it."""
    most = min(RESOLVED, LEAST_LEFT + HALF * (left - LEAST_LEFT))
    return any(candidate.left <= most and not candidate.is_held_back for candidate in found)


def nats_at_look(one: Screened, baseline: Refit) -> float:
    """Return how much evidence an effect seems to gain beside a baseline's at the first look."""
    gained = likelihood_nats(one.left * baseline.mean_square) - likelihood_nats(baseline.mean_square)
    return gained - cost_nats(one.n_parameters)


def _is_worse(one: Screened, found: Sequence[Candidate], baseline: Refit) -> bool:
    """Say whether an effect has far less evidence at the first look than another that was fitted."""
    evidence = likelihood_nats(baseline.mean_square) + nats_at_look(one, baseline)
    return evidence < max(candidate.evidence for candidate in found) - HOPELESS_NATS


def _shows_arc(expected: Expected) -> bool:
    return bool(expected.observed.shows_arc.sum() > 2)
