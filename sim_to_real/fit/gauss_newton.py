"""Effects and nuisances fitted together to all frames of a recording: Gauss, Newton, Levenberg, Marquardt."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from noise_model.arrays import Float64
from noise_model.effects import REGISTRY, Values
from noise_model.fit import Parameter, within_bounds
from sim_to_real.fit.linearized_model import RENDERING, Expected, Passed
from sim_to_real.fit.quadratic import Quadratic
from sim_to_real.fit.trend import Change, change_among

HUBER = 3.0
"""Residuals beyond so many of their own robust sigmas pull no harder."""

MAD_SIGMA = 1.4826
"""A normal distribution's sigma over its median absolute deviation."""

NAMED_FROM = 3.0
"""Evidence, nats, by which effects must beat their absence."""

ITERATIONS = 8
"""Steps at most."""

SETTLED = 1e-3
"""A step that lowers the cost by a smaller share is the last."""

DAMPING, LEAST_DAMPING, DAMPED_MOST, EASED = 1e-3, 1e-9, 1e3, 0.1
"""Where damping starts, its ends, and by what it changes with a step that helps or does not."""

ROUNDS, WORTHWHILE = 3, 0.1
"""Light is rendered anew about a fit so often at most, while the mean square falls by this share."""

FLICKER, LEVEL_SIGMA = "arc_flicker", 0.2
"""The effect whose realisation is fitted, frame by frame, and the prior of a frame's ln level."""

OWN_LEVEL = "arc_ln_"
"""What the names of frames' own ln levels begin with."""


@dataclass(frozen=True, eq=False)
class Refit:
    """A fit with some effects: `x` (p,) nuisances and behind them what is fitted of the effects.

    `passed` is the light of each frame there, `residuals` (n,) plain, their derivatives (n, p), Huber's
    `weights` (n,), and the `quadratic` cost of all frames about x. `effects` have all their parameters;
    `arc_ln` (n_frames,) are the frames' own ln levels of the arc. An effect may `change` from frame to frame.
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
    passed: tuple[Passed, ...]
    change: Change | None = None

    @property
    def nuisance(self) -> Float64:
        """The nuisances."""
        return self.x[: self.n_nuisances]

    @property
    def n_parameters(self) -> int:
        """How many numbers are fitted beside the nuisances: of frames' levels those about their mean."""
        unlit = len(self.arc_ln) - max(self.n_lit - 1, 1) if FLICKER in self.ids else 0
        return len(self.x) - self.n_nuisances - unlit

    @property
    def n_lit(self) -> int:
        """How many frames have a level of the arc of their own."""
        return int(np.count_nonzero(self.arc_ln))

    @property
    def sigmas(self) -> dict[str, dict[str, float]]:
        """The effects' parameters' 1 sigma, the residuals' own spread taken for that of the noise.

        As if `quadratic.N_EFFECTIVE` of the residuals were independent: neighbours share the model's error.
        """
        prior = np.diag([1.0 / parameter.prior_sigma**2 for parameter in self.quadratic.parameters])
        information = self.quadratic.information.sum(axis=0) / self.quadratic.prior_weight
        covariance = np.linalg.pinv(information + prior)
        sigma, found = np.sqrt(np.maximum(np.diag(covariance), 0.0)), {}
        for name, at in _blocks(self.ids, self.n_nuisances, len(self.arc_ln)):
            if name == FLICKER:
                sigma_rel = self.effects[name]["sigma_rel"]
                found[name] = {"sigma_rel": sigma_rel / math.sqrt(2.0 * max(self.n_lit - 1, 1))}
            else:
                found[name] = _by_name(name, sigma[at])
        return found

    def at(self, x: Float64) -> tuple[Float64, dict[str, dict[str, float]], Change | None]:
        """Return nuisances, effects and their change at other parameters (p,); frames' own levels stay."""
        effects = {
            name: self.effects[name] if name == FLICKER else _by_name(name, x[at])
            for name, at in _blocks(self.ids, self.n_nuisances, len(self.arc_ln))
        }
        return x[: self.n_nuisances], effects, _change_at(self.change, x)

    @property
    def mean_square(self) -> float:
        """The residuals' weighted mean square."""
        return self.quadratic.mean_square(self.x)


def refit(
    expected: Expected,
    effects: Mapping[str, Values],
    nuisance: Float64,
    steps: int = ITERATIONS,
    change: Change | None = None,
) -> Refit:
    """Fit nuisances (p,) and parameters of effects to all frames, from where they start.

    One of the effects may `change` from frame to frame, by what is fitted too.
    Light is rendered at the nuisances given and continued along the tangents; if an effect makes it be
    rendered at every step anyway, at each step's own. With no `steps` it says what is left where it starts.
    """
    problem = _Problem(expected, tuple(effects), None if RENDERING & set(effects) else nuisance, change)
    x = problem.start(effects, nuisance)
    passed = problem.passed(x)
    r = expected.residuals(passed)
    J, is_taken = problem.jacobian(x, passed, r), True
    damping = DAMPING
    for _ in range(steps):
        bound = huber_bound(r)
        quadratic = problem.quadratic(x, r, J, bound)
        weight = quadratic.prior_weight
        cost = problem.cost(x, r, bound, weight)
        gained = 0.0
        while damping < DAMPED_MOST:
            x_new = quadratic.solve(damping=damping)
            passed_new = problem.passed(x_new)
            r_new = expected.residuals(passed_new)
            new = problem.cost(x_new, r_new, bound, weight)
            if new < cost:
                gained = (cost - new) / cost
                J = followed(J, x_new - x, r_new - r)
                x, r, passed = x_new, r_new, passed_new
                damping = max(damping * EASED, LEAST_DAMPING)
                break
            damping /= EASED
        if gained < SETTLED and is_taken:
            break
        # Derivatives of what is rendered anew are dear: they are followed as long as they lead on.
        is_taken = gained < SETTLED or not problem.is_rendered
        if is_taken:
            J, damping = problem.jacobian(x, passed, r), min(damping, DAMPING)
    if not is_taken:
        J = problem.jacobian(x, passed, r)
    bound = huber_bound(r)
    return Refit(
        problem.ids,
        x,
        len(nuisance),
        problem.effects(x),
        problem.arc_ln(x),
        r,
        J,
        huber_weights(r, bound),
        problem.quadratic(x, r, J, bound),
        tuple(passed),
        problem.change_at(x),
    )


def refit_from(expected: Expected, fitted: Refit, effects: Mapping[str, Values]) -> Refit:
    """Fit effects from a fit's nuisances; one that changes there goes on changing if it is among them."""
    return refit(expected, effects, fitted.nuisance, change=change_among(fitted.change, effects))


def _blocks(ids: Sequence[str], n_nuisances: int, n_frames: int) -> Iterator[tuple[str, slice]]:
    """Yield each effect with where in x stands what is fitted of it: its parameters, or frames' levels."""
    start = n_nuisances
    for name in ids:
        end = start + (n_frames if name == FLICKER else len(REGISTRY[name].parameters))
        yield name, slice(start, end)
        start = end


def _change_at(change: Change | None, x: Float64) -> Change | None:
    """Return a change by what stands for it at the end of parameters (p,)."""
    return None if change is None else replace(change, by=tuple(x[-len(change.by) :].tolist()))


def _by_name(effect: str, values: Float64) -> dict[str, float]:
    names = [parameter.name for parameter in REGISTRY[effect].parameters]
    return dict(zip(names, values.tolist(), strict=True))


def settled(expected: Expected, fitted: Refit) -> Refit:
    """Return a fit done again with light rendered, and its derivatives taken, where it came to."""
    for _ in range(ROUNDS):
        expected.take_tangents(fitted.nuisance, fitted.effects, fitted.change)
        again = refit(expected, fitted.effects, fitted.nuisance, change=fitted.change)
        if again.mean_square > (1.0 - WORTHWHILE) * fitted.mean_square:
            return min(again, fitted, key=lambda fit: fit.mean_square)
        fitted = again
    return fitted


def followed(J: Float64, step: Float64, change: Float64) -> Float64:
    """Return derivatives (n, p) after a step (p,) that changed the residuals by `change` (n,).

    Broyden's update (1965, Math. Comp. 19, 577), parameters counted in what moves the residuals alike.
    """
    size = np.linalg.norm(J, axis=0)
    weight = np.where(size > 0.0, size, 1.0) ** 2 * step
    length = float(step @ weight)
    return J + np.outer(change - J @ step, weight / length) if length > 0.0 else J


def huber_bound(r: Float64) -> float:
    """Return Huber's bound for residuals (n,): it goes with their own spread."""
    return HUBER * max(1.0, MAD_SIGMA * float(np.median(np.abs(r))))


def huber_weights(r: Float64, bound: float) -> Float64:
    """Return Huber's weights (n,)."""
    return np.asarray(np.minimum(1.0, bound / np.maximum(np.abs(r), bound)))


@dataclass(frozen=True)
class _Problem:
    expected: Expected
    ids: tuple[str, ...]
    anchor: Float64 | None
    change: Change | None

    @property
    def is_rendered(self) -> bool:
        return bool(RENDERING & set(self.ids))

    @property
    def n_frames(self) -> int:
        return len(self.expected.observed.frames)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        of_effects = (p for name in self.ids for p in self._fitted_of(name))
        of_change = () if self.change is None else self.change.parameters
        return (*self.expected.nuisances, *of_effects, *of_change)

    @property
    def blocks(self) -> Iterator[tuple[str, slice]]:
        return _blocks(self.ids, len(self.expected.nuisances), self.n_frames)

    def _fitted_of(self, name: str) -> tuple[Parameter, ...]:
        """Return what is fitted of an effect: its parameters, but of the arc's flicker each frame's level.

        They are expected where the setup states them.
        """
        if name != FLICKER:
            stated = self.expected.stated(name)
            return tuple(replace(of, start=stated[of.name]) for of in REGISTRY[name].parameters)
        return tuple(
            Parameter(f"{OWN_LEVEL}{frame.position}", "", 0.0, LEVEL_SIGMA, -3.0, 3.0, 1e-3)
            for frame in self.expected.observed.frames
        )

    def start(self, effects: Mapping[str, Values], nuisance: Float64) -> Float64:
        values = [
            np.zeros(self.n_frames) if name == FLICKER else list(REGISTRY[name].complete(of).values())
            for name, of in effects.items()
        ]
        of_change = () if self.change is None else self.change.by
        return within_bounds(self.parameters, np.concatenate([nuisance, *values, of_change]))

    def effects(self, x: Float64) -> dict[str, dict[str, float]]:
        return {
            name: (
                {"sigma_rel": flicker(self.expected, self.arc_ln(x))}
                if name == FLICKER
                else _by_name(name, x[at])
            )
            for name, at in self.blocks
        }

    def change_at(self, x: Float64) -> Change | None:
        """Return by how much an effect changes at parameters (p,)."""
        return _change_at(self.change, x)

    def arc_ln(self, x: Float64) -> Float64:
        """Return the arc's ln level of each frame (n_frames,), about their mean."""
        levels = next((x[at] for name, at in self.blocks if name == FLICKER), None)
        return np.zeros(self.n_frames) if levels is None else about_mean(self.expected) @ levels

    def passed(self, x: Float64) -> list[Passed]:
        """Return the light at parameters (p,): rendered at the anchor, moved on from there."""
        m = len(self.expected.nuisances)
        anchor = x[:m] if self.anchor is None else self.anchor
        passed = self.expected.passed(anchor, self.effects(x), self.change_at(x))
        by = np.tile(x[:m] - anchor, (len(passed), 1))
        by[:, 0] += self.arc_ln(x)
        frames = self.expected.observed.frames
        return [self.expected.moved(*of) for of in zip(frames, passed, by, strict=True)]

    def jacobian(self, x: Float64, passed: list[Passed], r: Float64) -> Float64:
        """Return the derivatives (n, p) of the residuals r (n,) at x (p,)."""
        columns = [self.expected.nuisance_columns(passed)]
        for name, at in self.blocks:
            if name == FLICKER:
                columns.append(own_levels(self.expected, columns[0][:, 0]))
            else:
                columns += [self._column(x, r, i) for i in range(at.start, at.stop)]
        if self.change is not None:
            u, at = self.change.shares(self.expected.observed), dict(self.blocks)[self.change.effect]
            columns.append(u[:, np.newaxis] * np.hstack(columns)[:, at])
        return np.hstack(columns)

    def _column(self, x: Float64, r: Float64, i: int) -> Float64:
        parameter, moved = self.parameters[i], x.copy()
        moved[i] += -parameter.step if x[i] + parameter.step > parameter.upper else parameter.step
        change = self.expected.residuals(self.passed(moved)) - r
        return np.asarray(change[:, np.newaxis] / (moved[i] - x[i]))

    def quadratic(self, x: Float64, r: Float64, J: Float64, bound: float) -> Quadratic:
        """Return the cost about x."""
        return Quadratic.of(self.parameters, x, r, J, huber_weights(r, bound), self.expected.observed.counts)

    def cost(self, x: Float64, r: Float64, bound: float, prior_weight: float) -> float:
        """Return Huber's loss of residuals (n,) and the priors' pulls."""
        size = np.abs(r)
        of_data = np.sum(np.where(size > bound, 2.0 * bound * size - bound**2, size**2))
        starts = np.array([p.start for p in self.parameters])
        sigmas = np.array([p.prior_sigma for p in self.parameters])
        return float(of_data + prior_weight * np.sum(((x - starts) / sigmas) ** 2))


def about_mean(expected: Expected) -> Float64:
    """Return the matrix (f, f) that takes the mean off frames that the arc lights, and all off the others.

    A level that all frames share is no flicker but a nuisance, and known within its tolerance.
    """
    lit = expected.observed.lit
    return np.diag(lit.astype(np.float64)) - np.outer(lit, lit) / max(int(lit.sum()), 1)


def own_levels(expected: Expected, by_level: Float64) -> Float64:
    """Return derivatives (n, f) by frames' own ln levels of the arc; those by all at once are (n,)."""
    counts = expected.observed.counts
    frame = np.repeat(np.arange(len(counts)), counts)[:, np.newaxis]
    return np.where(frame == np.arange(len(counts)), by_level[:, np.newaxis], 0.0) @ about_mean(expected)


def flicker(expected: Expected, arc_ln: Float64) -> float:
    """Return the relative standard deviation of the arc's output in the frames that show it."""
    lit = expected.observed.lit
    most = REGISTRY[FLICKER].parameters[0].upper
    return min(float(np.std(np.exp(arc_ln[lit]))), most) if lit.any() else 0.0
