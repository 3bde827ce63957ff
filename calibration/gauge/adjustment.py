"""Sheet and gauge from stripes at several poses of the robot: every error in all that is measured.

A ray r meets the sheet n.X + d = 0 of the tool frame in X = o - (n.o + d) / (n.r) r. Robot and gauge take it
to the gauge's frame, where it lies on a face: m.X - k h = 0. These distances' covariance C has three parts:
what the stripe's noise makes of a ray; the robot's own error, the same for all points of an image; and the
form of gauge and stripe, the same along a piece. The last two are as large as has the largest restricted
likelihood (Patterson and Thompson, Biometrika 58, 1971). Sheet (3 numbers) and gauge (two turns of its top,
one of its edge, height and place across, its size) have the least sum of d' C^-1 d.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from calibration.gauge.shape import Gauge
from calibration.laser.plane import points_on_plane
from calibration.rigid import transform_each
from noise_model.compiled.arrays import Float64, Int64

RAY_STEP, TURN_STEP, MOVE_STEP_MM = 1e-6, 1e-6, 1e-3
"""Steps of finite differences: of a ray's slope, of a turn, rad, of a move."""

STEPS = np.array([*[TURN_STEP] * 2, MOVE_STEP_MM, *[TURN_STEP] * 3, *[MOVE_STEP_MM] * 3])
"""Steps of all unknowns."""

SHEET, GAUGE, SIZE = slice(0, 3), slice(3, 8), 8
"""Places among the unknowns of the sheet's two tilts, rad, and offset, mm; the gauge's pose; its size."""

START_MM, BOUNDS_MM = (0.05, 0.01), (1e-3, 2.0)
"""1 sigma of the robot's error and of the form's, at first; and how small and how large either may be."""

GRID = 6
"""Number of sizes of either error that are tried before the likelihood is maximised."""

NOISE_ROUNDS, NOISE_SETTLED = 4, 0.05
"""Rounds of fit and noise at most, and the last one's change of either's logarithm."""


@dataclass(frozen=True)
class Sighting:
    """Points of the gauge in an image.

    `rays` (n, 3) are in the camera frame, z = 1; `faces` (n,) are the gauge's faces that they lie on. They
    are uncertain along `across` (n, 3), with `covariance` (n, n). `T_base_tool` (4, 4) is the robot's pose,
    mm.
    """

    name: str
    T_base_tool: Float64
    rays: Float64
    faces: Int64
    across: Float64
    covariance: Float64


@dataclass(frozen=True)
class GaugeState:
    """Unknowns of the adjustment.

    `plane` (4,) is the sheet in the tool frame, mm, which tilts about `centre_mm` (3,), the middle of its
    points; `T_base_gauge` (4, 4) is the gauge's pose, mm.
    """

    plane: Float64
    T_base_gauge: Float64
    centre_mm: Float64
    size_mm: float

    @property
    def leans(self) -> Float64:
        """Two directions of the sheet (2, 3) towards which its normal tilts."""
        n = self.plane[:3]
        first = np.array([-n[1], n[0], 0.0]) if np.hypot(n[0], n[1]) > 0.1 else np.array([1.0, 0.0, 0.0])
        first = first - (first @ n) * n
        first = first / np.linalg.norm(first)
        return np.stack([first, np.cross(n, first)])

    def moved(self, step: Float64) -> GaugeState:
        """Return the state after a step (9,) of all unknowns."""
        n = self.plane[:3] + step[:2] @ self.leans
        n = n / np.linalg.norm(n)
        place = self.plane[:3] @ self.centre_mm + self.plane[3] + step[2]
        T = self.T_base_gauge.copy()
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(step[3:6]).as_matrix()
        T[:3, 3] += self.T_base_gauge[:3, 1] * step[6] + self.T_base_gauge[:3, 2] * step[7]
        plane = np.array([*n, place - n @ self.centre_mm])
        return GaugeState(plane, T, self.centre_mm, self.size_mm + float(step[8]))


@dataclass(frozen=True)
class GaugeProblem:
    """Sightings of a gauge, and the camera's pose in the tool."""

    gauge: Gauge
    T_tool_camera: Float64
    sightings: tuple[Sighting, ...]

    @cached_property
    def slices(self) -> list[slice]:
        """Slice of each image's points among all (N,)."""
        ends = np.cumsum([len(sighting.rays) for sighting in self.sightings])
        return [slice(end - len(each.rays), end) for each, end in zip(self.sightings, ends, strict=True)]

    @cached_property
    def _rays(self) -> Float64:
        return np.concatenate([sighting.rays for sighting in self.sightings])

    @cached_property
    def _across(self) -> Float64:
        return np.concatenate([sighting.across for sighting in self.sightings])

    @cached_property
    def _T_base_tool(self) -> Float64:
        """The robot's pose at each point (N, 4, 4)."""
        return np.concatenate(
            [np.tile(sighting.T_base_tool, (len(sighting.rays), 1, 1)) for sighting in self.sightings]
        )

    @cached_property
    def faces(self) -> Int64:
        """On which face each point (N,) is."""
        return np.concatenate([sighting.faces for sighting in self.sightings])

    def points_base(self, state: GaugeState, rays: Float64 | None = None) -> Float64:
        """Return the points (N, 3), mm, base frame, in which the rays (N, 3) of all images meet the sheet."""
        T = self.T_tool_camera
        directions = (self._rays if rays is None else rays) @ T[:3, :3].T
        points = points_on_plane(state.plane, T[:3, 3], directions)
        return transform_each(self._T_base_tool, points)

    def distances(self, state: GaugeState, rays: Float64 | None = None) -> Float64:
        """Return the distances (N,), mm, of all points from their faces."""
        normals, offsets = self.gauge.faces
        T = state.T_base_gauge
        in_gauge = (self.points_base(state, rays) - T[:3, 3]) @ T[:3, :3]
        along = np.sum(in_gauge * normals[self.faces], axis=1)
        return np.asarray(along - offsets[self.faces] * state.size_mm)

    def slopes(self, state: GaugeState, step: Float64 | float = 0.0) -> Float64:
        """Return the distances' derivatives (N, 9) by the unknowns, a step (9,) away from a state."""
        columns = []
        for size in np.diag(STEPS):
            ahead, behind = (self.distances(state.moved(step + change)) for change in (size, -size))
            columns.append((ahead - behind) / (2.0 * size.sum()))
        return np.column_stack(columns)

    def whiten(self, state: GaugeState, noise_mm: Float64, numbers: Float64) -> Float64:
        """Return numbers of all distances (N, ...) over their covariance's root at a state."""
        C = self.covariances(state, noise_mm)
        return np.concatenate(
            [
                solve_triangular(np.linalg.cholesky(of_image), numbers[part], lower=True)
                for of_image, part in zip(C, self.slices, strict=True)
            ]
        )

    def parts(self, state: GaugeState) -> list[tuple[Float64, Float64, Float64]]:
        """Return the terms of each image's covariance (n, n): rays, mm², robot and form for 1 mm."""
        shifted = self.distances(state, self._rays + RAY_STEP * self._across)
        D = (shifted - self.distances(state)) / RAY_STEP
        N = self.gauge.faces[0][self.faces]
        made = []
        for each, part in zip(self.sightings, self.slices, strict=True):
            # Two points make a piece; a step's edge comes alone, at the end.
            piece = np.arange(len(each.rays)) // 2
            by_rays = D[part, np.newaxis] * each.covariance * D[part]
            made.append((by_rays, N[part] @ N[part].T, (piece[:, np.newaxis] == piece).astype(np.float64)))
        return made

    def covariances(self, state: GaugeState, noise_mm: Float64) -> list[Float64]:
        """Return the covariance of each image's distances (n, n), mm², for 1 sigma (2,) of robot and form."""
        robot, form = noise_mm**2
        return [rays + robot * by_robot + form * by_form for rays, by_robot, by_form in self.parts(state)]


@dataclass(frozen=True)
class GaugeFit:
    """Result of the least squares.

    `information` (m, m), priors included, is of the sheet's tilts and offset, then the gauge's, and the size
    where it is free. `noise_mm` (2,) is 1 sigma of the robot's error in each direction, and of the form of
    gauge and stripe. `squares` (k,) are each image's d' C^-1 d over `counts` (k,) distances.
    """

    state: GaugeState
    information: Float64
    noise_mm: Float64
    squares: Float64
    counts: Int64

    @property
    def covariance(self) -> Float64:
        """The covariance (m, m) of the unknowns."""
        return inverse(self.information)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the sum of squares."""
        return int(self.counts.sum()) - len(self.information)


def inverse(information: Float64) -> Float64:
    """Return the inverse of an information matrix, scaled beforehand; what is unknown is very uncertain."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    value, vector = np.linalg.eigh(information * np.outer(scale, scale))
    small = (vector / np.maximum(value, 1e-12)) @ vector.T
    return np.asarray(small * np.outer(scale, scale))


def fit(
    problem: GaugeProblem,
    start: GaugeState,
    noise_mm: Float64,
    prior: Float64 | None = None,
) -> GaugeFit:
    """Fit sheet and gauge for stated errors `noise_mm` (2,) of robot and form, 1 sigma.

    The gauge's pose lies near `start`. `prior` (m,) is 1 sigma of the unknowns about the start; infinite
    where nothing is known.
    """
    known = np.diag(_prior_information(prior))

    def residuals(step: Float64) -> Float64:
        state = start.moved(step)
        off = problem.whiten(state, noise_mm, problem.distances(state))
        return np.append(off, np.sqrt(known) @ step)

    def jacobian(step: Float64) -> Float64:
        # The covariance's own change with the state is neglected: it is small.
        slopes = problem.whiten(start.moved(step), noise_mm, problem.slopes(start, step))
        return np.vstack([slopes, np.sqrt(known)])

    moved = least_squares(residuals, np.zeros(len(known)), jacobian, x_scale="jac").x
    state = start.moved(moved)
    slopes = problem.whiten(state, noise_mm, problem.slopes(state))
    off = residuals(moved)
    squares = np.array([off[part] @ off[part] for part in problem.slices])
    counts = np.array([len(sighting.rays) for sighting in problem.sightings])
    return GaugeFit(state, slopes.T @ slopes + known, noise_mm, squares, counts)


def _prior_information(prior: Float64 | None) -> Float64:
    """Return the information (m,) beforehand."""
    sigma = np.full(len(STEPS), np.inf)
    # The gauge lies as first placed within 20 deg, its edge within 60 deg; its place, mm, is unknown.
    sigma[GAUGE] = [0.35, 0.35, 1.0, 1e3, 1e3]
    return np.asarray((sigma if prior is None else np.minimum(sigma, prior)) ** -2.0)


def fit_with_noise(problem: GaugeProblem, start: GaugeState, prior: Float64 | None = None) -> GaugeFit:
    """Fit sheet and gauge, and how large the robot's error and the form's are; see `fit`."""
    noise_mm = np.array(START_MM)
    fitted = fit(problem, start, noise_mm, prior)
    for _ in range(NOISE_ROUNDS):
        before, noise_mm = noise_mm, _estimate_noise(problem, fitted, prior)
        fitted = fit(problem, replace(start, plane=fitted.state.plane), noise_mm, prior)
        if np.abs(np.log(noise_mm / before)).max() < NOISE_SETTLED:
            break
    return fitted


def _estimate_noise(problem: GaugeProblem, fitted: GaugeFit, prior: Float64 | None) -> Float64:
    """Return 1 sigma of robot and form (2,), mm, of the largest restricted likelihood."""
    known = np.diag(_prior_information(prior))
    off, slopes = problem.distances(fitted.state), problem.slopes(fitted.state)
    parts = problem.parts(fitted.state)

    def loss(ln_mm: Float64) -> float:
        robot, form = np.exp(2.0 * ln_mm)
        H, g, total = known.copy(), np.zeros(len(known)), 0.0
        for part, (by_rays, by_robot, by_form) in zip(problem.slices, parts, strict=True):
            C = by_rays + robot * by_robot + form * by_form
            d, J = off[part], slopes[part]
            solved = np.linalg.solve(C, np.column_stack([J, d]))
            H += J.T @ solved[:, :-1]
            g += J.T @ solved[:, -1]
            total += float(d @ solved[:, -1]) + float(np.linalg.slogdet(C)[1])
        return total - float(g @ inverse(H) @ g) + float(np.linalg.slogdet(H)[1])

    low, high = np.log(BOUNDS_MM)
    # Far from its maximum the likelihood is flat: steps alone would not come back.
    grid = np.linspace(low, high, GRID)
    starts = [np.array([robot, form]) for robot in grid for form in grid]
    best = minimize(
        loss,
        min([*starts, np.log(fitted.noise_mm)], key=loss),
        method="L-BFGS-B",
        bounds=[(low, high)] * 2,
        options={"maxiter": 15},
    )
    return np.asarray(np.exp(best.x))
