"""Costs of a diagnosis' effects in its recording, see `sim_to_real.decision.seam_cost`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.effects import REGISTRY, Values
from noise_model.even_sample import evenly
from noise_model.forward import Renderer
from sim_to_real.data.binned import ObservedFrame, ObservedRecording
from sim_to_real.decision.seam_cost import (
    TRIANGULATED_EFFECTS,
    UNRENDERED_EFFECTS,
    SceneFrame,
    SeamTrial,
    Shifts,
    Spread,
    bound_of,
    cost_of,
    ranked,
    seam_in_images,
    triangulation_shifts_mm,
    unknown_cost,
)
from sim_to_real.diagnosis import EffectCost
from sim_to_real.evidence.hypotheses import Posterior
from sim_to_real.fit.gauss_newton import Refit
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.nuisances import N_LEVELS, apply_levels, apply_nuisances
from sim_to_real.fit.trend import Trend, trend_among
from sim_to_real.variance.random_effects import RandomEffects
from tracker.seam_observations import TRIANGULATION_EFFECTS, SeamObservations
from tracker.state import Frame

N_FOUND, N_BOUND = 4, 1
"""Frames that are rendered for an effect that was found, and for the bound of one that was not.

A frame takes 20 ms where an effect changes the image alone, 100 ms where light is rendered anew.
"""

MIN_PROBABILITY = 0.05
"""Probability below which an effect counts as not found: the same that lists a hypothesis as possible."""


class FoundEffect(NamedTuple):
    """An effect that may be there: its parameters with their covariance, and the trend of its size."""

    spread: Spread
    trend: Trend | None
    is_named: bool


class RecordingCost:
    """Costs of effects along a recording, with camera, levels and seam of a fit to some of its frames."""

    def __init__(
        self, frames: Sequence[Frame], model: LinearizedModel, held_out: ObservedRecording, after: Refit
    ) -> None:
        self._known = apply_nuisances(model.observed.setup, after.nuisance)
        self._headers = {frame.index: frame for frame in frames}
        self._model, self._held_out, self._after = model, held_out, after
        curve = model.renderings.seam_curve(after.effects)
        self._stations_mm = curve.stations_mm
        self._y_z_mm, _ = curve.evaluate(after.nuisance[N_LEVELS:])
        self._seen = self._seam_in_images()
        self._renderer = Renderer(N_FOUND)
        self._trials: dict[int, tuple[SeamTrial, tuple[ObservedFrame, ...]]] = {}

    def of_each(
        self, likely: Mapping[str, FoundEffect], smallest: Mapping[str, Sequence[Values]]
    ) -> tuple[EffectCost, ...]:
        """Return the costs of effects that were found, and bounds of those that were not, ranked.

        Bounds are of the effects on geometry and timing alone. The others change light, and at the smallest
        size that would show they move the seam by about a micrometre.
        """
        return ranked([*self._found(likely), *self._bounds(smallest, likely)])

    def _found(self, likely: Mapping[str, FoundEffect]) -> Iterator[EffectCost]:
        for name, effect in likely.items():
            if name in UNRENDERED_EFFECTS:
                yield unknown_cost(name, effect.spread.values, is_named=effect.is_named)
            else:
                shifts_of, without_mm = self._shifts(name, N_FOUND, effect.trend)
                yield cost_of(name, shifts_of, effect.spread, without_mm, is_named=effect.is_named)

    def _bounds(
        self, smallest: Mapping[str, Sequence[Values]], likely: Mapping[str, FoundEffect]
    ) -> Iterator[EffectCost]:
        for name, sizes in smallest.items():
            if sizes and name not in likely and name in TRIANGULATION_EFFECTS:
                shifts_of, without_mm = self._shifts(name, N_BOUND, None)
                yield bound_of(name, shifts_of, sizes, without_mm)

    def _shifts(self, name: str, n_frames: int, trend: Trend | None) -> tuple[Shifts, Float64]:
        """Return the shifts (n, 2) by an effect's parameters, and the errors without it (n, 2), mm."""
        if name in TRIANGULATED_EFFECTS:
            without_mm = np.zeros((len(self._seen.image_px), 2))
            return lambda values: triangulation_shifts_mm(
                self._seen, self._known, name, values, self._course
            ), without_mm
        trial, chosen = self._trial(n_frames)

        def by_rendering(values: Values) -> Float64:
            return trial.shifts_mm(name, [self._in_frame(values, trend, frame) for frame in chosen])

        return by_rendering, trial.without_mm

    def _in_frame(self, values: Values, trend: Trend | None, frame: ObservedFrame) -> Values:
        return values if trend is None else trend.values_at(values, trend.driver_position(self._known, frame))

    def _trial(self, n_frames: int) -> tuple[SeamTrial, tuple[ObservedFrame, ...]]:
        if n_frames not in self._trials:
            observed = self._model.observed.frames
            # As in production where there are such frames, laser and arc are on.
            kinds = [[f for f in observed if f.stratum == stratum] for stratum in ("both", "laser")]
            lit = kinds[0] or kinds[1]
            some = [lit[n] for n in evenly(len(lit), N_FOUND)]
            # Fewer of them are those in the middle.
            first = max(len(some) - n_frames, 0) // 2
            chosen = tuple(some[first : first + n_frames])
            trial = SeamTrial(self._known, list(map(self._scene, chosen)), self._renderer)
            self._trials[n_frames] = trial, chosen
        return self._trials[n_frames]

    def _seam_in_images(self) -> SeamObservations:
        """Return where all frames with the laser on see the fit's seam; none if the tracker never saw it."""
        every = (*self._model.observed.frames, *self._held_out.frames)
        is_seen = len(self._model.observed.seam_observations.image_px) > 0
        lit = [frame for frame in every if is_seen and frame.condition.laser_level > 0.0]
        moving = {
            name: values for name, values in self._after.effects.items() if name in TRIANGULATION_EFFECTS
        }
        there = replace(self._known, effects={**self._known.effects, **moving})
        times_s, poses = [f.timestamp_s for f in lit], [f.pose_at for f in lit]
        return seam_in_images(there, times_s, poses, self._course)

    def _scene(self, frame: ObservedFrame) -> SceneFrame:
        nuisance = self._after.nuisance
        return SceneFrame(
            self._headers[frame.index],
            frame.pose_at,
            apply_levels(frame.condition, nuisance),
            self._model.renderings.seam(frame, nuisance, self._after.effects).middle,
        )

    def _course(self, stations_mm: Float64) -> Float64:
        return np.column_stack(
            [np.interp(stations_mm, self._stations_mm, of_axis) for of_axis in self._y_z_mm]
        )


def found_effects(
    posterior: Posterior, after: Refit, random: RandomEffects, named: Sequence[str]
) -> dict[str, FoundEffect]:
    """Return the effects that are named, as fitted, and those that are probable, by their likeliest fit."""
    likely = {}
    for name, values in random.effects.items():
        every = REGISTRY[name].complete(values)
        sigma = np.nan_to_num([random.sigmas[name].get(key, 0.0) for key in every])
        likely[name] = FoundEffect(Spread(every, np.diag(sigma**2)), None, name in named)
    for fitted in (after, *(hypothesis.refit for hypothesis in posterior.hypotheses)):
        for name in fitted.ids:
            is_probable = posterior.of_each.get(name, 0.0) >= MIN_PROBABILITY
            if name not in likely and (name in named or is_probable):
                spread = Spread(fitted.effects[name], fitted.covariance_of(name))
                likely[name] = FoundEffect(spread, trend_among(fitted.trend, {name: {}}), name in named)
    return likely
