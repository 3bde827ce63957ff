"""Effects and nuisances fitted together to all frames of a recording: damped Gauss-Newton steps."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.effects import REGISTRY, Values
from noise_model.fit import Parameter, within_bounds
from sim_to_real.fit.frame_light import FrameLight
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.loss import HuberLoss, LossAbout, huber_bound, huber_weights
from sim_to_real.fit.quadratic import Quadratic
from sim_to_real.fit.renderings import RENDERED_EFFECTS
from sim_to_real.fit.trend import Trend

MAX_ITERATIONS = 8
"""Steps at most."""

MAX_RENDERINGS = 5
"""Renderings of a fit's light anew at most, until it stays."""

START_DAMPING, MIN_DAMPING, MAX_DAMPING, DAMPING_FACTOR = 1e-3, 1e-6, 1e3, 0.1
"""The damping's start and bounds, and its factor after a step that helps; else it is divided by it."""

FLICKER, LEVEL_SIGMA = "arc_flicker", 0.2
"""The effect whose realisation is fitted frame by frame, and the prior sigma of a frame's ln level."""

FRAME_LEVEL = "arc_ln_"
"""Prefix of the names of frames' own ln levels."""


@dataclass(frozen=True, eq=False)
class Refit:
    """A fit with some effects: `x` (p,) are the nuisances, followed by the effects' fitted parameters.

    At x there are the `lights` of the frames, the `residuals` (n,) without weights, their derivatives
    `jacobian` (n, p), Huber's `weights` (n,) and the `quadratic` cost of all frames. `effects` have all their
    parameters; `arc_ln` (n_frames,) are the frames' own ln levels of the arc. One effect may have a `trend`.
    """

    ids: tuple[str, ...]
    x: Float64
    n_nuisances: int
    effects: dict[str, dict[str, float]]
    arc_ln: Float64
    residuals: Float64
    jacobian: Float64
    weights: Float64
    quadratic: Quadratic
    lights: tuple[FrameLight, ...]
    trend: Trend | None = None

    @property
    def nuisance(self) -> Float64:
        """The nuisances."""
        return self.x[: self.n_nuisances]

    @property
    def blocks(self) -> Iterator[tuple[str, slice]]:
        """Yield each effect with the slice of x that holds its parameters, or the frames' levels.

        The last one's goes on to the end: a trend's amplitudes come after all effects.
        """
        for name, block in _blocks(self.ids, self.n_nuisances, len(self.arc_ln)):
            yield name, slice(block.start, len(self.x) if name == self.ids[-1] else block.stop)

    @property
    def n_lit(self) -> int:
        """The number of frames with an arc level of their own."""
        return int(np.count_nonzero(self.arc_ln))

    @cached_property
    def covariance(self) -> Float64:
        """The covariance of x (p, p), as the loss that was minimised has it."""
        prior = np.diag(1.0 / self.quadratic.prior_sigmas**2)
        return np.asarray(np.linalg.pinv(self.quadratic.information / self.quadratic.prior_weight + prior))

    @property
    def sigmas(self) -> dict[str, dict[str, float]]:
        """1 sigma of the effects' parameters, as the loss that was minimised has it."""
        sigma, sigmas = np.sqrt(np.maximum(np.diag(self.covariance), 0.0)), {}
        for name, block in _blocks(self.ids, self.n_nuisances, len(self.arc_ln)):
            if name == FLICKER:
                sigma_rel = self.effects[name]["sigma_rel"]
                sigmas[name] = {"sigma_rel": sigma_rel / math.sqrt(2.0 * max(self.n_lit - 1, 1))}
            else:
                sigmas[name] = _parameters_by_name(name, sigma[block])
        return sigmas

    def covariance_of(self, name: str) -> Float64:
        """Return the covariance of an effect's parameters (p, p), see `sigmas`."""
        if name == FLICKER:
            return np.diag(np.square(list(self.sigmas[name].values())))
        block = dict(_blocks(self.ids, self.n_nuisances, len(self.arc_ln)))[name]
        return self.covariance[block, block]

    @property
    def mean_square(self) -> float:
        """The residuals' weighted mean square."""
        return float(self.weights @ self.residuals**2) / len(self.residuals)


def refit(
    model: LinearizedModel,
    effects: Mapping[str, Values],
    nuisance: Float64,
    steps: int = MAX_ITERATIONS,
    trend: Trend | None = None,
    loss_about: LossAbout = HuberLoss.about,
) -> Refit:
    """Fit nuisances (p,) and effects' parameters to all frames, from the values given.

    The `trend` of one of the effects is fitted too. Light is rendered at the nuisances given and extrapolated
    along the tangents. If an effect must be rendered anyway, light is rendered at each step's own nuisances.
    With no `steps` the fit is that of the values given.
    """
    problem = _RenderProblem(
        model, tuple(effects), None if RENDERED_EFFECTS & set(effects) else nuisance, trend
    )
    x = problem.start(effects, nuisance)
    lights = problem.lights(x)
    r = model.residuals(lights)
    J, is_current = problem.jacobian(x, lights, r), True
    damping = START_DAMPING
    for _ in range(steps):
        loss = loss_about(r)
        quadratic = loss.quadratic(problem.parameters, x, r, J)
        cost = loss.cost(r) + quadratic.prior_cost(x)
        is_last = True
        while damping < MAX_DAMPING:
            x_new = quadratic.solve(damping=damping)
            if loss.is_converged(cost, quadratic.total(x) - quadratic.total(x_new)):
                break
            lights_new = problem.lights(x_new)
            r_new = model.residuals(lights_new)
            new = loss.cost(r_new) + quadratic.prior_cost(x_new)
            if new < cost:
                is_last = loss.is_converged(cost, cost - new)
                J = broyden_update(J, x_new - x, r_new - r)
                x, r, lights = x_new, r_new, lights_new
                damping = max(damping * DAMPING_FACTOR, MIN_DAMPING)
                break
            damping /= DAMPING_FACTOR
        if is_last and is_current:
            break
        # Derivatives that need rendering are expensive: they are updated as long as steps with them help.
        is_current = is_last or not problem.is_rendered
        if is_current:
            J, damping = problem.jacobian(x, lights, r), min(damping, START_DAMPING)
    if not is_current:
        J = problem.jacobian(x, lights, r)
    return Refit(
        ids=problem.ids,
        x=x,
        n_nuisances=len(nuisance),
        effects=problem.effects(x),
        arc_ln=problem.arc_ln(x),
        residuals=r,
        jacobian=J,
        weights=huber_weights(r, huber_bound(r)),
        quadratic=loss_about(r).quadratic(problem.parameters, x, r, J),
        lights=tuple(lights),
        trend=problem.trend_at(x),
    )


def _blocks(ids: Sequence[str], n_nuisances: int, n_frames: int) -> Iterator[tuple[str, slice]]:
    """Yield each effect with the slice of x that holds its parameters, or the frames' levels."""
    start = n_nuisances
    for name in ids:
        end = start + (n_frames if name == FLICKER else len(REGISTRY[name].parameters))
        yield name, slice(start, end)
        start = end


def _parameters_by_name(effect: str, values: Float64) -> dict[str, float]:
    names = [parameter.name for parameter in REGISTRY[effect].parameters]
    return dict(zip(names, values.tolist(), strict=True))


def refit_at(
    model: LinearizedModel,
    fitted: Refit,
    loss_about: LossAbout = HuberLoss.about,
    steps: int = MAX_ITERATIONS,
) -> Refit:
    """Return a fit of the same effects from its result, with light and derivatives rendered again."""
    there = model.anchored_at(fitted.nuisance, fitted.effects, fitted.trend)
    return refit(there, fitted.effects, fitted.nuisance, steps, fitted.trend, loss_about)


def converge(model: LinearizedModel, fitted: Refit) -> Refit:
    """Return a fit after light and tangents have been rendered again at its result, until it stays."""
    for _ in range(MAX_RENDERINGS):
        again = refit_at(model, fitted)
        # Bins are thousands: a hundredth of their mean square is tens of nats.
        if again.mean_square > 0.99 * fitted.mean_square:
            return min(again, fitted, key=lambda fit: fit.mean_square)
        fitted = again
    return fitted


def broyden_update(J: Float64, step: Float64, residual_change: Float64) -> Float64:
    """Return derivatives (n, p) after a step (p,) that changed the residuals by `residual_change` (n,).

    Broyden's update (1965, Math. Comp. 19, 577), with parameters scaled so that all move the residuals
    equally.
    """
    size = np.linalg.norm(J, axis=0)
    weight = np.where(size > 0.0, size, 1.0) ** 2 * step
    length = float(step @ weight)
    return J + np.outer(residual_change - J @ step, weight / length) if length > 0.0 else J


@dataclass(frozen=True)
class _RenderProblem:
    model: LinearizedModel
    ids: tuple[str, ...]
    anchor: Float64 | None
    trend: Trend | None

    @property
    def is_rendered(self) -> bool:
        return bool(RENDERED_EFFECTS & set(self.ids))

    @property
    def n_frames(self) -> int:
        return len(self.model.observed.frames)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        of_effects = (p for name in self.ids for p in self._fitted_of(name))
        of_trend = () if self.trend is None else self.trend.parameters
        return (*self.model.nuisances, *of_effects, *of_trend)

    @property
    def blocks(self) -> Iterator[tuple[str, slice]]:
        return _blocks(self.ids, len(self.model.nuisances), self.n_frames)

    def _fitted_of(self, name: str) -> tuple[Parameter, ...]:
        """Return an effect's fitted parameters, with priors at the values that the setup states.

        Those of the arc's flicker are the frames' levels.
        """
        if name != FLICKER:
            stated = self.model.stated_values(name)
            return tuple(
                replace(parameter, start=stated[parameter.name]) for parameter in REGISTRY[name].parameters
            )
        return tuple(
            Parameter(f"{FRAME_LEVEL}{frame.position}", "", 0.0, LEVEL_SIGMA, -3.0, 3.0, 1e-3)
            for frame in self.model.observed.frames
        )

    def start(self, effects: Mapping[str, Values], nuisance: Float64) -> Float64:
        values = [
            np.zeros(self.n_frames)
            if name == FLICKER
            else list(REGISTRY[name].complete(effect_values).values())
            for name, effect_values in effects.items()
        ]
        of_trend = () if self.trend is None else self.trend.amplitude
        return within_bounds(self.parameters, np.concatenate([nuisance, *values, of_trend]))

    def effects(self, x: Float64) -> dict[str, dict[str, float]]:
        return {
            name: (
                {"sigma_rel": flicker_sigma(self.model, self.arc_ln(x))}
                if name == FLICKER
                else _parameters_by_name(name, x[block])
            )
            for name, block in self.blocks
        }

    def trend_at(self, x: Float64) -> Trend | None:
        """Return the trend at parameters (p,)."""
        if self.trend is None:
            return None
        # Its amplitudes end the parameters.
        return replace(self.trend, amplitude=tuple(x[-len(self.trend.amplitude) :].tolist()))

    def arc_ln(self, x: Float64) -> Float64:
        """Return the arc's ln level of each frame (n_frames,), about their mean."""
        levels = next((x[block] for name, block in self.blocks if name == FLICKER), None)
        return np.zeros(self.n_frames) if levels is None else mean_removal(self.model) @ levels

    def lights(self, x: Float64) -> list[FrameLight]:
        """Return the light at parameters (p,), rendered at the anchor and extrapolated from there."""
        m = len(self.model.nuisances)
        anchor = x[:m] if self.anchor is None else self.anchor
        lights = self.model.lights(anchor, self.effects(x), self.trend_at(x))
        by = np.tile(x[:m] - anchor, (len(lights), 1))
        by[:, 0] += self.arc_ln(x)
        frames = self.model.observed.frames
        return [self.model.extrapolate(*parts) for parts in zip(frames, lights, by, strict=True)]

    def jacobian(self, x: Float64, lights: list[FrameLight], r: Float64) -> Float64:
        """Return the derivatives (n, p) of the residuals r (n,) at x (p,)."""
        columns = [self.model.nuisance_columns(lights)]
        for name, block in self.blocks:
            if name == FLICKER:
                columns.append(frame_level_columns(self.model, columns[0][:, 0]))
            else:
                columns += [self._column(x, r, i) for i in range(block.start, block.stop)]
        if self.trend is not None:
            u, block = self.trend.driver_positions(self.model.observed), dict(self.blocks)[self.trend.effect]
            columns.append(u[:, np.newaxis] * np.hstack(columns)[:, block])
        return np.hstack(columns)

    def _column(self, x: Float64, r: Float64, i: int) -> Float64:
        parameter, moved = self.parameters[i], x.copy()
        moved[i] += -parameter.step if x[i] + parameter.step > parameter.upper else parameter.step
        change = self.model.residuals(self.lights(moved)) - r
        return np.asarray(change[:, np.newaxis] / (moved[i] - x[i]))


def mean_removal(model: LinearizedModel) -> Float64:
    """Return the matrix (f, f) that subtracts the mean of lit frames from them, and sets the others to 0.

    A level that all frames share is no flicker: it is a nuisance, known within its tolerance.
    """
    lit = model.observed.lit
    return np.diag(lit.astype(np.float64)) - np.outer(lit, lit) / max(int(lit.sum()), 1)


def frame_level_columns(model: LinearizedModel, by_level: Float64) -> Float64:
    """Return derivatives (n, f) with frames' own ln levels; `by_level` (n,) are those with all at once."""
    counts = model.observed.counts
    frame = np.repeat(np.arange(len(counts)), counts)[:, np.newaxis]
    return np.where(frame == np.arange(len(counts)), by_level[:, np.newaxis], 0.0) @ mean_removal(model)


def flicker_sigma(model: LinearizedModel, arc_ln: Float64) -> float:
    """Return the relative standard deviation of the arc's output in the frames that show it."""
    lit = model.observed.lit
    upper = REGISTRY[FLICKER].parameters[0].upper
    return min(float(np.std(np.exp(arc_ln[lit]))), upper) if lit.any() else 0.0
