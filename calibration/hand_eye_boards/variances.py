"""The robot's inaccuracy as a noise whose size is estimated: restricted maximum likelihood.

Board poses in the camera are off by e_i where the robot's poses predict them:

    e_i = H_i b + L_i l + noise,   V_i = D_i^-1 + M_i diag(sigma_r², sigma_t²) M_i'

b is what is unknown: camera, board, warp. l is the lens' error, whose covariance the setup states. D_i^-1
is what the corners' noise makes of the pose, M_i takes the robot's error to the camera. The restricted
likelihood is that of all contrasts of e that b does not move, so that poses spent on b do not make the
noise look smaller (Patterson and Thompson, Recovery of inter-block information when block sizes are
unequal, 1971):

    -2 ln L = sum ln |V_i| + ln |H' V^-1 H| + e' V^-1 e - b' (H' V^-1 H) b

Of few poses its maximum often lies at a sigma of 0, and the camera's covariance is then too small. L
times all sigmas has none there (Chung et al., A nondegenerate penalized likelihood estimator for variance
parameters in multilevel models, 2013); of many poses its maximum is that of L.

The covariance of b counts that V is estimated (Kenward and Roger, Small sample inference for fixed
effects from restricted maximum likelihood, 1997), and so do the degrees of freedom of its intervals
(Satterthwaite).

Some of b may be coefficients of a repeatable error (`robot_error`), normal about 0. The sigmas of their
priors, one for each block of them, are estimated along with the robot's.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import minimize

from calibration.camera.normal_equations import scaled_inverse
from noise_model.compiled.arrays import Bool, Float64

TURN, PLACE = slice(0, 3), slice(3, 6)

MIN_SIGMAS = np.array([math.radians(1e-5), 1e-4]), 1e-3
MAX_SIGMAS = np.array([math.radians(30.0), 300.0]), 1e3
"""Bounds of the robot's sigmas, rad and mm, and of a prior's: below them, the error is none."""

FIRST = np.array([math.radians(0.03), 0.1]), 1.0
"""Start of the search: a common robot, rad and mm; coefficients are 1 for a common one."""


@dataclass(frozen=True)
class PoseErrors:
    """Errors of the boards against the robot's poses, linear in the unknowns.

    `error` (V, 6) is e, a small motion of the board in the camera frame, rad and mm; `by_corners` (V, 6, 6)
    is D^-1, its covariance from the corners' noise; `per_robot` (V, 6, 6) is M, `per_unknown` (V, 6, m) H,
    `per_lens` (V, 6, n) L. `known` (m, m) is the information within each image (of the board's warp), `pull`
    (m,) its right side. `lens_root` (n, k) is a root of the covariance of l; k is 0 for an exact lens.
    `coefficients` are the present ones of the robot's repeatable error, `first_coefficient` is the number of
    the first among the unknowns; each of `blocks` is so many of them, with one prior about 0.
    """

    error: Float64
    by_corners: Float64
    per_robot: Float64
    per_unknown: Float64
    known: Float64
    pull: Float64
    per_lens: Float64
    lens_root: Float64
    first_coefficient: int = 0
    coefficients: Float64 = field(default_factory=lambda: np.zeros(0))
    blocks: tuple[int, ...] = ()

    @property
    def has_prior(self) -> Bool:
        """True for the unknowns (m,) that are coefficients of the robot's repeatable error."""
        place = np.arange(self.per_unknown.shape[2]) - self.first_coefficient
        return np.asarray((place >= 0) & (place < len(self.coefficients)))

    @property
    def whole_error(self) -> Float64:
        """The errors (V, 6) with coefficients of 0: a prior holds the whole of them, not their step."""
        return self.error + self.per_unknown[:, :, self.has_prior] @ self.coefficients

    def covariance(self, sigma: Float64) -> Float64:
        """Return V (V, 6, 6) for the robot's sigma, rad and mm: the first two of (2 + b,)."""
        return np.asarray(self.by_corners + np.einsum("k,vkij->vij", sigma[:2] ** 2, self.parts()))

    def information(self, sigma: Float64) -> Float64:
        """Return what is known (m, m) within images and by the priors."""
        return np.asarray(self.known + np.diag(self.prior(sigma)))

    def prior(self, sigma: Float64) -> Float64:
        """Return what the priors know of each unknown (m,); the last of the sigmas (2 + b,) are theirs."""
        known = np.zeros(len(self.known))
        known[self.has_prior] = self.each_coefficient(sigma) ** -2.0
        return known

    def each_coefficient(self, sigma: Float64) -> Float64:
        """Return the prior's sigma of each coefficient (k,)."""
        return np.repeat(sigma[2:], self.blocks)

    def parts(self) -> Float64:
        """Return the contribution (V, 2, 6, 6) to V of a unit of each of the robot's variances."""
        return np.stack([columns @ columns.transpose(0, 2, 1) for columns in self._columns()], axis=1)

    def _columns(self) -> tuple[Float64, Float64]:
        return self.per_robot[:, :, TURN], self.per_robot[:, :, PLACE]


@dataclass(frozen=True)
class VarianceSolution:
    """The unknowns at the robot's sigma, rad and mm, and those of the priors (2 + b,).

    `step` (m,) is b; `covariance` (m, m) is its own for an exact lens, with small samples allowed for;
    `by_robot` (m, m) is the robot's part of it, all but what the corners' noise makes; `slopes` (2, m, m) are
    its derivatives by the robot's two variances, whose covariance is `sigma_covariance` (2, 2). `per_lens`
    (m, n) is the change of b by the lens' errors, `lens_root` (n, k) a root of their covariance.
    """

    sigma: Float64
    step: Float64
    covariance: Float64
    by_robot: Float64
    sigma_covariance: Float64
    slopes: Float64
    per_lens: Float64
    lens_root: Float64

    @property
    def total(self) -> Float64:
        """The covariance of b (m, m) with that of the lens."""
        by_lens = self.per_lens @ self.lens_root
        return np.asarray(self.covariance + by_lens @ by_lens.T)

    def freedom(self) -> Float64:
        """Return the degrees of freedom (m,) of each unknown's variance: 2 v² / var v (Satterthwaite)."""
        slopes = np.diagonal(self.slopes, axis1=1, axis2=2)
        variance = np.einsum("km,kl,lm->m", slopes, self.sigma_covariance, slopes)
        return np.asarray(2.0 * np.diag(self.total) ** 2 / np.maximum(variance, 1e-300))


@dataclass(frozen=True)
class RobotLikelihood:
    """Largest penalised restricted likelihood: `sigma` (2 + b,) of robot and priors, ln L without penalty."""

    sigma: Float64
    log_likelihood: float


def robot_sigma(errors: PoseErrors, start: Float64 | None = None) -> RobotLikelihood:
    """Return the robot's sigma of the largest penalised restricted likelihood, rad and mm.

    The further sigmas are those of the coefficients' priors.
    """
    # The lens is marginal, too: its error must not pass for the robot's.
    by_lens = errors.per_lens @ errors.lens_root
    m, n = errors.per_unknown.shape[2], by_lens.shape[2]
    known = np.zeros((m + n, m + n))
    known[:m, :m], known[range(m, m + n), range(m, m + n)] = errors.known, 1.0
    has_prior = errors.has_prior
    known[:m, :m] += np.diag(has_prior.astype(float))
    pull = np.concatenate([errors.pull, np.zeros(n)])
    parts, whole = errors.parts(), errors.whole_error[:, :, np.newaxis]
    priors = np.ones(len(errors.blocks))

    def cost(log_sigma: Float64) -> float:
        sigma = np.exp(log_sigma)
        V = errors.by_corners + np.einsum("k,vkij->vij", sigma[:2] ** 2, parts)
        lower = np.linalg.cholesky(V)
        # Coefficients in units of their sigma: the prior is that of unit normals at any sigma.
        scaled = errors.per_unknown.copy()
        scaled[:, :, has_prior] *= errors.each_coefficient(sigma)
        whitened = np.linalg.solve(lower, np.concatenate([scaled, by_lens, whole], axis=2))
        flat = whitened.reshape(-1, m + n + 1)
        squares = flat.T @ flat
        information, right = squares[:-1, :-1] + known, squares[:-1, -1] + pull
        fitted = float(right @ np.linalg.solve(information, right))
        determinants = 2.0 * float(np.log(np.diagonal(lower, axis1=1, axis2=2)).sum())
        return determinants + float(np.linalg.slogdet(information)[1] + squares[-1, -1]) - fitted

    least, most, first = (
        np.append(robot, prior * priors) for robot, prior in (MIN_SIGMAS, MAX_SIGMAS, FIRST)
    )
    if start is not None:
        first = start.clip(3.0 * least, most / 3.0)
    result = minimize(
        lambda log_sigma: cost(log_sigma) - 2.0 * float(log_sigma.sum()),
        np.log(first),
        method="L-BFGS-B",
        bounds=list(zip(np.log(least), np.log(most), strict=True)),
    )
    return RobotLikelihood(np.exp(result.x), -0.5 * cost(result.x))


def solve(errors: PoseErrors, sigma: Float64) -> VarianceSolution:
    """Return the unknowns by generalised least squares at the robot's sigma, as `robot_sigma` has it.

    Raises numpy.linalg.LinAlgError if they are not determined.
    """
    H, parts = errors.per_unknown, errors.parts()
    W = np.linalg.inv(errors.covariance(sigma))
    WH = W @ H
    C = scaled_inverse(np.einsum("vim,vin->mn", H, WH) + errors.information(sigma))
    step = C @ (np.einsum("vim,vi->m", WH, errors.whole_error) + errors.pull)
    step[errors.has_prior] -= errors.coefficients
    # With P = W - W H C H' W, the information on the variances is tr(P V_k P V_l) / 2.
    WV = np.einsum("vij,vkjl->kvil", W, parts)
    once = np.einsum("kvij,vjm->kvim", WV, WH)
    inner = np.einsum("vim,vkij,vjn->kmn", WH, parts, WH, optimize=True)
    twice = np.einsum("vim,vkij,lvjn->klmn", WH, parts, once, optimize=True)
    both = (inner @ C)[:, np.newaxis] @ inner
    own = np.einsum("kvij,lvji->kl", WV, WV)
    information = own + np.einsum("mn,klnm->kl", C, both - 2.0 * twice)
    sigma_covariance = scaled_inverse(0.5 * information)
    spread = np.einsum("kl,klmn->mn", sigma_covariance, twice - both)
    covariance = C + 2.0 * C @ spread @ C
    covariance = 0.5 * (covariance + covariance.T)
    of_corners = np.einsum("vim,vij,vjn->mn", WH, errors.by_corners, WH, optimize=True)
    by_corners = C @ (of_corners + errors.known) @ C
    return VarianceSolution(
        sigma=sigma,
        step=step,
        covariance=covariance,
        by_robot=covariance - by_corners,
        sigma_covariance=sigma_covariance,
        slopes=C @ inner @ C,
        per_lens=C @ np.einsum("vim,vin->mn", WH, errors.per_lens),
        lens_root=errors.lens_root,
    )
