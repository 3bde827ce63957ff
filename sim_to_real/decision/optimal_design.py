"""Which measurement would tell two fits apart.

Between two fits the best next frames are those that leave most where one predicts them and the other is
fitted to them, too (T-optimality: Atkinson and Fedorov 1975, Biometrika 62, 57).
"""

from __future__ import annotations

import itertools
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
from sim_to_real.fit.gauss_newton import NAMED_FROM, OWN_LEVEL, Refit, refit
from sim_to_real.fit.linearized_model import Expected, Passed
from sim_to_real.fit.quadratic import Quadratic
from sim_to_real.search.hypothesis import cost_nats, likelihood_nats

ROUNDS = 3
"""So often the rival's derivatives are taken where its fit to an experiment came to."""

NEARLY = 3.0
"""So many sigmas below saturation a bin's pixels may be saturated."""


def planned_frame(experiment: Experiment, of: ObservedFrame, setup: Setup) -> ObservedFrame:
    """Return the frame that an experiment would give at the time of one that there is."""
    condition = Condition.of(
        setup,
        laser_on=experiment.laser_on,
        arc_on=experiment.arc_on,
        current_a=experiment.current * setup.arc.current_a,
        exposure_s=experiment.exposure * setup.camera.exposure_s,
        timestamp_s=of.condition.timestamp_s,
    )

    def pose_at(timestamp_s: float) -> Float64:
        run_s = of.timestamp_s + experiment.speed * (timestamp_s - of.timestamp_s)
        return moved(of.pose_at(run_s), experiment.turn_deg, experiment.move_mm)

    return replace(of, condition=condition, pose_at=pose_at)


def best_measurement(expected: Expected, one: Refit, other: Refit) -> Next:
    """Return the measurement of the menu after which two fits differ most, whichever of them is right.

    The other is then fitted again to all that was measured: what it can bend to does not tell. Where none
    tells them apart, a witness of the first is to be added.
    """
    planned = _planned(expected)
    nats = np.minimum(_set_back(planned, one, other), _set_back(planned, other, one))
    best, ids = int(np.argmax(nats)), (*one.ids, *other.ids)
    if nats[best] > NAMED_FROM:
        return Next(MENU[best].name, ids, True)
    return Next(f"{WITNESS[one.ids[-1]]}, as a witness", ids, False)


def _set_back(planned: Expected, right: Refit, rival: Refit) -> Float64:
    """Return by how many nats a fit is likelier than its rival after each experiment (n,), if it is right.

    The experiments' frames are then as it predicts them, and the rival is fitted again to these and to all
    that it has seen.
    """
    as_predicted = [light.mean_dn() for light in _passed(planned, right)]
    # Light that bounces is computed once for each frame, and remembered.
    _passed(planned, rival)
    seen = planned.observed
    planned.take_frames(_showing(f, dn, seen) for f, dn in zip(seen.frames, as_predicted, strict=True))
    planned.take_tangents(rival.nuisance, rival.effects, rival.change)
    price = cost_nats(rival.n_parameters) - cost_nats(right.n_parameters)
    nats = []
    for n in range(len(MENU)):
        both = _fitted_to_both(planned, rival, n)
        # What a right fit leaves of its frames is left of those to come.
        share_new = 1.0 - float(rival.quadratic.counts.sum() / both.counts.sum())
        left = both.mean_square(both.x) + share_new * right.mean_square
        nats.append(likelihood_nats(right.mean_square) - likelihood_nats(left) + price)
    return np.array(nats)


def _fitted_to_both(planned: Expected, fitted: Refit, n: int) -> Quadratic:
    """Return a fit's cost, at its least, over the frames that it has seen and the n-th experiment's."""
    # A level of its own shows beside another frame that the arc lights.
    beside = next(m for m in np.flatnonzero(planned.observed.lit).tolist() if m != n)
    few = planned.some(np.isin(np.arange(len(MENU)), [n, beside]))
    x, p = fitted.x, len(fitted.x)
    for _ in range(ROUNDS):
        nuisance, effects, change = fitted.at(x)
        there = refit(few, effects, nuisance, steps=0, change=change).quadratic
        both = with_more(fitted.quadratic.about(x), there, int(n > beside), N_MORE)
        both = both.about(both.solve())
        x = both.x[:p]
    return both


def with_more(seen: Quadratic, more: Quadratic, n: int, times: int) -> Quadratic:
    """Return the cost of the frames that were seen and, so many `times`, of the n-th of some more.

    Both are about the same parameters; but a level of its own belongs to a frame's own quadratic.
    """
    own = np.array([parameter.name.startswith(OWN_LEVEL) for parameter in more.parameters])
    shared = np.array([not parameter.name.startswith(OWN_LEVEL) for parameter in seen.parameters])
    p = len(seen.x)
    at = np.empty(len(more.x), dtype=np.int64)
    at[~own] = np.flatnonzero(shared)
    at[own] = p + np.arange(int(own.sum()))
    size, f = p + int(own.sum()), len(seen.counts)
    information, gradient = np.zeros((f + 1, size, size)), np.zeros((f + 1, size))
    information[:f, :p, :p], gradient[:f, :p] = seen.information, seen.gradient
    information[f][np.ix_(at, at)], gradient[f, at] = times * more.information[n], times * more.gradient[n]
    return Quadratic(
        (*seen.parameters, *itertools.compress(more.parameters, own)),
        np.concatenate([seen.x, more.x[own]]),
        information,
        gradient,
        np.append(seen.chi2, times * more.chi2[n]),
        np.append(seen.counts, times * more.counts[n]),
    )


def _planned(expected: Expected) -> Expected:
    """Return the model for the menu's frames, a frame for each experiment."""
    observed, template = expected.observed, _template(expected)
    frames = tuple(
        _looking(replace(planned_frame(experiment, template, observed.setup), position=position), observed)
        for position, experiment in enumerate(MENU)
    )
    return Expected(replace(observed, frames=frames))


def _passed(planned: Expected, fitted: Refit) -> list[Passed]:
    return planned.passed(fitted.nuisance, fitted.effects, fitted.change)


def _looking(frame: ObservedFrame, observed: Observed) -> ObservedFrame:
    """Return a frame with the bins that count from where it is taken."""
    setup, binned = observed.setup, observed.binned
    stations_mm, layers = stated_layers(setup, binned, frame.T_base_tool_in(setup), observed.seam)
    anywhere = np.ones(layers.view.shape, dtype=np.bool_)
    keep, in_stripe = bins_that_count(binned, layers, frame.condition, anywhere)
    return replace(frame, stations_mm=stations_mm, keep=keep, rendered=keep, in_stripe=in_stripe[keep])


def _showing(frame: ObservedFrame, mean_dn: Float64, observed: Observed) -> ObservedFrame:
    """Return a frame whose bins that count show a mean (n,), with the noise that it has; inf if saturated."""
    setup, bin_px = observed.setup, observed.bin_px
    binned_dn = frame.binned_dn.copy()
    binned_dn[frame.keep] = mean_dn
    noise_dn2, floor_dn2 = variances_dn2(mean_dn, setup)
    sigma_dn = np.sqrt(noise_dn2 / bin_px**2 + floor_dn2)
    sigma_dn[mean_dn >= saturation_dn(setup.sensor) - NEARLY * np.sqrt(noise_dn2)] = np.inf
    return replace(frame, binned_dn=binned_dn, sigma_dn=sigma_dn)


def _template(expected: Expected) -> ObservedFrame:
    """Return the last of the frames that show most."""
    frames = expected.observed.frames
    shows = max(int(f.condition.arc_level > 0.0) + int(f.condition.laser_level > 0.0) for f in frames)
    best = [
        f for f in frames if int(f.condition.arc_level > 0.0) + int(f.condition.laser_level > 0.0) == shows
    ]
    return best[-1]
