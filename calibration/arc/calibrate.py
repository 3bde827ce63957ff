"""Radius, position and brightness of the arc, and its metal's reflectance, from the arc's light alone.

The estimate is the maximum a posteriori of `ArcProblem`: the camera within its tolerance, the part where
stripes place it, smooth fields of brightness, a level for each frame and a black level are fitted together.
Texture of the metal and the arc's flicker are estimated from the residuals, so the sigmas include them. A
parameter with too wide a sigma is refused: its stated value stays, with the stated tolerance, and all others
are fitted again.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import stdtrit

from calibration.arc.problem import (
    ARC,
    BROAD,
    C2,
    RADIANCE,
    RADIUS,
    RATIO,
    STATED,
    ArcProblem,
    PartPlacement,
    X,
    Y,
    Z,
)
from calibration.threads import one_thread
from noise_model.compiled.arrays import Float64
from noise_model.even_sample import evenly
from noise_model.fit import Fit, fit
from noise_model.setup import Setup
from tracker.arc.level import HUBER
from tracker.state import Frame

MAX_FRAMES = 24
"""Largest number of frames compared; of more every n-th."""

MIN_PIXELS = 100
"""Least number of pixels over all frames."""

FIRST_FLICKER, MIN_FLICKER = 0.1, 0.001
"""1 sigma of a frame's level that the rounds begin with, and of one frame alone; and that is no less."""

LIMITS: Mapping[str, float] = {RADIUS: 0.1, X: 0.3, Y: 0.3, Z: 0.2, RADIANCE: 0.3, RATIO: 0.2, C2: 0.15}
"""With a wider sigma, relative or mm, a value is refused: the setup's own is as good."""

MAX_LEVEL_FACTOR = 50.0
"""Ratio of the arc's brightness to the stated one, either way, at which something else is wrong."""

KEYS_OF: Mapping[str, tuple[str, ...]] = {
    RADIUS: ("radius_mm",),
    X: ("center_x_mm",),
    Y: ("center_y_mm",),
    Z: ("center_z_mm",),
    RADIANCE: ("radiance_e",),
    RATIO: ("kappa_diff", "kappa_spec"),
    C2: ("c2",),
}
"""The setup's values that each parameter of `ARC` sets."""

KEYS = tuple(key for keys in KEYS_OF.values() for key in keys)
"""All of them, in the order of `ArcCalibration.covariance`."""


@dataclass(frozen=True, eq=False)
class Combination:
    """A poorly determined combination of parameters: its parts by name, and its sigma over the limit.

    `parts` are those of a unit vector in the parameters over their limits.
    """

    parts: Mapping[str, float]
    sigma: float


@dataclass(frozen=True, eq=False)
class ArcCalibration:
    """Arc and metal as calibrated from frames.

    `values`, `sigmas` (8,) and `covariance` (8, 8) are of `KEYS`; a refused parameter stays within its stated
    tolerance. The kappas' sum is held, so their sigmas are those of their ratio. `refused` maps parameters of
    `ARC` that the frames do not determine to their sigma, relative or mm; `combinations` are those that
    cannot be separated, the least known first. `pixel_sigma` and `flicker` are 1 sigma of texture and
    flicker, relative.
    """

    setup: Setup
    values: Float64
    covariance: Float64
    fit: Fit
    refused: Mapping[str, float]
    combinations: tuple[Combination, ...]
    pixel_sigma: float
    flicker: float
    problem: ArcProblem

    @property
    def sigmas(self) -> Float64:
        """1 sigma (8,) of the values."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def held_keys(self) -> tuple[str, ...]:
        """The `KEYS` that keep their stated values."""
        return tuple(key for name in self.refused for key in KEYS_OF[name])

    @property
    def residuals(self) -> Float64:
        """The charge over the fit less 1 (n,), of all pixels."""
        x, problem = self.fit.values, self.problem
        light_e = problem.light(problem.named(x))
        mean_e = problem.mean_e(x, light_e)
        return np.asarray((problem.charge_e - mean_e) / (mean_e - x[problem.names.index("black")]))


@one_thread()
def calibrate_arc(
    setup: Setup,
    frames: Sequence[tuple[Frame, Float64]],
    part: PartPlacement | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ArcCalibration:
    """Calibrate arc and metal from frames with the arc on and the laser off, each with T_base_tool (4, 4).

    `part` is the part's placement by stripes; without it, the part lies within the usual tolerance of its
    nominal place. `progress` is called with the rounds done and their number. Raises ValueError if the setup
    states no arc or no metal, if nothing can be compared, and if the arc's brightness is off by
    MAX_LEVEL_FACTOR.
    """
    setup.require("the arc's calibration", "arc", "material")
    if setup.material.kappa_diff == 0.0 or setup.material.kappa_spec == 0.0:
        raise ValueError("[material] kappa_diff, kappa_spec: both must be above 0 for a start")
    chosen = [frames[n] for n in evenly(len(frames), MAX_FRAMES)]
    known = PartPlacement.without_stripes(setup, 0.0) if part is None else part
    # The rounds begin with a texture of 2 %.
    problem = ArcProblem.of(setup, chosen, known, 0.02, FIRST_FLICKER)
    if sum(len(lattice.charge_e) for lattice in problem.frames) < MIN_PIXELS:
        raise ValueError(
            "no pixel with the arc's light is below saturation and off the joint's edges: shorten the "
            "exposure"
        )
    problem, result = _fit_in_rounds(problem, _start(problem), progress)
    covariance = _covariance(problem, result)
    problem = _hold_undetermined(problem, covariance)
    if problem.held:
        problem, result = _fit_in_rounds(problem, result.values, progress)
    refused = {name: math.sqrt(covariance[ARC.index(name), ARC.index(name)]) for name in problem.held}
    return _calibration(problem, result, refused, _combinations(covariance))


def _covariance(problem: ArcProblem, result: Fit) -> Float64:
    """Return that of `ARC` (7, 7), at the fit or at the stated values, whichever has less information.

    A poorly determined parameter may come out where it seems to be well determined.
    """
    x = np.zeros(len(problem.names))
    x[ARC.index(RADIANCE)] = result.values[ARC.index(RADIANCE)]
    x[len(ARC) :] = result.values[len(ARC) :]
    J = problem.derivatives(x, problem.sigma_e(x, problem.light(problem.named(x))))
    priors = np.array([parameter.prior_sigma for parameter in problem.parameters])
    stated = np.linalg.inv(J.T @ J + np.diag(priors**-2.0))[: len(ARC), : len(ARC)]
    fitted = np.asarray(result.covariance[: len(ARC), : len(ARC)])
    limits = np.array([LIMITS[name] for name in ARC])
    is_less = float((np.diag(stated) / limits**2).sum()) > float((np.diag(fitted) / limits**2).sum())
    return np.asarray(stated) if is_less else fitted


def _start(problem: ArcProblem) -> Float64:
    """Return the start (p,): stated values, and the radiance of the frames."""
    x = np.zeros(len(problem.names))
    x[len(ARC) : len(ARC) + 10] = problem.part.values
    light_e = problem.light(problem.named(x))
    factor = float(problem.charge_e.sum() / max(float(light_e.sum()), 1e-9))
    if not 1.0 / MAX_LEVEL_FACTOR < factor < MAX_LEVEL_FACTOR:
        raise ValueError(
            f"the arc's light is {factor:.2g} times the stated one: do [arc] radiance_e, [camera] exposure_s "
            "and the frames' current_a hold?"
        )
    x[ARC.index(RADIANCE)] = math.log(factor)
    return x


def _fit_in_rounds(
    problem: ArcProblem, x: Float64, progress: Callable[[int, int], None]
) -> tuple[ArcProblem, Fit]:
    """Fit, and estimate texture and flicker from what is left, in turn."""
    # Each round has the texture and the flicker that the one before left.
    n_rounds = 3
    for done in range(n_rounds):
        progress(done, n_rounds)
        sigma_e = problem.sigma_e(x, problem.light(problem.named(x)))
        result = fit(
            problem.parameters,
            partial(problem.residuals, sigma_e=sigma_e),
            HUBER,
            start=x,
            derivatives=partial(problem.derivatives, sigma_e=sigma_e),
            min_gain_rel=1e-4,
        )
        x = result.values
        if done < n_rounds - 1:
            problem = _estimate_texture_and_flicker(problem, result, sigma_e)
    progress(n_rounds, n_rounds)
    return problem, result


def _hold_undetermined(problem: ArcProblem, covariance: Float64) -> ArcProblem:
    """Return the problem with undetermined parameters held at their stated values, the worst first.

    A held parameter has the stated tolerance as its prior: (C^-1 + h h^T (1/s^2 - 1/b^2))^-1. What was too
    uncertain only together with it is then known.
    """
    covariance = covariance.copy()
    limits = np.array([LIMITS[name] for name in ARC])
    held: list[str] = []
    while True:
        over = np.sqrt(np.diag(covariance)) / limits
        # Radiance is told wherever there is light, once what it goes with is held.
        over[[ARC.index(name) for name in (*held, RADIANCE)]] = 0.0
        worst = int(np.argmax(over))
        if over[worst] < 1.0:
            return replace(problem, held=tuple(held))
        name = ARC[worst]
        held.append(name)
        more = 1.0 / STATED[name] ** 2 - 1.0 / BROAD[name] ** 2
        column = covariance[:, worst]
        covariance -= np.outer(column, column) / (1.0 / more + covariance[worst, worst])


def _estimate_texture_and_flicker(problem: ArcProblem, result: Fit, sigma_e: Float64) -> ArcProblem:
    """Return the problem with the texture and the flicker that a fit leaves."""
    x, n_frames = result.values, len(problem.frames)
    light_e = problem.light(problem.named(x))
    n_pixels = len(light_e)
    # Pixels farther off are no texture.
    known = np.abs(result.residuals[:n_pixels]) < 4.0
    off_e2 = (result.residuals[:n_pixels] * sigma_e)[known] ** 2
    off_e2 /= np.maximum(1.0 - result.leverage[:n_pixels][known], 0.1)

    def minus_ln_likelihood(ln_sigma: float) -> float:
        variance_e2 = replace(problem, pixel_sigma=math.exp(ln_sigma)).sigma_e(x, light_e)[known] ** 2
        return float(np.sum(np.log(variance_e2) + off_e2 / variance_e2))

    # On an independent renderer's frames the model is off by 0.5 %, neighbours by the same: 1 % at least.
    bounds = math.log(0.01), math.log(0.3)
    pixel_sigma = math.exp(minimize_scalar(minus_ln_likelihood, bounds=bounds, method="bounded").x)
    flicker = FIRST_FLICKER
    if n_frames > 1:
        levels = x[-n_frames:]
        # Few frames tell their scatter badly: Student's quantile over the normal one makes up for it.
        wider = float(stdtrit(n_frames - 1, 0.975)) / 1.96
        flicker = max(wider * float(np.std(levels, ddof=1)), MIN_FLICKER)
    return replace(problem, pixel_sigma=pixel_sigma, flicker=flicker)


def _combinations(covariance: Float64) -> tuple[Combination, ...]:
    """Return the directions of `ARC` whose sigma is wider than the limits."""
    limits = np.array([LIMITS[name] for name in ARC])
    values, vectors = np.linalg.eigh(covariance / np.outer(limits, limits))
    weak = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value < 1.0:
            break
        vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
        # A parameter belongs to a combination with 0.35 or more of the unit vector.
        parts = {name: float(v) for name, v in zip(ARC, vector, strict=True) if abs(v) > 0.35}
        weak.append(Combination(parts, math.sqrt(value)))
    return tuple(weak)


def _calibration(
    problem: ArcProblem, result: Fit, refused: Mapping[str, float], combinations: tuple[Combination, ...]
) -> ArcCalibration:
    held = [ARC.index(name) for name in problem.held]
    values, C = result.values, result.covariance
    if held:
        # The others' means where what is held has its stated value.
        values = values - C[:, held] @ np.linalg.solve(C[np.ix_(held, held)], values[held])
    result = replace(result, values=values)
    x = problem.named(values)
    # The camera's pose is a calibration of its own, and stays.
    stated = replace(problem.setup_at(x), camera=problem.setup.camera)
    radiance_e = problem.setup.arc.radiance_e * math.exp(x[RADIANCE])
    setup = replace(stated, arc=replace(stated.arc, radiance_e=radiance_e))
    arc, metal = setup.arc, setup.material
    numbers = np.array(
        [arc.radius_mm, *arc.center_in_tool_mm, radiance_e, metal.kappa_diff, metal.kappa_spec, metal.c2]
    )
    # Both kappas go with their ratio: d kappa_spec = -d kappa_diff = kappa_diff kappa_spec / sum d ln ratio.
    slope = metal.kappa_diff * metal.kappa_spec / (metal.kappa_diff + metal.kappa_spec)
    J = np.zeros((len(KEYS), len(ARC)))
    J[0, ARC.index(RADIUS)] = arc.radius_mm
    for row, name in enumerate((X, Y, Z), start=1):
        J[row, ARC.index(name)] = 1.0
    J[4, ARC.index(RADIANCE)] = radiance_e
    J[5, ARC.index(RATIO)], J[6, ARC.index(RATIO)] = -slope, slope
    J[7, ARC.index(C2)] = metal.c2
    covariance = J @ result.covariance[: len(ARC), : len(ARC)] @ J.T
    return ArcCalibration(
        setup=setup,
        values=numbers,
        covariance=covariance,
        fit=result,
        refused=refused,
        combinations=combinations,
        pixel_sigma=problem.pixel_sigma,
        flicker=problem.flicker,
        problem=problem,
    )
