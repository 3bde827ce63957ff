"""Choice of the next experiment: the one with the largest expected certainty of the posterior.

Each probable hypothesis predicts an experiment's frames, with the posterior uncertainty of its parameters.
For linear Gaussian predictions the evidence of one hypothesis against another has a closed form, and with it
the expected posterior (Lindley 1956, Ann. Math. Stat. 27, 986: the expected information of an experiment).
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from noise_model.compiled.arrays import Bool, Float64
from noise_model.condition import Condition
from noise_model.instrument.sensor import saturation_dn
from noise_model.setup import Setup
from noise_model.transforms import moved
from sim_to_real.data.binned import (
    STRIPE_RIM_BINS,
    ObservedFrame,
    ObservedRecording,
    bins_that_count,
    stated_layers,
    variances_dn2,
)
from sim_to_real.data.blocks import dilate
from sim_to_real.decision.experiments import MENU, N_MORE, WITNESS, Experiment
from sim_to_real.diagnosis import Next
from sim_to_real.evidence.error_model import ErrorModel, LinearHypothesis
from sim_to_real.evidence.hypotheses import Hypothesis, Posterior
from sim_to_real.evidence.policy import Policy
from sim_to_real.fit.gauss_newton import FRAME_LEVEL, Refit, refit_at
from sim_to_real.fit.linearized_model import LinearizedModel


def planned_frame(experiment: Experiment, frame: ObservedFrame, setup: Setup) -> ObservedFrame:
    """Return the frame that an experiment would give at the time of an existing one."""
    condition = Condition.of(
        setup,
        laser_on=experiment.laser_on,
        arc_on=experiment.arc_on and setup.arc.shines,
        current_a=experiment.current * setup.arc.current_a,
        exposure_s=experiment.exposure * setup.camera.exposure_s,
        timestamp_s=frame.condition.timestamp_s,
    )

    def pose_at(timestamp_s: float) -> Float64:
        run_s = frame.timestamp_s + experiment.speed * (timestamp_s - frame.timestamp_s)
        return moved(frame.pose_at(run_s), experiment.turn_deg, experiment.move_mm)

    return replace(frame, condition=condition, pose_at=pose_at)


def is_recorded(experiment: Experiment, observed: ObservedRecording) -> bool:
    """Return True if a recording holds frames of an experiment; never for one that moves the tool."""
    setup = observed.setup
    if any(experiment.turn_deg) or any(experiment.move_mm) or experiment.speed != 1.0:
        return False
    # Without an arc the menu's arc is off: the same frames may stand there twice.
    arc_on = experiment.arc_on and setup.arc.shines

    def is_like(condition: Condition) -> bool:
        current = condition.arc_level ** (1.0 / setup.arc.current_exponent)
        return (
            (condition.laser_level > 0.0) == experiment.laser_on
            and (condition.arc_level > 0.0) == arc_on
            and math.isclose(condition.exposure_s, experiment.exposure * setup.camera.exposure_s, rel_tol=0.1)
            and (not arc_on or math.isclose(current, experiment.current, rel_tol=0.1))
        )

    return any(is_like(frame.condition) for frame in observed.frames)


def next_measurement(
    model: LinearizedModel, posterior: Posterior, errors: ErrorModel, policy: Policy, is_unknown: bool = False
) -> Next | None:
    """Return the experiment with the largest expected certainty; None if one hypothesis alone is probable.

    Each probable hypothesis predicts each experiment's frames with its posterior uncertainty: a difference
    that a rival could fit separates nothing. Where the cause is unknown, the likeliest hypotheses count, each
    as probable as the others: none of them is the whole cause. Recorded experiments are left out. If no
    experiment would raise a hypothesis to `policy.named`, a witness is proposed.
    """
    if is_unknown:
        distinct = {frozenset(hypothesis.ids): hypothesis for hypothesis in reversed(posterior.hypotheses)}
        # Effects between which an experiment is to decide where the cause is unknown.
        nearest = [h for h in posterior.hypotheses if distinct[frozenset(h.ids)] is h][:3]
        alive = [(hypothesis, 1.0) for hypothesis in nearest]
    else:
        alive = [
            (hypothesis, p)
            for hypothesis, p in zip(posterior.hypotheses, posterior.p, strict=True)
            if p >= policy.possible * sum(posterior.p)
        ]
    hypotheses = [hypothesis for hypothesis, _ in alive]
    ids = tuple(dict.fromkeys(name for hypothesis in hypotheses for name in hypothesis.ids))
    if len({frozenset(hypothesis.ids) for hypothesis in hypotheses}) > 1:
        weights = np.array([p for _, p in alive]) / sum(p for _, p in alive)
        kept = expected_certainty(_nats_apart(model, hypotheses, errors), weights, policy.temperature)
        kept[[is_recorded(experiment, model.observed) for experiment in MENU]] = 0.0
        best = int(np.argmax(kept))
        if kept[best] >= policy.named:
            return Next(MENU[best].name, ids, True)
    elif not (is_unknown and ids):
        return None
    return Next(f"{WITNESS[ids[0]]}, as a witness", ids, False)


def expected_certainty(nats: Float64, weights: Float64, temperature: float) -> Float64:
    """Return exp(-entropy) of the posterior that is expected after each experiment (n,).

    `nats` (h, g, n) is the expected log evidence of hypothesis h, if it is right, over g.
    """
    ln = np.log(weights)[np.newaxis, :, np.newaxis] - nats / temperature
    ln -= logsumexp(ln, axis=1, keepdims=True)
    entropy = -np.sum(np.exp(ln) * ln, axis=1)
    return np.asarray(np.exp(-weights @ entropy))


@dataclass(frozen=True, eq=False)
class PlannedForecast:
    """Prediction of each planned frame, DN: means (n,), and their uncertainty (n, p)."""

    means_dn: tuple[Float64, ...]
    spreads_dn: tuple[Float64, ...]


def _nats_apart(model: LinearizedModel, hypotheses: Sequence[Hypothesis], errors: ErrorModel) -> Float64:
    """Return the evidence (h, g, n), nats, that experiment n gives for hypothesis h, if right, over g."""
    planned = planned_model(model, MENU)
    return nats_apart(planned, [_forecast(planned, hypothesis, errors) for hypothesis in hypotheses])


def nats_apart(planned: LinearizedModel, forecasts: Sequence[PlannedForecast]) -> Float64:
    """Return the evidence (h, g, n), nats, that planned frame n gives for forecast h, if right, over g."""
    n_planned = len(planned.observed.frames)
    apart = np.zeros((len(forecasts), len(forecasts), n_planned))
    for (h, right), (g, rival) in itertools.permutations(enumerate(forecasts), 2):
        apart[h, g] = [_surprise(planned, right, rival, n) for n in range(n_planned)]
    return apart


def _forecast(planned: LinearizedModel, hypothesis: Hypothesis, errors: ErrorModel) -> PlannedForecast:
    fitted = hypothesis.refit
    ahead = refit_at(planned, fitted, steps=0)
    seen = LinearHypothesis.of(fitted).columns.changes
    information = errors.metric.products(seen, seen) + np.eye(seen.shape[1])
    # A frame's own level is new in each frame: nothing has been seen of it.
    shared, own = ~is_frame_level(fitted), is_frame_level(ahead)
    root = solve_triangular(np.linalg.cholesky(information), np.eye(len(information)), lower=True).T[shared]
    spread_by = np.zeros((len(own), root.shape[1] + int(own.sum())))
    spread_by[~own, : root.shape[1]] = root
    spread_by[own, root.shape[1] :] = np.eye(int(own.sum()))
    ends = np.cumsum([0, *planned.observed.counts])
    spread = (ahead.jacobian * ahead.quadratic.prior_sigmas) @ spread_by
    return PlannedForecast(
        tuple(light.mean_dn() for light in ahead.lights),
        tuple(spread[start:end] for start, end in itertools.pairwise(ends)),
    )


def is_frame_level(fitted: Refit) -> Bool:
    """Return the mask (p,) of a fit's parameters that belong to single frames."""
    return np.array([parameter.name.startswith(FRAME_LEVEL) for parameter in fitted.quadratic.parameters])


def _surprise(planned: LinearizedModel, right: PlannedForecast, rival: PlannedForecast, n: int) -> float:
    """Return the log likelihood ratio, nats, of the right hypothesis over a rival on the n-th experiment.

    It is half of d^T (S + J J^T)^-1 d, with S the noise of `N_MORE` frames and the model's floor.
    """
    mean_dn, setup = right.means_dn[n], planned.observed.setup
    noise_dn2, floor_dn2 = variances_dn2(mean_dn, setup)
    variance = noise_dn2 / planned.observed.bin_px**2 / N_MORE + floor_dn2
    # A bin within 3 sigmas of saturation may hold saturated pixels.
    dark = mean_dn < saturation_dn(setup.sensor) - 3.0 * np.sqrt(noise_dn2)
    # Neighbours share the model's error: a frame's bins count as 500 independent ones at most.
    weight = np.where(dark, 1.0 / variance, 0.0) * min(1.0, 500 / max(len(mean_dn), 1))
    difference, J = rival.means_dn[n] - mean_dn, rival.spreads_dn[n]
    information = J.T @ (weight[:, np.newaxis] * J) + np.eye(J.shape[1])
    along = J.T @ (weight * difference)
    return float(0.5 * (weight @ difference**2 - along @ np.linalg.solve(information, along)))


def planned_model(model: LinearizedModel, menu: Sequence[Experiment]) -> LinearizedModel:
    """Return the model for a menu's frames, a frame for each experiment."""
    observed, template = model.observed, _template(model)
    frames = tuple(
        _with_bins_of_pose(
            replace(planned_frame(experiment, template, observed.setup), position=position), observed
        )
        for position, experiment in enumerate(menu)
    )
    return LinearizedModel(replace(observed, frames=frames))


def _with_bins_of_pose(frame: ObservedFrame, observed: ObservedRecording) -> ObservedFrame:
    """Return a frame with the bins that count from its own pose."""
    setup, binned = observed.setup, observed.binned
    stations_mm, layers = stated_layers(setup, binned, frame.T_base_tool_in(setup), observed.seam)
    anywhere = np.ones(layers.view.shape, dtype=np.bool_)
    keep, in_stripe = bins_that_count(binned, layers, frame.condition, anywhere)
    return replace(
        frame,
        stations_mm=stations_mm,
        keep=keep,
        rendered=keep | dilate(in_stripe, STRIPE_RIM_BINS),
        in_stripe=in_stripe[keep],
        stated_arc_e=layers.arc_e,
        # There is no image yet: what it would show is counted in DN.
        sigma_dn=np.ones(int(keep.sum())),
        shown_dn2=np.zeros(int(keep.sum())),
    )


def _template(model: LinearizedModel) -> ObservedFrame:
    """Return the last of the frames that show most sources."""
    frames = model.observed.frames
    shows = max(int(f.condition.arc_level > 0.0) + int(f.condition.laser_level > 0.0) for f in frames)
    best = [
        f for f in frames if int(f.condition.arc_level > 0.0) + int(f.condition.laser_level > 0.0) == shows
    ]
    return best[-1]
