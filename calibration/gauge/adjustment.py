"""Sheet and gauge from stripes at several poses of the robot: every error in all that is measured.

A ray r meets the sheet n.X + d = 0 of the tool frame in X = o - (n.o + d) / (n.r) r, a bowed one beside it.
Robot and gauge take it to the gauge's frame, where it lies on a face: m.X - k h = 0. That distance over its
derivative by the ray is the misfit d in the image: in mm a sheet that sees heights small would fit best. The
misfits' covariance C has three parts: the stripe's noise; the robot's own error, the same for all points of
an image; and the form of gauge and stripe, the same along a piece, on a plate of each point. The last two are
as large as has the largest restricted likelihood (Patterson and Thompson, Biometrika 58, 1971), with a wide
prior about the usual ones. Sheet (3 numbers) and gauge (two turns of its top, one of its edge, height and
place across, its size) have the least sum of d' C^-1 d, with C of the fit before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from calibration.gauge.shape import Gauge, Shape
from calibration.laser.plane import foot_on, points_on_sheet, with_plane
from calibration.rigid import transform_each
from noise_model.compiled.arrays import Float64, Int64
from noise_model.instrument.laser import Laser

RAY_STEP, TURN_STEP, MOVE_STEP_MM = 1e-6, 1e-6, 1e-3
"""Steps of finite differences: of a ray's slope, of a turn, rad, of a move."""

STEPS = np.array([*[TURN_STEP] * 2, MOVE_STEP_MM, *[TURN_STEP] * 3, *[MOVE_STEP_MM] * 3])
"""Steps of all unknowns."""

SHEET, GAUGE, SIZE = slice(0, 3), slice(3, 8), 8
"""Places among the unknowns of the sheet's two tilts, rad, and offset, mm; the gauge's pose; its size."""

START_MM, BOUNDS_MM = (0.05, 0.01), (1e-3, 2.0)
"""1 sigma of the robot's error and of the form's, usually; and how small and how large either may be."""

NOISE_FACTOR = 10.0
"""Factor by which either may be off what is usual, 1 sigma: it counts where few images tell the errors."""

MAX_SIGMAS, FAR = 6.0, 1e4
"""The unknowns' largest way from the start, in sigmas of what is known beforehand, and where nothing is."""

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

    `laser` has the sheet, which tilts about `centre_mm` (3,), tool frame, the middle of its points;
    `T_base_gauge` (4, 4) is the gauge's pose, mm.
    """

    laser: Laser
    T_base_gauge: Float64
    centre_mm: Float64
    size_mm: float

    @property
    def plane(self) -> Float64:
        """The sheet's plane (4,)."""
        return self.laser.plane

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
        laser = with_plane(self.laser, np.array([*n, place - n @ self.centre_mm]))
        return GaugeState(laser, T, self.centre_mm, self.size_mm + float(step[8]))


@dataclass(frozen=True)
class GaugeProblem:
    """Sightings of a gauge, the camera's pose in the tool, and the usual 1 sigma of robot and form, mm."""

    gauge: Gauge
    T_tool_camera: Float64
    sightings: tuple[Sighting, ...]
    usual_mm: tuple[float, float] = START_MM

    @cached_property
    def slices(self) -> list[slice]:
        """Slice of each image's points among all (N,)."""
        ends = np.cumsum([len(sighting.rays) for sighting in self.sightings])
        return [slice(end - len(each.rays), end) for each, end in zip(self.sightings, ends, strict=True)]

    def centred(self, state: GaugeState) -> GaugeState:
        """Return the same state whose sheet tilts about the middle of its points.

        About another point a lean of which the images tell little would move the place by its square.
        """
        T = self.T_tool_camera
        points = points_on_sheet(state.laser, T[:3, 3], self._rays @ T[:3, :3].T)
        return replace(state, centre_mm=foot_on(state.plane, points.mean(axis=0)))

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
        points = points_on_sheet(state.laser, T[:3, 3], directions)
        return transform_each(self._T_base_tool, points)

    def distances(self, state: GaugeState, rays: Float64 | None = None) -> Float64:
        """Return the distances (N,), mm, of all points from their faces."""
        normals, offsets = self.gauge.faces
        T = state.T_base_gauge
        in_gauge = (self.points_base(state, rays) - T[:3, 3]) @ T[:3, :3]
        along = np.sum(in_gauge * normals[self.faces], axis=1)
        return np.asarray(along - offsets[self.faces] * state.size_mm)

    def mm_per_slope(self, state: GaugeState) -> Float64:
        """Return the distances' derivatives (N,) by the rays."""
        shifted = self.distances(state, self._rays + RAY_STEP * self._across)
        return np.asarray((shifted - self.distances(state)) / RAY_STEP)

    def misfits(self, state: GaugeState) -> Float64:
        """Return how far the rays (N,) miss their faces in the image, in units of the focal length."""
        return np.asarray(self.distances(state) / self.mm_per_slope(state))

    def slopes(self, state: GaugeState, step: Float64 | float = 0.0) -> Float64:
        """Return the misfits' derivatives (N, 9) by the unknowns, a step (9,) away from a state."""
        columns = []
        for size in np.diag(STEPS):
            ahead, behind = (self.misfits(state.moved(step + change)) for change in (size, -size))
            columns.append((ahead - behind) / (2.0 * size.sum()))
        return np.column_stack(columns)

    def whitening(self, state: GaugeState, noise_mm: Float64) -> Float64:
        """Return the inverse (N, N) of the root of all misfits' covariance at a state."""
        return np.asarray(
            block_diag(
                *(
                    np.linalg.inv(np.linalg.cholesky(of_image))
                    for of_image in self.covariances(state, noise_mm)
                )
            )
        )

    def parts(self, state: GaugeState) -> list[tuple[Float64, Float64, Float64]]:
        """Return the terms of each image's covariance (n, n): rays, and robot and form for 1 mm."""
        per_mm = 1.0 / self.mm_per_slope(state)
        N = self.gauge.faces[0][self.faces]
        made = []
        for each, part in zip(self.sightings, self.slices, strict=True):
            # Two points make a piece; a step's edge comes alone, at the end. A plate bends along its piece.
            piece = np.arange(len(each.rays)) // (1 if self.gauge.shape is Shape.PLATE else 2)
            by_mm = np.outer(per_mm[part], per_mm[part])
            made.append((each.covariance, by_mm * (N[part] @ N[part].T), by_mm * (piece[:, None] == piece)))
        return made

    def covariances(self, state: GaugeState, noise_mm: Float64) -> list[Float64]:
        """Return the covariance (n, n) of each image's misfits for 1 sigma (2,) of robot and form."""
        robot, form = noise_mm**2
        return [rays + robot * by_robot + form * by_form for rays, by_robot, by_form in self.parts(state)]


@dataclass(frozen=True)
class GaugeFit:
    """Result of the least squares.

    `step` (m,) leads to it from the start. `information` (m, m), priors included, is of the sheet's tilts and
    offset, then the gauge's, and the size where it is free. `noise_mm` (2,) is 1 sigma of the robot's error
    in each direction, and of the form of gauge and stripe. `squares` (k,) are each image's d' C^-1 d over
    `counts` (k,) misfits.
    """

    state: GaugeState
    step: Float64
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
    before: GaugeFit | None = None,
    loss: str = "linear",
) -> GaugeFit:
    """Fit sheet and gauge for stated errors `noise_mm` (2,) of robot and form, 1 sigma.

    The gauge's pose lies near `start`. `prior` (m,) is 1 sigma of the unknowns about the start; infinite
    where nothing is known. It begins where the fit `before` ended, if there was one. `loss` is that of
    scipy.optimize.least_squares.
    """
    known = np.diag(_prior_information(prior))
    whitening = problem.whitening(start if before is None else before.state, noise_mm)

    def residuals(step: Float64) -> Float64:
        return np.append(whitening @ problem.misfits(start.moved(step)), np.sqrt(known) @ step)

    def jacobian(step: Float64) -> Float64:
        return np.vstack([whitening @ problem.slopes(start, step), np.sqrt(known)])

    first = np.zeros(len(known)) if before is None else before.step
    far = MAX_SIGMAS / np.sqrt(np.maximum(np.diag(known), MAX_SIGMAS**2 / FAR**2))
    step = least_squares(residuals, first, jacobian, x_scale="jac", bounds=(-far, far), loss=loss).x
    state = problem.centred(start.moved(step))
    whitening = problem.whitening(state, noise_mm)
    slopes, off = whitening @ problem.slopes(state), whitening @ problem.misfits(state)
    squares = np.array([off[part] @ off[part] for part in problem.slices])
    counts = np.array([len(sighting.rays) for sighting in problem.sightings])
    return GaugeFit(state, step, slopes.T @ slopes + known, noise_mm, squares, counts)


def _prior_information(prior: Float64 | None) -> Float64:
    """Return the information (m,) beforehand."""
    sigma = np.full(len(STEPS), np.inf)
    # The gauge lies as first placed within 20 deg, its edge within 60 deg; its place, mm, is unknown.
    sigma[GAUGE] = [0.35, 0.35, 1.0, 1e3, 1e3]
    return np.asarray((sigma if prior is None else np.minimum(sigma, prior)) ** -2.0)


def fit_with_noise(problem: GaugeProblem, start: GaugeState, prior: Float64 | None = None) -> GaugeFit:
    """Fit sheet and gauge, and how large the robot's error and the form's are; see `fit`."""
    noise_mm = np.array(problem.usual_mm)
    fitted = fit(problem, start, noise_mm, prior)
    for _ in range(NOISE_ROUNDS):
        before, noise_mm = noise_mm, _estimate_noise(problem, fitted, prior)
        fitted = fit(problem, start, noise_mm, prior, fitted)
        if np.abs(np.log(noise_mm / before)).max() < NOISE_SETTLED:
            break
    return fitted


def _estimate_noise(problem: GaugeProblem, fitted: GaugeFit, prior: Float64 | None) -> Float64:
    """Return 1 sigma of robot and form (2,), mm, of the largest restricted likelihood."""
    known = np.diag(_prior_information(prior))
    off, slopes = problem.misfits(fitted.state), problem.slopes(fitted.state)
    parts, usual = problem.parts(fitted.state), np.log(problem.usual_mm)
    pulled = known @ fitted.step

    def loss(ln_mm: Float64) -> float:
        robot, form = np.exp(2.0 * ln_mm)
        H, g = known.copy(), pulled.copy()
        total = float(np.sum(((ln_mm - usual) / np.log(NOISE_FACTOR)) ** 2))
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
