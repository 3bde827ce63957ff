"""The diagnosis of a recording: is there a gap, which effects cause it, how far it shrinks with them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from threadpoolctl import threadpool_limits

from noise_model.arrays import Float64
from noise_model.effects import REGISTRY
from noise_model.setup import Setup
from sim_to_real.data.binned import PoseAt, observe
from sim_to_real.data.cross_validation import held_out, one_of_each
from sim_to_real.decision.decide import Decision, decide, in_question
from sim_to_real.decision.holdout_checks import (
    closing,
    must_help,
    names_trifle,
    not_held_up,
    random_shares,
    with_random,
    with_withheld,
    without_trifle,
)
from sim_to_real.decision.holdout_gap import excess_map, left_in_pixels, measure, predict_held, smaller
from sim_to_real.decision.optimal_design import best_measurement
from sim_to_real.decision.seam_error import seam_errors_mm
from sim_to_real.diagnosis import (
    Diagnosis,
    Estimate,
    Named,
    Next,
    Predicted,
    Ranked,
    Trend,
    Verdict,
    left_out,
)
from sim_to_real.fit.gauss_newton import Refit, refit, settled
from sim_to_real.fit.linearized_model import Effects, Expected
from sim_to_real.locate.covariates import Covariates, Start, covariates
from sim_to_real.locate.residual_structure import locate
from sim_to_real.locate.spline_term import free_term, gap_size
from sim_to_real.locate.stage import stages
from sim_to_real.search.hypothesis import Candidate, judged
from sim_to_real.search.identifiability import smallest
from sim_to_real.search.single_effects import Search
from sim_to_real.search.stepwise import with_shares
from sim_to_real.variance.random_effects import Scatter, scatter
from tracker.state import Frame

HELD, LEFT_ASIDE = 0.25, 0.34
"""The share of frames held out of everything, and of the others that which is left out while choosing."""

RELIABLE = 0.95
"""Of the effects that were named first and for sure in blind recordings about so many were there.

Another form of an effect, or one outside the catalogue, can be mimicked.
docs/research/blind_check.md has the figures.
"""

OnStage = Callable[[str, float], None]


def diagnose(
    setup: Setup,
    frames: Sequence[Frame],
    pose_at: PoseAt,
    *,
    without: Sequence[str] = (),
    on_stage: OnStage | None = None,
    threads: int = 1,
) -> Diagnosis:
    """Diagnose a recording's frames; `without` takes effects out of the catalogue, see `left_out`.

    `on_stage` hears what is being done and how much of all is done. So many `threads` predict frames at once:
    one is best where other processes are at work.

    Raises ValueError for an unknown effect, if no frame has a pose, if none can be held out and if nothing
    in them can be compared.
    """
    for name in without:
        if name not in REGISTRY:
            raise ValueError(f"{name}: no such effect, there are {', '.join(REGISTRY)}")
    # Its many small matrices are no work for BLAS' threads: waiting for each other costs them more.
    with threadpool_limits(1, user_api="blas"):
        heard = _rising(on_stage or _silent)
        return _diagnosed(setup, frames, pose_at, left_out(setup, without), heard, threads)


def _diagnosed(
    setup: Setup,
    frames: Sequence[Frame],
    pose_at: PoseAt,
    without: Sequence[str],
    heard: OnStage,
    threads: int,
) -> Diagnosis:
    heard("tracking the seam", 0.0)
    observed = observe(setup, frames, pose_at)
    held = held_out(observed, HELD)
    if not held.any():
        raise ValueError(
            "no two frames have light, exposure and current alike, so none can be held out of the fit: "
            "record each kind twice or more"
        )
    train = observed.some(~held)
    if not any(frame.keep.any() for frame in train.frames):
        raise ValueError(
            "nothing can be compared, all that shows of the joint is saturated: shorten the exposure"
        )
    if train.lit.any() and not train.shows_arc.any():
        raise ValueError(
            "nothing that the arc lights can be compared, all of it is saturated: shorten the exposure, "
            "or leave the frames with the arc out"
        )
    heard("fitting what is no gap", 0.05)
    expected = Expected(train, threads)
    before, scattered = _baseline(expected, without)
    # In pixels the read noise shows; that of bins is what they show anyway.
    seen = observed.with_read_noise(scattered.read_ratio)
    aside = held_out(train, LEFT_ASIDE)
    choosing = expected.some(~aside)
    baseline = judged(choosing, refit(choosing, {}, before.nuisance))

    # Of so few frames that none can be left aside all are looked at.
    looked_at = one_of_each(seen.some(~held).some(aside if aside.any() else ~aside))

    def in_pixels(fits: Sequence[Refit]) -> Float64:
        return left_in_pixels(looked_at, choosing, fits, scattered.effects)

    search = Search(choosing, without, in_pixels, lambda text, share: heard(text, 0.1 + 0.5 * share))
    decision = with_random(decide(search, baseline), baseline, scattered)
    chosen, share = with_shares(choosing, baseline, decision.chosen)
    decision = replace(decision, chosen=chosen)

    heard("fitting all frames", 0.65)
    named = decision.chosen.refit.effects
    after = before
    if named:
        fitted = decision.chosen.refit
        after = settled(expected, refit(expected, named, fitted.nuisance, steps=0, change=fitted.change))
    heard("predicting the frames held out", 0.75)

    def predicted_of(after: Refit, random: Effects) -> Predicted:
        return predict_held(
            seen.some(held),
            expected,
            (before, {}),
            (after, random),
            lambda done: heard("predicting the frames held out", 0.75 + 0.15 * done),
        )

    random = scatter(expected, after, without)
    predicted = predicted_of(after, random.effects)
    gap = measure(predicted, setup, seam_errors_mm(setup, frames, pose_at, expected, after))
    # The mean of what scatters is seldom where it is seen: it has no say in what else helps.
    plain = predicted_of(after, {}) if named and random.effects else predicted
    helps = not named or smaller(plain) >= must_help(decision, baseline)
    if named and (not helps or names_trifle(decision, baseline, gap, expected.stated)):
        without_it = without_trifle if helps else not_held_up
        decision, after, share = without_it(decision, baseline, scattered), before, {}
        random = scatter(expected, after, without)
        predicted = predicted_of(after, random.effects)
        gap = measure(predicted, setup, seam_errors_mm(setup, frames, pose_at, expected, after))
    decision = closing(decision, baseline, gap)
    if without:
        decision = with_withheld(decision, scatter(expected, before, ()), without)
    heard("saying where", 0.9)
    of_bins = covariates(expected, before)
    is_named = decision.verdict in (Verdict.EFFECTS, Verdict.AMBIGUOUS)
    effects = _named(decision, after, random, _with_random(share, scattered, random)) if is_named else ()
    if effects:
        stage = effects[0].stage
    elif decision.verdict is Verdict.NO_GAP:
        stage = stages(expected, [(before, of_bins)])[0].stage
    else:
        stage = _simplest_stage(expected, before, of_bins)
    where = locate(of_bins, before.residuals, stage, excess_map(predicted))
    of_after = of_bins if after is before else covariates(expected, after)
    size = gap_size(of_bins, before.residuals, ~aside)
    free = free_term(of_after, after.residuals, ~aside, size)[:1]
    heard("done", 1.0)
    return Diagnosis(
        decision.verdict,
        effects,
        ranking(decision, baseline, random),
        decision.ambiguous,
        gap,
        where,
        _next(choosing, decision),
        decision.alike,
        smallest(decision.signatures, decision.screened),
        next(((of.name, of.closed) for of in free), None),
        (*after.ids, *random.effects),
        predicted,
    )


def _silent(text: str, share: float) -> None:
    pass


def _rising(on_stage: OnStage) -> OnStage:
    """Return a listener that never hears of less than before: a search may go round once more."""
    most = 0.0

    def heard(text: str, share: float) -> None:
        nonlocal most
        most = max(most, share)
        on_stage(text, most)

    return heard


def _baseline(expected: Expected, without: Sequence[str]) -> tuple[Refit, Scatter]:
    """Fit what is off within its tolerance, and nothing else; what scatters is taken for noise."""
    expected.take_tangents(expected.neutral, {})
    fitted = refit(expected, {}, expected.neutral)
    expected.leave_out_edges(fitted.nuisance, {})
    expected.allow_for_bends(fitted.nuisance, {})
    fitted = settled(expected, fitted)
    random = scatter(expected, fitted, without)
    if random.effects:
        expected.take_noise(random.sigmas_dn)
        fitted = refit(expected, {}, fitted.nuisance)
    return fitted, random


def _simplest_stage(expected: Expected, before: Refit, of_bins: Covariates) -> str:
    """Return the stage at which the residual is simplest, of the fit or of the stated values."""
    expected.take_tangents(expected.neutral, {})
    start = Start.of(expected)
    return stages(expected, [(before, of_bins), (start, covariates(expected, start))])[0].stage


def _next(expected: Expected, decision: Decision) -> Next | None:
    """Return the measurement that would settle what is open; None if nothing is."""
    pair = in_question(decision)
    return None if pair is None else best_measurement(expected, *(one.refit for one in pair))


def _named(
    decision: Decision, after: Refit, random: Scatter, share: Mapping[str, float]
) -> tuple[Named, ...]:
    """Return the effects of the best fit, and those that scatter, the largest share first.

    Nothing is surer than names have turned out to be.
    """
    sigmas = {**after.sigmas, **random.sigmas}
    confidence = {**random.confidence, **dict.fromkeys(after.ids, decision.sure)}
    named = [
        Named(
            name,
            REGISTRY[name].stage.value,
            RELIABLE * confidence[name],
            share[name],
            {
                parameter.name: Estimate(values[parameter.name], sigmas[name][parameter.name], parameter.unit)
                for parameter in REGISTRY[name].parameters
                if parameter.name in values
            },
            _trend(after, name),
        )
        for name, values in {**after.effects, **random.effects}.items()
    ]
    return tuple(sorted(named, key=lambda of: -of.share))


def _trend(after: Refit, name: str) -> Trend | None:
    """Return how an effect changes, None if it does not."""
    change = after.change
    if change is None or change.effect != name:
        return None
    least, most = change.ends(after.effects[name])
    return Trend(
        change.driver.value,
        change.driver.unit,
        change.middle - change.half,
        change.middle + change.half,
        {name: (least[name], most[name]) for name in least},
    )


def _with_random(share: Mapping[str, float], before: Scatter, random: Scatter) -> dict[str, float]:
    """Return the shares of all that is named: what scatters has its share of the gap before any fit."""
    of_random = random_shares(before)
    scatters = {name: of_random.get(name, 0.0) for name in random.effects}
    rest = max(1.0 - sum(scatters.values()), 0.0) if share else 0.0
    total = rest + sum(scatters.values())
    of_all = {**{name: rest * of for name, of in share.items()}, **scatters}
    return {name: of / total if total > 0.0 else math.nan for name, of in of_all.items()}


def ranking(decision: Decision, baseline: Candidate, random: Scatter) -> tuple[Ranked, ...]:
    """Return all single effects, best first, with the share of the gap's size that each closes.

    How sure each is goes with `_named`.
    """
    # Below the model's floor the best closes all that there is.
    floor = min([1.0, *(single.left for single in decision.singles)])
    size = math.sqrt(max(baseline.left - floor, 0.0))
    ranked = []
    # One that its bounds hold back may stand behind a less likely one: they keep their order.
    most = math.inf
    for single, confidence in zip(decision.singles, decision.confidence, strict=True):
        left = math.sqrt(max(single.left - floor, 0.0))
        closed = 1.0 - left / size if size else math.nan
        most = min(most, single.evidence - baseline.evidence)
        one = Ranked(single.ids[-1], RELIABLE * float(confidence), closed, single.is_held_back)
        ranked.append((most, one))
    ranked += [
        (random.evidence[name], Ranked(name, RELIABLE * random.confidence[name], random.closed[name]))
        for name in random.evidence
    ]
    return tuple(one for _, one in sorted(ranked, key=lambda pair: -pair[0]))
