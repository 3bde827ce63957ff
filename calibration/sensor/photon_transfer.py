"""Gain, noise, response and pattern of a sensor by maximum likelihood from levels of even light.

EMVA Standard 1288 draws a line through variance over mean. With a gamma there is no line, and gain, gamma and
full well share what means and variances say. So all is one likelihood, of

- each level's mean over pixels and frames, normal;
- each level's variance from frame to frame, normal with the codes' own fourth moment;
- the covariance of the levels' mean frames over the pixels, Wishart's: Sigma_st = pattern_st + delta_st
  variance_s / frames_s.

A level's charge is free, with the prior that its logarithm is that of the exposure times one brightness, up
to the linearity error tau: exposures and lights are never exact, and means of 10^5 pixels would decide alone.
tau^2 is the restricted maximum likelihood's, tau^2 = sum_s u_s^2 / (S - sum_s var(u_s) / tau^2), u_s the
levels' departures. The maximum is found by Fisher's scoring, whose information gives the sigmas.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln
from scipy.stats import chi2 as chi2_distribution

from calibration.sensor.levels import LevelStatistics
from calibration.sensor.response_model import Pattern, ResponsePrediction, predict
from noise_model.compiled.arrays import Bool, Float64
from noise_model.instrument.sensor import Sensor

NAMES = ("black_level_dn", "ln_gain", "gamma", "read_noise_e2", "dark_e2", "response_rel2")
"""The shared parameters, in their order; behind them come the logarithms of the lit levels' charges."""

MAX_ROUNDS, SETTLED_SIGMAS = 60, 1e-3
"""Rounds of scoring, and the step, in sigmas, that ends them."""

LOOSER = 1.05
"""Factor by which tau^2 is changed to find its derivatives."""


@dataclass(frozen=True, eq=False)
class PhotonTransferFit:
    """The maximum: parameters (p,) in the order of `NAMES` and levels, their covariance (p, p) and
    Student's degrees of freedom (p,).

    `linearity_rel` is tau, `linearity_freedom` the levels that it rests on. `chi2` is that of means and
    variances per degree of freedom, `p_value` its probability. `predicted` is what the levels should read.
    """

    sensor: Sensor
    values: Float64
    covariance: Float64
    freedoms: Float64
    charge_e: Float64
    predicted: ResponsePrediction
    linearity_rel: float
    linearity_freedom: float
    departures: Float64
    chi2: float
    p_value: float
    is_settled: bool


@dataclass(frozen=True, eq=False)
class PhotonTransferProblem:
    """Statistics of levels, the code of saturation, and a gamma that is held, None if it is fitted."""

    levels: LevelStatistics
    bits: int
    top_dn: float
    gamma: float | None

    @property
    def lit(self) -> Bool:
        """Lit levels (s,)."""
        return self.levels.is_lit

    def sensor_at(self, x: Float64) -> Sensor:
        """Return the sensor that parameters (p,) say."""
        gain = math.exp(x[1])
        return Sensor(
            self.bits,
            gain,
            float(x[0]),
            math.sqrt(max(x[3], 0.0)),
            gain * (self.top_dn - float(x[0])),
            float(x[2]),
        )

    def predict_at(self, x: Float64) -> ResponsePrediction:
        """Return the levels' predicted readings at parameters (p,)."""
        levels = self.levels
        pattern = Pattern(float(x[4]), float(x[5]), levels.shading_rel)
        return predict(self.charges_at(x), levels.n_frames, pattern, self.sensor_at(x))

    def charges_at(self, x: Float64) -> Float64:
        """Return the levels' mean charges (s,), e-."""
        charge = np.zeros(len(self.lit))
        charge[self.lit] = np.exp(x[len(NAMES) :])
        return charge

    def start(self) -> Float64:
        """Return starting parameters (p,): the gamma under which shot noise fits charges best."""
        levels, dark = self.levels, ~self.lit
        black = float(np.average(levels.mean_dn[dark], weights=levels.n_frames[dark]))
        share = np.maximum(levels.mean_dn[self.lit] - black, 1e-3) / (self.top_dn - black)
        noise = np.maximum(levels.variance_dn2[self.lit] - 1.0 / 12.0, 1e-3)
        gammas = np.geomspace(0.3, 2.0, 39) if self.gamma is None else np.array([self.gamma])
        best, chosen = math.inf, (1.0, 0.0)
        for gamma in gammas:
            ln_shot = np.log(gamma**2 * (share * (self.top_dn - black)) ** 2 / noise)
            ln_share = np.log(share) / gamma
            # Read noise is a small part of the brighter half's.
            ln_well = (ln_shot - ln_share)[len(share) // 2 :]
            misfit = float(np.var(ln_well) + np.var(ln_share - np.log(levels.exposure_s[self.lit])))
            if misfit < best:
                best, chosen = misfit, (float(gamma), float(np.median(ln_well)))
        gamma, ln_well = chosen
        ln_gain = ln_well - math.log(self.top_dn - black)
        dark_dn2 = max(float(np.mean(levels.variance_dn2[dark])) - 1.0 / 12.0, 1e-3)
        # E|n|^2gamma of a normal n.
        ln_moment = gamma * math.log(2.0) + float(gammaln(gamma + 0.5)) - 0.5 * math.log(math.pi)
        ln_read = (
            ln_well + 0.5 * (math.log(dark_dn2) - ln_moment) / gamma - math.log(self.top_dn - black) / gamma
        )
        ln_charge = ln_well + np.log(share) / gamma
        shared = [black, ln_gain, gamma, math.exp(2.0 * ln_read), 1.0, 1e-5]
        return np.array([*shared, *ln_charge])

    def steps(self, x: Float64) -> Float64:
        """Return steps (p,) of the numerical derivatives."""
        charge = float(np.exp(x[len(NAMES) :]).max())
        noise2 = max(x[3], 1.0)
        shared = [1e-3, 1e-4, 1e-4, 1e-3 * noise2, 1e-3 * noise2, 1e-3 / charge]
        return np.array([*shared, *np.full(self.lit.sum(), 1e-4)])


def fit_photon_transfer(problem: PhotonTransferProblem) -> PhotonTransferFit:
    """Return the maximum of the likelihood."""
    x, tau = problem.start(), 3e-3
    n_shared = len(NAMES)
    free = np.array([n != NAMES.index("gamma") or problem.gamma is None for n in range(len(x))])
    is_settled, freedom = False, 1.0
    for done in range(MAX_ROUNDS):
        predicted = problem.predict_at(x)
        gradient, information = _scores(problem, x, predicted)
        pull, stiffness = _line_prior(problem, x, tau)
        gradient[n_shared:] -= pull
        information[n_shared:, n_shared:] += stiffness
        covariance = np.zeros_like(information)
        covariance[np.ix_(free, free)] = _inverse(information[np.ix_(free, free)])
        step = covariance @ gradient
        sigmas = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        size = np.abs(step) / sigmas
        is_log = np.array([False, True, True, False, False, False, *np.ones(problem.lit.sum(), dtype=bool)])
        # A round changes no logarithm, and no gamma, by more than 0.3.
        shrink = min(1.0, 0.3 / float(np.abs(step[is_log]).max() + 1e-300))
        x = _inside(x + shrink * step, x, problem)
        before = tau
        # Eight rounds hold the linearity error: far from the maximum all is off the line.
        held_rounds = 8
        if done >= held_rounds:
            tau, freedom = _linearity(problem, x, covariance, tau)
        if done > held_rounds and size[free].max() < SETTLED_SIGMAS and abs(tau - before) < 1e-3 * tau:
            is_settled = True
            break
    predicted = problem.predict_at(x)
    departures = _departures(problem, x)
    chi2, p_value = _chi2(problem, predicted, departures, tau, int(free.sum()))
    return PhotonTransferFit(
        sensor=problem.sensor_at(x),
        values=x,
        covariance=covariance,
        freedoms=_freedoms(information, free, covariance, tau, freedom),
        charge_e=problem.charges_at(x),
        predicted=predicted,
        linearity_rel=tau,
        linearity_freedom=freedom,
        departures=departures,
        chi2=chi2,
        p_value=p_value,
        is_settled=is_settled,
    )


def _inside(x: Float64, before: Float64, problem: PhotonTransferProblem) -> Float64:
    """Return parameters (p,) no step of which goes where the model ends: half way there instead."""
    x = x.copy()
    for n, lower in ((0, None), (2, 0.1), (3, 0.0)):
        if lower is not None and x[n] <= lower:
            x[n] = 0.5 * (before[n] + lower)
    x[0] = min(x[0], problem.top_dn - 2.0)
    return x


def _freedoms(information: Float64, free: Bool, covariance: Float64, tau: float, freedom: float) -> Float64:
    """Return Student's degrees of freedom (p,): a variance that rests on tau is as uncertain as tau^2.

    Satterthwaite (1946, Biometrics Bulletin 2, 110): freedom / (d ln variance / d ln tau^2)^2.
    """
    looser, n = information.copy(), int(free.size - len(NAMES))
    looser[-n:, -n:] += (np.eye(n) - 1.0 / n) * (1.0 / LOOSER - 1.0) / tau**2
    variance = np.diag(_inverse(looser[np.ix_(free, free)]))
    freedoms = np.full(free.size, np.inf)
    share = np.log(variance / np.diag(covariance)[free]) / math.log(LOOSER)
    freedoms[free] = freedom / np.maximum(share, 1e-6) ** 2
    return freedoms


def _inverse(information: Float64) -> Float64:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    return np.asarray(
        scale[:, np.newaxis] * np.linalg.pinv(information * np.outer(scale, scale), 1e-13) * scale
    )


def _departures(problem: PhotonTransferProblem, x: Float64) -> Float64:
    """Return the log deviations (l,) of the lit levels' charges from proportionality to exposure."""
    off = x[len(NAMES) :] - np.log(problem.levels.exposure_s[problem.lit])
    return np.asarray(off - off.mean())


def _line_prior(problem: PhotonTransferProblem, x: Float64, tau: float) -> tuple[Float64, Float64]:
    """Return gradient (l,) and curvature (l, l) of the line's prior, its brightness integrated out."""
    n = int(problem.lit.sum())
    stiffness = (np.eye(n) - 1.0 / n) / tau**2
    return _departures(problem, x) / tau**2, stiffness


def _linearity(
    problem: PhotonTransferProblem, x: Float64, covariance: Float64, tau: float
) -> tuple[float, float]:
    """Return the next tau and the levels that it rests on."""
    n = int(problem.lit.sum())
    centred = np.eye(n) - 1.0 / n
    spread = centred @ covariance[len(NAMES) :, len(NAMES) :] @ centred
    freedom = max(n - 1.0 - float(np.trace(spread)) / tau**2, 0.5)
    square = float(np.sum(_departures(problem, x) ** 2))
    return max(math.sqrt(square / freedom), 1e-6), freedom


def _scores(problem: PhotonTransferProblem, x: Float64, here: ResponsePrediction) -> tuple[Float64, Float64]:
    """Return the gradient (p,) of the likelihood's logarithm and its information (p, p)."""
    levels, n_shared = problem.levels, len(NAMES)
    n, frames = levels.n_pixels, levels.n_frames
    steps = problem.steps(x)
    J_mean, J_variance = np.zeros((len(frames), len(x))), np.zeros((len(frames), len(x)))
    dSigma = np.zeros((len(x), len(frames), len(frames)))
    for k in range(n_shared):
        low, high = (problem.predict_at(x + sign * steps * (np.arange(len(x)) == k)) for sign in (-1, 1))
        J_mean[:, k] = (high.mean_dn - low.mean_dn) / (2.0 * steps[k])
        J_variance[:, k] = (high.variance_dn2 - low.variance_dn2) / (2.0 * steps[k])
        dSigma[k] = (_spatial(high, frames) - _spatial(low, frames)) / (2.0 * steps[k])
    # A level's charge moves nothing but that level: all of them are moved at once.
    behind = np.arange(len(x)) >= n_shared
    low, high = (problem.predict_at(x + sign * steps * behind) for sign in (-1, 1))
    columns = n_shared + np.arange(problem.lit.sum())
    rows = np.flatnonzero(problem.lit)
    width = 2.0 * steps[columns]
    J_mean[rows, columns] = (high.mean_dn - low.mean_dn)[rows] / width
    J_variance[rows, columns] = (high.variance_dn2 - low.variance_dn2)[rows] / width
    ln_slope = np.log(high.slope_dn_per_e / low.slope_dn_per_e)
    pattern = here.pattern_dn2
    shape = _pattern_slopes(problem, x, here, ln_slope / (2.0 * steps[-1]))
    for column, row in zip(columns, rows, strict=True):
        dSigma[column, row] += shape[row]
        dSigma[column, :, row] += shape[row]
        dSigma[column, row, row] += J_variance[row, column] / frames[row]
    Sigma = pattern + np.diag(here.variance_dn2 / frames)
    C_mean = np.diag(here.variance_dn2 / (frames * n)) + max(x[4], 0.0) / n * np.outer(
        here.slope_dn_per_e, here.slope_dn_per_e
    )
    C_variance = here.variance_of_variance / n
    weighted = np.linalg.solve(C_mean, J_mean)
    gradient = weighted.T @ (levels.mean_dn - here.mean_dn)
    information = weighted.T @ J_mean
    gradient += J_variance.T @ ((levels.variance_dn2 - here.variance_dn2) / C_variance)
    information += J_variance.T @ (J_variance / C_variance[:, np.newaxis])
    whitened = np.linalg.solve(Sigma, dSigma)
    excess = np.linalg.solve(Sigma, levels.spatial_dn2 - Sigma)
    gradient += 0.5 * n * np.einsum("kij,ji->k", whitened, excess)
    information += 0.5 * n * np.einsum("kij,lji->kl", whitened, whitened)
    return gradient, information


def _spatial(predicted: ResponsePrediction, frames: Float64) -> Float64:
    return np.asarray(predicted.pattern_dn2 + np.diag(predicted.variance_dn2 / frames))


def _pattern_slopes(
    problem: PhotonTransferProblem, x: Float64, here: ResponsePrediction, ln_slope: Float64
) -> Float64:
    """Return the derivatives (s, s) of the pattern's row s with the logarithm of level s's charge."""
    charge = problem.charges_at(x)
    slope = here.slope_dn_per_e
    response = np.outer(slope, slope) * x[5] * np.outer(charge, charge)
    return np.asarray(here.pattern_dn2 * ln_slope[:, np.newaxis] + response)


def _chi2(
    problem: PhotonTransferProblem,
    predicted: ResponsePrediction,
    departures: Float64,
    tau: float,
    n_free: int,
) -> tuple[float, float]:
    """Return chi2 of means, variances and the line per degree of freedom, and how likely a larger one is."""
    levels = problem.levels
    noise = (levels.variance_dn2 - predicted.variance_dn2) ** 2
    chi2 = float(np.sum(noise / (predicted.variance_of_variance / levels.n_pixels)))
    chi2 += float(np.sum(departures**2)) / tau**2
    mean = (levels.mean_dn - predicted.mean_dn) ** 2
    chi2 += float(np.sum(mean / (predicted.variance_dn2 / (levels.n_frames * levels.n_pixels))))
    # The patterns' two parameters are the spatial covariance's; tau costs the line one freedom more.
    freedom = max(2 * len(levels.mean_dn) + int(problem.lit.sum()) - 2 - (n_free - 2), 1)
    return chi2 / freedom, float(chi2_distribution.sf(chi2, freedom))
