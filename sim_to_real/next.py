"""What a recording can tell apart at all, and which measurement would tell what it cannot.

An effect's signature is what it does to the residuals, with all that nuisances can do projected out. Two
effects whose signatures lie within each other's span look the same; the smallest magnitude that shows is
where the signature outweighs what the effect's parameters cost. Between two fits the best next frame is the
one that they predict most differently (T-optimality: Atkinson and Fedorov 1975, Biometrika 62, 57).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.arc import level
from noise_model.condition import Condition
from noise_model.effects import REGISTRY
from noise_model.frames import Float64, moved
from noise_model.setup import Setup
from sim_to_real.diagnosis import Estimate, Next
from sim_to_real.expected import Expected
from sim_to_real.observed import ObservedFrame
from sim_to_real.quadratic import N_EFFECTIVE
from sim_to_real.refit import NAMED_FROM, Refit
from sim_to_real.screen import Screened
from sim_to_real.select import cost_nats

ALIKE = 0.98
"""A signature of which this share, as a cosine, lies in another's span cannot be told from it."""

TILT_DEG, RAISE_MM, CURRENT, EXPOSURE, FASTER = 10.0, 2.0, 1.5, 0.5, 3.0
"""The changes that the menu's measurements make: angle, height, and factors of the rest."""


def own_signatures(baseline: Refit, screened: Sequence[Screened]) -> dict[str, Float64]:
    """Return effects' signatures (n, k): what their places do to residuals and, below, to priors' pulls.

    What nuisances can do is projected out, within what priors let them if as much is left as the model may
    be off, see `Quadratic.prior_weight`.
    """
    weight = max(len(baseline.jacobian) / N_EFFECTIVE, 1.0)
    sigmas = np.array([parameter.prior_sigma for parameter in baseline.quadratic.parameters])
    priors = math.sqrt(weight) / sigmas
    known = np.vstack([baseline.jacobian, np.diag(priors)])
    basis, _ = np.linalg.qr(known)
    found = {}
    for one in screened:
        signature = np.vstack([one.signature, np.zeros((len(priors), one.signature.shape[1]))])
        found[one.id] = signature - basis @ (basis.T @ signature)
    return found


def not_resolvable(signatures: Mapping[str, Float64]) -> tuple[tuple[str, str], ...]:
    """Return the pairs of effects that look the same."""
    names = [name for name, signature in signatures.items() if np.linalg.norm(signature) > 0.0]
    spans = {name: _span(signatures[name]) for name in names}
    pairs = []
    for n, one in enumerate(names):
        for other in names[n + 1 :]:
            small, large = sorted((spans[one], spans[other]), key=lambda span: span.shape[1])
            # The least cosine between the smaller span and the larger: all of it must lie within.
            if small.shape[1] and np.linalg.svd(large.T @ small, compute_uv=False).min() > ALIKE:
                pairs.append((one, other))
    return tuple(pairs)


def _span(signature: Float64) -> Float64:
    """Return an orthonormal basis (n, k) of a signature's columns that do something."""
    sizes = np.linalg.norm(signature, axis=0)
    basis, weight, _ = np.linalg.svd(signature / np.maximum(sizes, 1e-12), full_matrices=False)
    return np.asarray(basis[:, weight > 1e-3])


def smallest(signatures: Mapping[str, Float64], screened: Sequence[Screened]) -> dict[str, Estimate]:
    """Return the least magnitude of each effect that would show; those that never do are left out."""
    found = {}
    for one in screened:
        n = len(one.signature)
        per_unit = float(np.sum(signatures[one.id][:, 0] ** 2)) / n
        evidence = NAMED_FROM + cost_nats(len(REGISTRY[one.id].parameters))
        needed = math.expm1(2.0 * evidence / N_EFFECTIVE)
        if per_unit > 0.0:
            parameter, step = one.place
            unit = next(p.unit for p in REGISTRY[one.id].parameters if p.name == parameter)
            found[one.id] = Estimate(abs(step) * math.sqrt(needed / per_unit), math.nan, unit)
    return found


@dataclass(frozen=True)
class Measurement:
    """One of the menu: what to do, and the frame that it would give of one that there is."""

    name: str
    frame: Callable[[ObservedFrame, Setup], ObservedFrame]


def _lit(**changes: float) -> Callable[[ObservedFrame, Setup], ObservedFrame]:
    def frame(of: ObservedFrame, setup: Setup) -> ObservedFrame:
        full = Condition(1.0, level(setup.arc, setup.arc.current_a), setup.camera.exposure_s, 0.0)
        condition = replace(full, timestamp_s=of.condition.timestamp_s, **changes)
        return replace(of, condition=condition)

    return frame


def _scaled(exposure: float = 1.0, current: float = 1.0) -> Callable[[ObservedFrame, Setup], ObservedFrame]:
    def frame(of: ObservedFrame, setup: Setup) -> ObservedFrame:
        lit = _lit()(of, setup)
        condition = replace(
            lit.condition,
            exposure_s=exposure * lit.condition.exposure_s,
            arc_level=level(setup.arc, current * setup.arc.current_a),
        )
        return replace(lit, condition=condition)

    return frame


def _posed(
    turn_deg: Sequence[float], move_mm: Sequence[float]
) -> Callable[[ObservedFrame, Setup], ObservedFrame]:
    def frame(of: ObservedFrame, setup: Setup) -> ObservedFrame:
        return replace(
            _lit()(of, setup),
            pose_at=lambda t: moved(of.pose_at(t), turn_deg, np.asarray(move_mm, dtype=np.float64)),
        )

    return frame


def _faster(of: ObservedFrame, setup: Setup) -> ObservedFrame:
    return replace(
        _lit()(of, setup),
        pose_at=lambda t: of.pose_at(of.timestamp_s + FASTER * (t - of.timestamp_s)),
    )


MENU = (
    Measurement("dark frames", _lit(laser_level=0.0, arc_level=0.0)),
    Measurement("laser alone, arc off", _lit(arc_level=0.0)),
    Measurement("arc alone, laser off", _lit(laser_level=0.0)),
    Measurement("a second exposure, half as long", _scaled(exposure=EXPOSURE)),
    Measurement("a second current, half as much again", _scaled(current=CURRENT)),
    Measurement(f"the torch raised by {RAISE_MM:g} mm", _posed((0.0, 0.0, 0.0), (0.0, 0.0, RAISE_MM))),
    Measurement(
        f"the torch tilted sideways by {TILT_DEG:g} deg", _posed((TILT_DEG, 0.0, 0.0), (0.0, 0.0, 0.0))
    ),
    Measurement(
        f"the torch tilted along the seam by {TILT_DEG:g} deg", _posed((0.0, TILT_DEG, 0.0), (0.0, 0.0, 0.0))
    ),
    Measurement(f"the same run {FASTER:g} times as fast", _faster),
)
"""What may be measured next."""


def best_measurement(expected: Expected, one: Refit, other: Refit) -> Next:
    """Return the measurement of the menu whose frame two fits predict most differently."""
    template = _template(expected)
    setup = expected.observed.setup
    frames: list[ObservedFrame] = []
    for measurement in MENU:
        frames.append(replace(measurement.frame(template, setup), position=len(frames)))
    planned = Expected(replace(expected.observed, frames=tuple(frames)))
    means = [
        [light.mean_dn() for light in planned.passed(fitted.nuisance, fitted.effects)]
        for fitted in (one, other)
    ]
    apart = [float(np.mean(((a - b) / template.sigma_dn) ** 2)) for a, b in zip(*means, strict=True)]
    best = int(np.argmax(apart))
    resolves = 0.5 * N_EFFECTIVE * math.log1p(apart[best]) > NAMED_FROM
    return Next(MENU[best].name, (*one.ids, *other.ids), resolves)


def _template(expected: Expected) -> ObservedFrame:
    """Return the frame in the middle of those that show most."""
    frames = expected.observed.frames
    shows = max(int(f.condition.arc_level > 0.0) + int(f.condition.laser_level > 0.0) for f in frames)
    best = [
        f for f in frames if int(f.condition.arc_level > 0.0) + int(f.condition.laser_level > 0.0) == shows
    ]
    return best[len(best) // 2]
