"""Which effects explain a gap: candidates refitted, judged by frames that were held out, added and dropped.

A candidate's score is the mean square R of the residuals in frames that its fit did not see. As if
N_EFFECTIVE residuals were independent and of unknown scale, their likelihood is R^(-N_EFFECTIVE / 2), and
a parameter costs what it costs in Schwarz's criterion (1978, Ann. Statist. 6, 461): neighbouring bins share
the model's error, so the number of bins says nothing about how sure one may be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from noise_model.effects import REGISTRY, Values
from noise_model.frames import Float64
from sim_to_real.expected import RENDERING, Effects, Expected
from sim_to_real.nuisances import SEAM_FROM
from sim_to_real.quadratic import N_EFFECTIVE, Quadratic
from sim_to_real.refit import (
    FLICKER,
    NAMED_FROM,
    Refit,
    huber_weights,
    own_levels,
    refit,
    refit_from,
    settled,
)
from sim_to_real.screen import DEAR, FAMILIES, Screened, along, screen, screen_changes
from sim_to_real.split import folds

JUDGED_WITHIN = 10.0
"""Residuals beyond so many sigmas count as if they were that large: a streak is no more than a streak."""

HELD_DAMPING = 0.03
"""Fits to some of the frames are damped: where hardly anything is seen they would leave what is linear."""

FORM_REL = 0.1
"""An effect's form is known to this share of what it changes: catalogues simplify."""

FOLDS = 5
"""So many times some of the frames are held out."""

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

LEAST_LEFT = 0.6
"""What leaves less leaves nothing. A model without a gap leaves 0.6 to 0.9: its floor is a generous one."""

MOST_CHANGING = 3
"""So many effects, or drivers of one, are fitted with a size that changes from frame to frame."""

ON_BOUND = 1e-3
"""So near a bound, as a share of how far the bounds are apart, a parameter lies on it."""

ALIKE_NATS, MOST_ALIKE = 5.0, 3
"""Candidates whose evidence in bins differs by less, so many at most, are compared in pixels.

If none explains the bins, the first ones are, however they differ.
"""


@dataclass(frozen=True, eq=False)
class Candidate:
    """Effects fitted together: `costs` (n_frames,) are the sums of squares of frames held out of the fit.

    `left_in_pixels` is the mean square that they leave there if it was asked for, NaN if not, and `against`
    what it says against them, nats: it sets apart those whose bins are alike.
    """

    refit: Refit
    costs: Float64
    left_in_pixels: float = math.nan
    against: float = 0.0

    @property
    def ids(self) -> tuple[str, ...]:
        """The effects."""
        return self.refit.ids

    @property
    def left(self) -> float:
        """The mean square of the residuals in frames held out."""
        return float(self.costs.sum() / self.refit.quadratic.counts.sum())

    @property
    def of_bins(self) -> float:
        """The logarithm of the candidate's likelihood in bins, less what its parameters cost.

        It compares what pixels were asked of with what they were not.
        """
        return likelihood_nats(self.left) - cost_nats(self.refit.n_parameters)

    @property
    def evidence(self) -> float:
        """The same less what pixels say against the candidate."""
        return self.of_bins - self.against

    @property
    def held_back(self) -> float:
        """What the fit would gain beyond the bounds that its effects' parameters lie on, nats.

        An effect that would go on is another one's mimic. Where the bound is neutral it is just not there.
        """
        quadratic, x = self.refit.quadratic, self.refit.x
        start, lower, upper = np.array([(p.start, p.lower, p.upper) for p in quadratic.parameters]).T
        reach = upper - lower
        near = np.where(np.isfinite(reach), ON_BOUND * reach, 0.0)
        on_bound = np.zeros(len(x), dtype=np.bool_)
        for bound in (lower, upper):
            on_bound |= (np.abs(x - bound) <= near) & (np.abs(start - bound) > near)
        on_bound[: self.refit.n_nuisances] = False
        if not on_bound.any():
            return 0.0
        freed = quadratic.without_bounds(on_bound)
        left = float(freed.costs(freed.solve()).sum() / quadratic.counts.sum())
        return likelihood_nats(left) - likelihood_nats(self.refit.mean_square)

    @cached_property
    def is_held_back(self) -> bool:
        """Whether its bounds hold it back from what would be preferred."""
        return self.held_back >= NAMED_FROM


def beyond_form(expected: Expected, candidate: Candidate) -> float:
    """Return what a candidate leaves if what its effects change may be off by `FORM_REL` of it."""
    fitted = candidate.refit
    without = expected.residuals(expected.passed(fitted.nuisance, {}))
    r = np.clip(fitted.residuals, -JUDGED_WITHIN, JUDGED_WITHIN)
    off = FORM_REL * (without - fitted.residuals)
    return candidate.left * float(np.sum(r**2 / (1.0 + off**2)) / np.sum(r**2))


def likelihood_nats(left: float) -> float:
    """Return the logarithm of the likelihood of residuals' mean square: `LEAST_LEFT` is as good as can be."""
    return -0.5 * N_EFFECTIVE * math.log(max(left, LEAST_LEFT))


def cost_nats(n_parameters: int) -> float:
    """Return what parameters cost of the evidence."""
    return 0.5 * n_parameters * math.log(N_EFFECTIVE)


def judged(expected: Expected, fitted: Refit) -> Candidate:
    """Return a fit with the costs of its frames, each as the other folds' fit predicts it.

    But for the seam, which stays where all frames have it: others do not foresee where a frame's own runs.
    """
    # All candidates are judged by one loss: each was fitted with a bound of its own.
    plain = Quadratic.of(
        fitted.quadratic.parameters,
        fitted.x,
        fitted.residuals,
        fitted.jacobian,
        huber_weights(fitted.residuals, JUDGED_WITHIN) ** 2,
        fitted.quadratic.counts,
    )
    if FLICKER in fitted.ids:
        # A level of its own needs the frame itself; thousands of bins share that one number.
        return Candidate(fitted, plain.chi2)
    fold, of_seam = folds(expected.observed, FOLDS), slice(SEAM_FROM, fitted.n_nuisances)
    costs = np.zeros(len(fold))
    for k in range(FOLDS):
        held = fold == k
        if held.any():
            # A single frame can only be judged by the fit that saw it.
            x = fitted.x if held.all() else fitted.quadratic.solve(~held, HELD_DAMPING, of_seam)
            costs[held] = plain.costs(x)[held]
    return Candidate(fitted, costs)


def looked(expected: Expected, baseline: Refit, without: Sequence[str]) -> list[Screened]:
    """Look at every effect that might be added to a baseline; those that leave least first."""
    ids = [name for name in FAMILIES if name not in without and name not in baseline.ids]
    if set(DEAR) & set(baseline.ids):
        # Bounced light stays as it was computed: it would not go with what changes what is rendered.
        ids = [name for name in ids if name not in RENDERING]
    return screen(expected, baseline, ids)


def candidates(
    expected: Expected,
    baseline: Refit,
    screened: Sequence[Screened],
    left: float,
    without: Sequence[str],
    on_stage: Callable[[str, float], None],
) -> list[Candidate]:
    """Return the best candidates to add one effect to a baseline, likeliest first.

    `left` is the mean square without any: a baseline may stand where nuisances have not been fitted.
    """
    left = min(left, baseline.mean_square)
    gap = left - LEAST_LEFT
    # What no effect at all leaves at the first look, where nuisances were not fitted yet.
    unaided = baseline.quadratic.costs(baseline.quadratic.solve())
    gap_at_look = max(float(unaided.sum() / baseline.quadratic.counts.sum()) - LEAST_LEFT, gap)
    found: list[Candidate] = []
    if FLICKER not in without and FLICKER not in baseline.ids and _shows_arc(expected):
        effects: dict[str, Values] = {**baseline.effects, FLICKER: REGISTRY[FLICKER].neutral}
        found.append(judged(expected, refit_from(expected, baseline, effects)))
    most = REFITTED_BESIDE if baseline.ids else REFITTED
    for n, one in enumerate(screened[:most]):
        of_gap = HOPELESS if _is_resolved(found, left) and _is_worse(one, found, baseline) else HARDLY_CLOSES
        if n and one.left * baseline.mean_square - LEAST_LEFT > of_gap * gap_at_look:
            continue
        on_stage(f"fitting {one.id}", 0.2 + 0.6 * n / most)
        # What must be rendered for each step is dear: that is started once.
        is_rendered = bool(RENDERING & {one.id, *baseline.ids})
        starts = one.starts[:1] if is_rendered else one.starts
        fits = [refit_from(expected, baseline, {**baseline.effects, one.id: start}) for start in starts]
        found.append(judged(expected, min(fits, key=lambda fit: fit.mean_square)))
    found = _best_first(found)
    if not _is_resolved(found, left):
        # The best come nearer where light is rendered anew: which of them is best shows only then.
        for n, near in enumerate(found[:SETTLED]):
            reach = min(gap, IN_REACH * (min(one.left for one in found) - LEAST_LEFT))
            if near.left - LEAST_LEFT > reach:
                continue
            on_stage(f"fitting {near.ids[-1]} again", 0.8 + 0.05 * n)
            found[n] = judged(expected, settled(expected, near.refit))
    return _best_first(found)


def with_dear(
    expected: Expected,
    baseline: Refit,
    found: Sequence[Candidate],
    without: Sequence[str],
    on_stage: Callable[[str, float], None],
) -> list[Candidate]:
    """Return candidates, likeliest first, with those that take longer than all others together."""
    every = list(found)
    if expected.observed.setup.joint.type == "flat":
        return every
    expected.take_tangents(baseline.nuisance, baseline.effects, baseline.change)
    for name, start in DEAR.items():
        on_stage(f"looking at {name}", 0.95)
        effects = {**baseline.effects, name: start}
        if name in without or name in baseline.ids or not _worth_it(expected, baseline, effects):
            continue
        every.append(judged(expected, settled(expected, refit_from(expected, baseline, effects))))
    return _best_first(every)


def with_changes(
    expected: Expected,
    baseline: Refit,
    screened: Sequence[Screened],
    found: Sequence[Candidate],
    on_stage: Callable[[str, float], None],
) -> list[Candidate]:
    """Return single effects, likeliest first, of which some may change from frame to frame.

    They were looked at from a baseline: one that closes nothing as long as it stays is among them, too. What
    pixels said against an effect that stays they have not said against its change.
    """
    single = {one.ids[0]: one for one in found}
    for look in screen_changes(expected, baseline, screened)[:MOST_CHANGING]:
        name, driver = look.change.effect, look.change.driver
        on_stage(f"fitting {name} that changes with {driver.value}", 0.97)
        if name not in single:
            start = next(one.start for one in screened if one.id == name)
            single[name] = judged(expected, refit_from(expected, baseline, {name: start}))
        fitted = refit(expected, {name: look.start}, baseline.nuisance, change=look.change)
        changed = judged(expected, settled(expected, fitted))
        stays = single[name]
        worth = 0.0 if stays.refit.change else NAMED_FROM
        if changed.of_bins - stays.of_bins > worth:
            single[name] = changed
    return _best_first(list(single.values()))


def told_apart(
    found: Sequence[Candidate], baseline: Candidate, in_pixels: Callable[[Sequence[Refit]], Float64]
) -> tuple[list[Candidate], Candidate]:
    """Return candidates, likeliest first, those that bins find alike weighed by the pixels; and the baseline.

    Nothing is asked if the baseline is likelier than all.
    A bin sees no blur: what widens a stripe and what dims it are much the same to it. `in_pixels` gives the
    mean squares (n,) that fits leave in pixels.
    """
    best, alike = found[0].evidence, list(found[:MOST_ALIKE])
    if best <= baseline.evidence:
        return list(found), baseline
    if _is_resolved(found, baseline.left):
        alike = [one for one in alike if best - one.evidence < ALIKE_NATS]
        if len(alike) < 2:
            return list(found), baseline
    of_baseline, *left = in_pixels([one.refit for one in (baseline, *alike)]).tolist()
    # In pixels 1 is the model's floor, and what lies below is chance.
    nats = [likelihood_nats(max(of, 1.0)) for of in left]
    weighed = [
        replace(one, left_in_pixels=of, against=max(nats) - of_one)
        for one, of, of_one in zip(alike, left, nats, strict=True)
    ]
    every = _best_first([*weighed, *found[len(alike) :]])
    return every, replace(baseline, left_in_pixels=of_baseline)


def _worth_it(expected: Expected, baseline: Refit, effects: Effects) -> bool:
    """Say whether effects close a good part of the gap in a few of the frames that the arc lights."""
    lit = np.flatnonzero(expected.observed.lit)
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
    return gained - cost_nats(len(REGISTRY[one.id].parameters))


def flicker_at_look(expected: Expected, baseline: Refit) -> float:
    """Return how much evidence arc_flicker seems to gain beside a baseline's, nats."""
    if FLICKER in baseline.ids or not _shows_arc(expected):
        return -math.inf
    columns = own_levels(expected, baseline.jacobian[:, 0])
    left, _ = along(baseline, baseline.residuals, columns, [(-1.0, 1.0)] * columns.shape[1])
    gained = likelihood_nats(left * baseline.mean_square) - likelihood_nats(baseline.mean_square)
    return gained - cost_nats(int(expected.observed.lit.sum()) - 1)


def _is_worse(one: Screened, found: Sequence[Candidate], baseline: Refit) -> bool:
    """Say whether an effect has far less evidence at the first look than another that was fitted."""
    evidence = likelihood_nats(baseline.mean_square) + nats_at_look(one, baseline)
    return evidence < max(candidate.evidence for candidate in found) - HOPELESS_NATS


def _best_first(found: Sequence[Candidate]) -> list[Candidate]:
    return sorted(found, key=lambda candidate: -candidate.evidence)


def _shows_arc(expected: Expected) -> bool:
    return bool(expected.observed.lit.sum() > 2)


def confidences(of: Sequence[Candidate], baseline: Candidate) -> Float64:
    """Return how probable each candidate (n,) is, if one of them is right or the baseline.

    What its bounds hold back is another one's mimic: it takes nothing from a first one that is free.
    """
    evidence = np.array([*(candidate.evidence for candidate in of), baseline.evidence])
    mimics = [one.is_held_back and not of[0].is_held_back for one in of]
    evidence[:-1][mimics] = -math.inf
    weight = np.exp(evidence - evidence.max())
    return np.asarray(weight / weight.sum())[:-1]
