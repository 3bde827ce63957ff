"""Gap that known effects close in frames that no fit of them has seen."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from threadpoolctl import threadpool_limits

from noise_model.effects import Effects
from noise_model.setup import Setup
from sim_to_real.baseline import Baseline, OnStage, fit_baseline, silent
from sim_to_real.data.binned import PoseAt
from sim_to_real.decision.holdout_gap import combined_predictions, measure_gap, predict_holdout
from sim_to_real.decision.seam_error import SeamErrors, seam_errors_mm
from sim_to_real.diagnosis import Gap, HeldOutPrediction, excluded_effects
from sim_to_real.fit.gauss_newton import FLICKER, Refit, refit
from sim_to_real.search.score_test import FAMILIES
from tracker.state import Frame


@dataclass(frozen=True, eq=False)
class AddedEffects:
    """The gap of held-out frames before and after effects were added, and their predictions.

    `n_fitted` frames gave the nuisances, in either case anew.
    """

    gap: Gap
    predicted: HeldOutPrediction
    n_fitted: int


def predict_with_added(
    setup: Setup,
    frames: Sequence[Frame],
    pose_at: PoseAt,
    effects: Effects,
    on_stage: OnStage,
    threads: int = 1,
) -> AddedEffects:
    """Predict frames with a setup as it is and with effects added to it, as they are.

    Nuisances alone are fitted, within their tolerances, to three quarters of the frames; the gap is that of
    the others. An arc that flickers has a level in each frame, which no setup states: these are fitted, too.

    Raises ValueError as `diagnose` does.
    """
    with threadpool_limits(1, user_api="blas"):
        added = replace(setup, effects={**setup.effects, **effects})
        none = excluded_effects(setup, ())
        on_stage("fitting nuisances as the setup is", 0.0)
        before = fit_baseline(setup, frames, pose_at, threads, none, silent)
        on_stage("fitting nuisances with the effects", 0.35)
        after = fit_baseline(added, frames, pose_at, threads, none, silent)
        levels = {name: values for name, values in effects.items() if name == FLICKER}
        fitted = refit(after.model, levels, after.fitted.nuisance) if levels else after.fitted
        on_stage("predicting the frames held out", 0.7)
        predicted = combined_predictions(
            _predicted(before, before.fitted), _predicted(after, fitted), set(effects) <= set(FAMILIES)
        )
        # Both trackers are held against the same seam, that of the better fit.
        stated, known = (
            seam_errors_mm(assumed, frames, pose_at, after.model, after.fitted) for assumed in (setup, added)
        )
        seam = SeamErrors(
            (stated.lateral_mm[0], known.lateral_mm[0]), (stated.vertical_mm[0], known.vertical_mm[0])
        )
        gap = measure_gap(predicted, added, seam)
        on_stage("done", 1.0)
    return AddedEffects(gap, predicted, len(after.model.observed.frames))


def _predicted(baseline: Baseline, fitted: Refit) -> HeldOutPrediction:
    return predict_holdout(baseline.held_out, baseline.model, (fitted, {}), (fitted, {}), lambda done: None)
