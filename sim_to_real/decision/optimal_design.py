"""The experiment that would tell two fits apart: a T-optimal design.

The best next frames are those with the largest residual when one fit has predicted them and the other one is
fitted to them, too (Atkinson and Fedorov 1975, Biometrika 62, 57).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np

from noise_model.arrays import Float64
from noise_model.condition import Condition
from noise_model.instrument.sensor import saturation_dn
from noise_model.setup import Setup
from noise_model.transforms import moved
from sim_to_real.data.binned import Observed, ObservedFrame, bins_that_count, stated_layers, variances_dn2
from sim_to_real.decision.experiments import MENU, N_MORE, WITNESS, Experiment
from sim_to_real.diagnosis import Next
from sim_to_real.fit.gauss_newton import FRAME_LEVEL, MIN_EVIDENCE_NATS, Refit, refit
from sim_to_real.fit.linearized_model import FrameLight, LinearizedModel
from sim_to_real.fit.quadratic import Quadratic
from sim_to_real.search.hypothesis import bic_penalty_nats, likelihood_nats

RIVAL_REFITS = 3
"""Gauss-Newton steps of the rival's fit to an experiment."""

RECORDED_REL = 0.1
"""A recording holds an experiment if exposure and current of a frame differ from its by a smaller share."""

SATURATION_SIGMAS = 3.0
"""A bin whose mean is fewer sigmas below saturation may hold saturated pixels."""


def planned_frame(experiment: Experiment, frame: ObservedFrame, setup: Setup) -> ObservedFrame:
    """Return the frame that an experiment would give at the time of an existing one."""
    condition = Condition.of(
        setup,
        laser_on=experiment.laser_on,
        arc_on=experiment.arc_on,
        current_a=experiment.current * setup.arc.current_a,
        exposure_s=experiment.exposure * setup.camera.exposure_s,
        timestamp_s=frame.condition.timestamp_s,
    )

    def pose_at(timestamp_s: float) -> Float64:
        run_s = frame.timestamp_s + experiment.speed * (timestamp_s - frame.timestamp_s)
        return moved(frame.pose_at(run_s), experiment.turn_deg, experiment.move_mm)

    return replace(frame, condition=condition, pose_at=pose_at)


def is_recorded(experiment: Experiment, observed: Observed) -> bool:
    """Say whether a recording holds frames of an experiment; of one that moves the tool it never does."""
    setup = observed.setup
    if any(experiment.turn_deg) or any(experiment.move_mm) or experiment.speed != 1.0:
        return False

    def is_like(condition: Condition) -> bool:
        current = condition.arc_level ** (1.0 / setup.arc.current_exponent)
        return (
            (condition.laser_level > 0.0) == experiment.laser_on
            and (condition.arc_level > 0.0) == experiment.arc_on
            and math.isclose(
                condition.exposure_s, experiment.exposure * setup.camera.exposure_s, rel_tol=RECORDED_REL
            )
            and (not experiment.arc_on or math.isclose(current, experiment.current, rel_tol=RECORDED_REL))
        )

    return any(is_like(frame.condition) for frame in observed.frames)


def best_measurement(model: LinearizedModel, first: Refit, other: Refit) -> Next:
    """Return the experiment of the menu that best tells two fits apart, whichever of them is right.

    The wrong one is fitted again to all frames: what it can adapt to tells nothing. Experiments that the
    recording holds already are not asked for. If no other one tells the two apart, a witness of the first is
    to be added.
    """
    planned = _planned(model)
    nats = np.minimum(_evidence_over(planned, first, other), _evidence_over(planned, other, first))
    nats[[is_recorded(experiment, model.observed) for experiment in MENU]] = -np.inf
    best, ids = int(np.argmax(nats)), (*first.ids, *other.ids)
    if nats[best] > MIN_EVIDENCE_NATS:
        return Next(MENU[best].name, ids, True)
    return Next(f"{WITNESS[first.ids[-1]]}, as a witness", ids, False)


def _evidence_over(planned: LinearizedModel, right: Refit, rival: Refit) -> Float64:
    """Return the evidence of a fit over its rival after each experiment (n,), nats, if the fit is right.

    The experiments' frames are as the fit predicts them. The rival is fitted to these and to all it has seen.
    """
    as_predicted = [light.mean_dn() for light in _lights(planned, right)]
    # Bounced light is computed once for each frame and cached.
    _lights(planned, rival)
    seen = planned.observed
    planned.take_frames(_showing_mean(f, dn, seen) for f, dn in zip(seen.frames, as_predicted, strict=True))
    planned.take_tangents(rival.nuisance, rival.effects, rival.trend)
    penalty_nats = bic_penalty_nats(rival.n_parameters) - bic_penalty_nats(right.n_parameters)
    nats = []
    for n in range(len(MENU)):
        both = _fitted_to_both(planned, rival, n)
        # The right fit leaves as much of the new frames as of its own.
        share_new = 1.0 - float(rival.quadratic.counts.sum() / both.counts.sum())
        mean_square = both.mean_square(both.x) + share_new * right.mean_square
        nats.append(likelihood_nats(right.mean_square) - likelihood_nats(mean_square) + penalty_nats)
    return np.array(nats)


def _fitted_to_both(planned: LinearizedModel, fitted: Refit, n: int) -> Quadratic:
    """Return a fit's cost about its minimum over the frames that it has seen and the n-th experiment's."""
    # A frame's own level shows only beside another frame that the arc lights.
    beside = next(m for m in np.flatnonzero(planned.observed.lit).tolist() if m != n)
    few = planned.subset(np.isin(np.arange(len(MENU)), [n, beside]))
    x, p = fitted.x, len(fitted.x)
    for _ in range(RIVAL_REFITS):
        nuisance, effects, trend = fitted.split_parameters(x)
        there = refit(few, effects, nuisance, steps=0, trend=trend).quadratic
        both = with_experiment(fitted.quadratic.expanded_at(x), there, int(n > beside), N_MORE)
        both = both.expanded_at(both.solve())
        x = both.x[:p]
    return both


def with_experiment(seen: Quadratic, experiment: Quadratic, n: int, times: int) -> Quadratic:
    """Return the cost of the frames that were seen plus so many `times` that of the n-th experiment's frame.

    Both have the same parameters, except the frames' own levels.
    """
    own = np.array([parameter.name.startswith(FRAME_LEVEL) for parameter in experiment.parameters])
    shared = np.array([not parameter.name.startswith(FRAME_LEVEL) for parameter in seen.parameters])
    p = len(seen.x)
    places = np.empty(len(experiment.x), dtype=np.int64)
    places[~own] = np.flatnonzero(shared)
    places[own] = p + np.arange(int(own.sum()))
    size, f = p + int(own.sum()), len(seen.counts)
    information, gradient = np.zeros((f + 1, size, size)), np.zeros((f + 1, size))
    information[:f, :p, :p], gradient[:f, :p] = seen.information, seen.gradient
    information[f][np.ix_(places, places)] = times * experiment.information[n]
    gradient[f, places] = times * experiment.gradient[n]
    return Quadratic(
        (*seen.parameters, *itertools.compress(experiment.parameters, own)),
        np.concatenate([seen.x, experiment.x[own]]),
        information,
        gradient,
        np.append(seen.chi2, times * experiment.chi2[n]),
        np.append(seen.counts, times * experiment.counts[n]),
    )


def _planned(model: LinearizedModel) -> LinearizedModel:
    """Return the model for the menu's frames, a frame for each experiment."""
    observed, template = model.observed, _template(model)
    frames = tuple(
        _with_bins_of_pose(
            replace(planned_frame(experiment, template, observed.setup), position=position), observed
        )
        for position, experiment in enumerate(MENU)
    )
    return LinearizedModel(replace(observed, frames=frames))


def _lights(planned: LinearizedModel, fitted: Refit) -> list[FrameLight]:
    return planned.lights(fitted.nuisance, fitted.effects, fitted.trend)


def _with_bins_of_pose(frame: ObservedFrame, observed: Observed) -> ObservedFrame:
    """Return a frame with the bins that count from its own pose."""
    setup, binned = observed.setup, observed.binned
    stations_mm, layers = stated_layers(setup, binned, frame.T_base_tool_in(setup), observed.seam)
    anywhere = np.ones(layers.view.shape, dtype=np.bool_)
    keep, in_stripe = bins_that_count(binned, layers, frame.condition, anywhere)
    return replace(frame, stations_mm=stations_mm, keep=keep, rendered=keep, in_stripe=in_stripe[keep])


def _showing_mean(frame: ObservedFrame, mean_dn: Float64, observed: Observed) -> ObservedFrame:
    """Return a frame whose bins show a mean (n,), DN, with its noise; inf where it may be saturated."""
    setup, bin_px = observed.setup, observed.bin_px
    binned_dn = frame.binned_dn.copy()
    binned_dn[frame.keep] = mean_dn
    noise_dn2, floor_dn2 = variances_dn2(mean_dn, setup)
    sigma_dn = np.sqrt(noise_dn2 / bin_px**2 + floor_dn2)
    sigma_dn[mean_dn >= saturation_dn(setup.sensor) - SATURATION_SIGMAS * np.sqrt(noise_dn2)] = np.inf
    return replace(frame, binned_dn=binned_dn, sigma_dn=sigma_dn)


def _template(model: LinearizedModel) -> ObservedFrame:
    """Return the last of the frames that show most sources."""
    frames = model.observed.frames
    shows = max(int(f.condition.arc_level > 0.0) + int(f.condition.laser_level > 0.0) for f in frames)
    best = [
        f for f in frames if int(f.condition.arc_level > 0.0) + int(f.condition.laser_level > 0.0) == shows
    ]
    return best[-1]
