"""Costs of the catalogue's effects for a setup, before anything is recorded, see `seam_cost`.

Each effect has two sizes: the values that the documentation shows it with, and one sigma. One sigma is that
of `[tolerance]` where a setup states it, else the prior's, of each parameter by which the diagnosis seeks it.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.condition import Condition
from noise_model.effects import REGISTRY, Values, not_predicted
from noise_model.fit import within_bounds
from noise_model.forward import Renderer
from noise_model.setup import Setup
from noise_model.surface.joint import NOMINAL_SEAM
from sim_to_real.decision.seam_cost import (
    TRIANGULATED_EFFECTS,
    UNRENDERED_EFFECTS,
    SceneFrame,
    SeamTrial,
    Spread,
    cost_of,
    ranked,
    seam_in_images,
    triangulation_shifts_mm,
    unknown_cost,
)
from sim_to_real.diagnosis import EffectCost, SeamShift
from sim_to_real.search.score_test import FAMILIES
from tracker.state import Frame

PoseOfTool = Callable[[float], Float64]
"""The tool's pose T_base_tool at a time, s."""


class SizeKind(Enum):
    """Origin of an effect's size."""

    TYPICAL = "typical"
    TOLERANCE = "tolerance"
    PRIOR = "prior"


class SetupCost(NamedTuple):
    """Cost of an effect of a kind of size; one sigma's are those of its parameters, added in squares."""

    kind: SizeKind
    cost: EffectCost


def setup_costs(
    setup: Setup,
    pose_at: PoseOfTool,
    times_s: Sequence[float],
    began_s: float,
    on_effect: Callable[[int, int], None],
) -> tuple[SetupCost, ...]:
    """Return the costs of all effects that a setup can have, typical ones first, each kind the largest first.

    Frames are rendered at some times along the tool's way, which began at `began_s`, laser and arc on, the
    seam nominal. `on_effect` gets the number of effects done, and of all.
    """
    trial = SetupTrial(setup, pose_at, times_s, began_s)
    names = [name for name in REGISTRY if name not in not_predicted(setup)]
    costs = []
    for n, name in enumerate(names):
        effect = REGISTRY[name]
        values = effect.complete({**setup.effects.get(name, {}), **effect.typical})
        costs += [SetupCost(SizeKind.TYPICAL, trial.cost(name, values)), *trial.one_sigma(name)]
        on_effect(n + 1, len(names))
    order = {id(cost): n for n, cost in enumerate(ranked([each.cost for each in costs]))}
    return tuple(sorted(costs, key=lambda c: (c.kind is not SizeKind.TYPICAL, order[id(c.cost)])))


class SetupTrial:
    """Expected frames of a setup along its way, and the points in which the tracker sees the seam there."""

    def __init__(self, setup: Setup, pose_at: PoseOfTool, times_s: Sequence[float], began_s: float) -> None:
        # Bounced light takes seconds a frame.
        stated = {name: v for name, v in setup.effects.items() if name not in UNRENDERED_EFFECTS}
        self._known = replace(setup, effects=stated)
        camera = setup.camera
        blank = np.empty((0, 0), dtype=setup.sensor.dtype)
        frames = [
            SceneFrame(
                Frame(n, t, blank, camera.exposure_s, setup.arc.current_a),
                pose_at,
                Condition(1.0, 1.0, camera.exposure_s, t - began_s),
                NOMINAL_SEAM,
            )
            for n, t in enumerate(times_s)
        ]
        self._trial = SeamTrial(self._known, frames, Renderer(len(frames)))
        is_seen = np.isfinite(self._trial.without_mm[:, 0])
        seen_s = np.array(times_s)[is_seen].tolist()
        self._seen = seam_in_images(self._known, seen_s, [pose_at] * len(seen_s), _nominal)

    def cost(self, name: str, values: Values) -> EffectCost:
        """Return the cost of an effect of a size."""
        if name in UNRENDERED_EFFECTS:
            return unknown_cost(name, values, is_named=False)
        n = len(values)
        without_mm = self._trial.without_mm
        if name in TRIANGULATED_EFFECTS:
            without_mm = without_mm[np.isfinite(without_mm[:, 0])]
        spread = Spread(values, np.zeros((n, n)))
        try:
            return cost_of(name, lambda v: self._shifts_mm(name, v), spread, without_mm, is_named=False)
        except ValueError:
            # It would put the camera below the surface.
            return unknown_cost(name, values, is_named=False)

    def one_sigma(self, name: str) -> Iterator[SetupCost]:
        """Yield the cost of one sigma of an effect, if the diagnosis seeks it by its size."""
        kind, sizes = sizes_of_one_sigma(self._known, name)
        if sizes:
            parts = [self.cost(name, values) for values in sizes]
            yield SetupCost(kind, in_squares(parts, stated_values(self._known, name)))

    def _shifts_mm(self, name: str, values: Values) -> Float64:
        if name in TRIANGULATED_EFFECTS:
            return triangulation_shifts_mm(self._seen, self._known, name, values, _nominal)
        return self._trial.shifts_mm(name, [values] * len(self._trial.without_mm))


def _nominal(stations_mm: Float64) -> Float64:
    return np.zeros((len(stations_mm), 2))


def stated_values(setup: Setup, name: str) -> dict[str, float]:
    """Return the values about which an effect is off: those that the setup states, else neutral.

    What gives it its form is that of the family by which the diagnosis seeks it first.
    """
    return REGISTRY[name].complete({**FAMILIES[name][0].shape, **setup.effects.get(name, {})})


def sizes_of_one_sigma(setup: Setup, name: str) -> tuple[SizeKind, list[dict[str, float]]]:
    """Return an effect's parameters one sigma off, a set for each by which it is sought; or none."""
    if name not in FAMILIES:
        return SizeKind.PRIOR, []
    parameters, probe_points = REGISTRY[name].parameters, FAMILIES[name][0].probe_points
    stated, start = _stated_sigmas(setup, name), stated_values(setup, name)
    sizes = []
    for parameter in parameters:
        if any(parameter.name in point for point in probe_points):
            off = start[parameter.name] + stated.get(parameter.name, parameter.prior_sigma)
            moved = {**start, parameter.name: off}
            inside = within_bounds(parameters, np.array(list(moved.values())))
            sizes.append(dict(zip(moved, inside.tolist(), strict=True)))
    # What is as far off as it can be already, a plate without an end, has no size.
    sizes = [values for values in sizes if values != start]
    return SizeKind.TOLERANCE if stated else SizeKind.PRIOR, sizes


def _stated_sigmas(setup: Setup, name: str) -> Mapping[str, float]:
    """Return 1 sigma of those parameters of an effect of which `[tolerance]` says it."""
    tolerance = setup.tolerance
    if name == "black_level":
        return {"offset_dn": tolerance.black_level_dn}
    if name == "hand_eye":
        return {
            parameter.name: tolerance.hand_eye_deg if parameter.unit == "deg" else tolerance.hand_eye_mm
            for parameter in REGISTRY[name].parameters
        }
    return {}


def in_squares(parts: Sequence[EffectCost], start: Values) -> EffectCost:
    """Return the cost of independent parts of one effect together: their shifts add in squares.

    Each part has one value off `start`, and all have theirs. The worst part says how many frames lose the
    seam.
    """
    moved = {
        key: next((part.values[key] for part in parts if part.values[key] != value), value)
        for key, value in start.items()
    }
    lateral, vertical = (
        _sum([getattr(part, axis) for part in parts]) for axis in ("lateral_mm", "vertical_mm")
    )
    n_lost = max(part.n_lost for part in parts)
    return replace(parts[0], lateral_mm=lateral, vertical_mm=vertical, n_lost=n_lost, values=moved)


def _sum(shifts: Sequence[SeamShift]) -> SeamShift:
    total = math.hypot(*(shift.value for shift in shifts))
    return SeamShift(total, total, total, math.nan)
