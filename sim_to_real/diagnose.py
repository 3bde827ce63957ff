"""The diagnosis of a recording: is there a gap, which effects cause it, how far it shrinks with them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from threadpoolctl import threadpool_limits

from noise_model.arrays import Bool, Float64
from noise_model.effects import REGISTRY
from noise_model.setup import Setup
from sim_to_real.data.binned import Observed, PoseAt, observe
from sim_to_real.data.cross_validation import held_out, middle_of_each_stratum
from sim_to_real.decision.decide import Decision, decide, open_pair
from sim_to_real.decision.holdout_checks import (
    checked_on_holdout,
    names_negligible,
    random_shares,
    required_probability,
    with_compression,
    with_random_effects,
    with_withheld,
    without_negligible,
    without_unconfirmed,
)
from sim_to_real.decision.holdout_gap import (
    excess_map,
    measure_gap,
    pixel_misfits,
    predict_holdout,
    probability_improved,
)
from sim_to_real.decision.optimal_design import best_measurement
from sim_to_real.decision.seam_error import seam_errors_mm
from sim_to_real.diagnosis import (
    Diagnosis,
    Estimate,
    Named,
    Next,
    Predicted,
    Ranked,
    ReportedTrend,
    Verdict,
    excluded_effects,
)
from sim_to_real.fit.gauss_newton import Refit, converged, refit
from sim_to_real.fit.linearized_model import Effects, LinearizedModel
from sim_to_real.locate.covariates import Covariates, NominalFit, covariates
from sim_to_real.locate.residual_structure import locate
from sim_to_real.locate.spline_term import gap_size, spline_terms
from sim_to_real.locate.stage import stages
from sim_to_real.search.hypothesis import Hypothesis, cross_validated
from sim_to_real.search.identifiability import smallest_detectable
from sim_to_real.search.single_effects import Search
from sim_to_real.search.stepwise import with_shares
from sim_to_real.variance.random_effects import RandomEffects, random_effects
from tracker.state import Frame

HOLDOUT_SHARE, VALIDATION_SHARE = 0.25, 0.34
"""The share of frames held out of every fit, and of the others that held out while effects are chosen."""

NAMING_RELIABILITY = 0.95
"""The share of confidently named effects that were right in blind recordings.

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
    """Diagnose a recording's frames; `without` takes effects out of the catalogue, see `excluded_effects`.

    `on_stage` is told what is being done and the share of all work that is done. Frames are predicted on so
    many `threads`; one is best where other processes are at work.

    Raises ValueError for a setup without arc, filter or metal, for an unknown effect, if no frame has a pose,
    if no frame can be held out of the fit, and if nothing in the frames can be compared.
    """
    setup.require("a diagnosis", "arc", "filter", "material")
    for name in without:
        if name not in REGISTRY:
            raise ValueError(f"{name}: no such effect, there are {', '.join(REGISTRY)}")
    # Many small matrices: the threads of BLAS would wait for each other longer than they compute.
    with threadpool_limits(1, user_api="blas"):
        tell = _never_falling(on_stage or _silent)
        return _diagnosed(setup, frames, pose_at, excluded_effects(setup, without), tell, threads)


def _diagnosed(
    setup: Setup,
    frames: Sequence[Frame],
    pose_at: PoseAt,
    without: Sequence[str],
    tell: OnStage,
    threads: int,
) -> Diagnosis:
    tell("tracking the seam", 0.0)
    observed = observe(setup, frames, pose_at)
    holdout = held_out(observed, HOLDOUT_SHARE)
    train = _comparable(observed, holdout)
    tell("fitting nuisances", 0.05)
    model = LinearizedModel(train, threads)
    before, random_before = baseline_of(model, without)
    # Pixels are weighed with the read noise that is seen; that of bins comes from the bins themselves.
    seen = observed.with_read_noise(random_before.read_ratio)
    validation = held_out(train, VALIDATION_SHARE)
    choosing = model.subset(~validation)
    baseline = cross_validated(choosing, refit(choosing, {}, before.nuisance))

    # If there are too few frames to hold out any, all of them validate.
    validating = validation if validation.any() else ~validation
    validation_frames = middle_of_each_stratum(seen.subset(~holdout).subset(validating))

    def misfits(fits: Sequence[Refit]) -> Float64:
        return pixel_misfits(validation_frames, choosing, fits, random_before.effects)

    search = Search(choosing, without, misfits, lambda text, share: tell(text, 0.1 + 0.5 * share))
    decision = with_random_effects(decide(search, baseline), baseline, random_before)
    chosen, share = with_shares(choosing, baseline, decision.chosen)
    decision = replace(decision, chosen=chosen)

    tell("fitting all frames", 0.65)
    named = decision.chosen.refit.effects
    after = before
    if named:
        fitted = decision.chosen.refit
        after = converged(model, refit(model, named, fitted.nuisance, steps=0, trend=fitted.trend))
    tell("predicting the frames held out", 0.75)

    def predicted_of(after: Refit, random: Effects) -> Predicted:
        return predict_holdout(
            seen.subset(holdout),
            model,
            (before, {}),
            (after, random),
            lambda done: tell("predicting the frames held out", 0.75 + 0.15 * done),
        )

    random = random_effects(model, after, without)
    predicted = predicted_of(after, random.effects)
    gap = measure_gap(predicted, setup, seam_errors_mm(setup, frames, pose_at, model, after))
    # The mean of a random effect is seldom where it is seen: it must not decide whether others help.
    plain = predicted_of(after, {}) if named and random.effects else predicted
    helps = not named or probability_improved(plain) >= required_probability(decision, baseline)
    if named and (not helps or names_negligible(decision, baseline, gap, model.stated_values)):
        without_it = without_negligible if helps else without_unconfirmed
        decision, after, share = without_it(decision, baseline, random_before), before, {}
        random = random_effects(model, after, without)
        predicted = predicted_of(after, random.effects)
        gap = measure_gap(predicted, setup, seam_errors_mm(setup, frames, pose_at, model, after))
    decision = checked_on_holdout(decision, baseline, gap)
    decision = with_compression(decision, baseline, random)
    if without:
        decision = with_withheld(decision, random_effects(model, before, ()), without)
    tell("locating the gap", 0.9)
    of_bins = covariates(model, before)
    effects: tuple[Named, ...] = ()
    if decision.verdict in (Verdict.EFFECTS, Verdict.AMBIGUOUS):
        effects = _named(decision, after, random, _with_random_shares(share, random_before, random))
    stage = effects[0].stage if effects else _simplest_stage(model, before, of_bins, decision.verdict)
    where = locate(of_bins, before.residuals, stage, excess_map(predicted))
    of_after = of_bins if after is before else covariates(model, after)
    size = gap_size(of_bins, before.residuals, ~validation)
    terms = spline_terms(of_after, after.residuals, ~validation, size)
    tell("done", 1.0)
    return Diagnosis(
        decision.verdict,
        effects,
        ranking(decision, baseline, random),
        decision.ambiguous,
        gap,
        where,
        _next_measurement(choosing, decision),
        decision.indistinguishable,
        smallest_detectable(decision.signatures, decision.scores),
        (terms[0].name, terms[0].closed) if terms else None,
        (*after.ids, *random.effects),
        predicted,
    )


def _comparable(observed: Observed, holdout: Bool) -> Observed:
    """Return the frames that are not held out (n_frames,); ValueError if they show nothing to compare."""
    if not holdout.any():
        raise ValueError(
            "no two frames have light, exposure and current alike, so none can be held out of the fit: "
            "record each kind twice or more"
        )
    train = observed.subset(~holdout)
    if not any(frame.keep.any() for frame in train.frames):
        raise ValueError(
            "nothing can be compared, all that shows of the joint is saturated: shorten the exposure"
        )
    if train.lit.any() and not train.shows_arc.any():
        raise ValueError(
            "nothing that the arc lights can be compared, all of it is saturated: shorten the exposure, "
            "or leave the frames with the arc out"
        )
    return train


def _silent(text: str, share: float) -> None:
    pass


def _never_falling(on_stage: OnStage) -> OnStage:
    """Return a listener whose share of work never falls: a search may start a further round."""
    largest = 0.0

    def tell(text: str, share: float) -> None:
        nonlocal largest
        largest = max(largest, share)
        on_stage(text, largest)

    return tell


def baseline_of(model: LinearizedModel, without: Sequence[str]) -> tuple[Refit, RandomEffects]:
    """Fit the nuisances alone; random effects are counted as noise."""
    model.take_tangents(model.neutral, {})
    fitted = refit(model, {}, model.neutral)
    model.mask_edges(fitted.nuisance, {})
    model.widen_noise_for_bends(fitted.nuisance, {})
    fitted = converged(model, fitted)
    random = random_effects(model, fitted, without)
    if random.effects:
        model.take_noise(random.sigmas_dn)
        fitted = refit(model, {}, fitted.nuisance)
    return fitted, random


def _simplest_stage(model: LinearizedModel, before: Refit, of_bins: Covariates, verdict: Verdict) -> str:
    """Return the stage at which the residual is simplest: of the fit or, with a gap, of the stated values."""
    if verdict is Verdict.NO_GAP:
        return stages(model, [(before, of_bins)])[0].stage
    model.take_tangents(model.neutral, {})
    start = NominalFit.of(model)
    return stages(model, [(before, of_bins), (start, covariates(model, start))])[0].stage


def _next_measurement(model: LinearizedModel, decision: Decision) -> Next | None:
    """Return the measurement that would tell apart what is open; None if nothing is."""
    pair = open_pair(decision)
    return None if pair is None else best_measurement(model, *(hypothesis.refit for hypothesis in pair))


def _named(
    decision: Decision, after: Refit, random: RandomEffects, share: Mapping[str, float]
) -> tuple[Named, ...]:
    """Return the effects of the best fit and random effects, the largest share first.

    A confidence is a posterior probability times `NAMING_RELIABILITY`.
    """
    sigmas = {**after.sigmas, **random.sigmas}
    confidence = {**random.confidence, **dict.fromkeys(after.ids, decision.posterior_probability)}
    named = [
        Named(
            name,
            REGISTRY[name].stage.value,
            NAMING_RELIABILITY * confidence[name],
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
    return tuple(sorted(named, key=lambda effect: -effect.share))


def _trend(after: Refit, name: str) -> ReportedTrend | None:
    """Return how an effect changes over the recording, None if it is constant."""
    trend = after.trend
    if trend is None or trend.effect != name:
        return None
    least, most = trend.values_at_ends(after.effects[name])
    return ReportedTrend(
        trend.driver.value,
        trend.driver.unit,
        trend.middle - trend.half_range,
        trend.middle + trend.half_range,
        {name: (least[name], most[name]) for name in least},
    )


def _with_random_shares(
    share: Mapping[str, float], before: RandomEffects, random: RandomEffects
) -> dict[str, float]:
    """Return the shares of all named effects; a random effect has its share of the gap before any fit."""
    of_random = random_shares(before)
    scatters = {name: of_random.get(name, 0.0) for name in random.effects}
    rest = max(1.0 - sum(scatters.values()), 0.0) if share else 0.0
    total = rest + sum(scatters.values())
    of_all = {**{name: rest * part for name, part in share.items()}, **scatters}
    # What has no share of a gap, compression, is all that there is.
    return {name: part / total if total > 0.0 else 1.0 / len(of_all) for name, part in of_all.items()}


def ranking(decision: Decision, baseline: Hypothesis, random: RandomEffects) -> tuple[Ranked, ...]:
    """Return all single effects, best first, with the share of the gap's size that each closes.

    Confidences are as in `_named`.
    """
    # Below the model's floor the best effect counts as closing all.
    floor = min([1.0, *(single.cv_mean_square for single in decision.singles)])
    size = math.sqrt(max(baseline.cv_mean_square - floor, 0.0))
    ranked = []
    # A bound-limited effect may stand behind a less likely one: they keep their order.
    evidence = math.inf
    for single, confidence in zip(decision.singles, decision.posterior_probabilities, strict=True):
        remainder = math.sqrt(max(single.cv_mean_square - floor, 0.0))
        closed = 1.0 - remainder / size if size else math.nan
        evidence = min(evidence, single.evidence - baseline.evidence)
        candidate = Ranked(
            single.ids[-1], NAMING_RELIABILITY * float(confidence), closed, single.is_bound_limited
        )
        ranked.append((evidence, candidate))
    ranked += [
        (
            random.evidence[name],
            Ranked(name, NAMING_RELIABILITY * random.confidence[name], random.closed[name], is_random=True),
        )
        for name in random.evidence
    ]
    return tuple(candidate for _, candidate in sorted(ranked, key=lambda pair: -pair[0]))
