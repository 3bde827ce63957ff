"""The delay between the poses' clock and the frames', by maximum likelihood over a moving recording.

The seam stands still. With the right delay d, the pose at t + d puts each frame's seam point on one smooth
curve; with a wrong one the tool's own motion, its weave and its rise, is seen in it. The displacements y of
the seam points from the nominal line, sideways and in height, are normal:

    y(d) ~ N(0, K(s(d)) + H H^T + diag(v + tau^2)),

K the prior of a smooth seam over the stations s, v the tracker's variances, tau what its points scatter by
beyond them. H is what errors of the calibration, 1 sigma each, do to each point: a hand-eye error moves
points with the tool's pose, a delay with its velocity. How far the seam bends and tau are fitted along, for
each axis. So the seam is integrated out, and the likelihood's curvature at its maximum says how well d is
known. Motion along a straight seam moves no point off the curve: then nothing is known, and that is the
answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize, minimize_scalar
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from noise_model.compiled.arrays import Bool, Float64
from noise_model.effects import REGISTRY
from noise_model.setup import Setup
from tracker.seam.curve import BEND_MM, POINT_SCATTER_MM, prior_covariance
from tracker.seam_observations import SeamObservations
from tracker.state import Frame

DELAY = REGISTRY["pose_delay"].parameters[0]
"""The effect's parameter: its bounds are searched."""

GRID_S = 0.02
"""Spacing of the delays that are tried first: a fortieth of a fast weave's period."""

MIN_SEEN = 8
"""Least number of frames that show the seam."""

MAX_SIGMA_S = 0.5 * DELAY.prior_sigma
"""A delay is estimated if it is known to half of what the effect's prior leaves open."""


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """The poses T_base_tool at `times_s` (n,), which rise, as positions and unit quaternions (n, 7), mm.

    In between they are linear, the quaternions' length made 1 again: over a controller's period that is an
    even turn. Before the first and after the last the pose stands.
    """

    times_s: Float64
    numbers: Float64

    @classmethod
    def through(cls, times_s: Float64, T_base_tool: Float64) -> PoseTrack:
        """Return the track through poses (n, 4, 4), mm."""
        quaternions = Rotation.from_matrix(T_base_tool[:, :3, :3]).as_quat()
        # Of the two signs of a turn the one that goes on from the pose before.
        flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
        quaternions[1:] *= np.where(np.cumsum(flips) % 2 == 1, -1.0, 1.0)[:, np.newaxis]
        return cls(times_s, np.column_stack([T_base_tool[:, :3, 3], quaternions]))

    def smooth(self) -> PoseTrack:
        """Return the track without the controller's jitter, at even times.

        A jitter that is another one from pose to pose looks like motion, and a delay would follow it.
        """
        period_s = float(np.median(np.diff(self.times_s)))
        # Cubics over 0.25 s (Savitzky and Golay 1964) keep all but 0.3 % of a weave of 0.8 s.
        window = 2 * round(0.125 / period_s) + 1
        if window < 7 or len(self.times_s) <= window:
            return self
        times_s = np.arange(self.times_s[0], self.times_s[-1], period_s)
        even = np.column_stack([np.interp(times_s, self.times_s, column) for column in self.numbers.T])
        return PoseTrack(times_s, savgol_filter(even, window, 3, axis=0))

    def at_time(self, time_s: float) -> Float64:
        """Return T_base_tool (4, 4), mm, at a time."""
        n = min(max(int(np.searchsorted(self.times_s, time_s)), 1), len(self.times_s) - 1)
        first_s, last_s = float(self.times_s[n - 1]), float(self.times_s[n])
        share = min(max((time_s - first_s) / (last_s - first_s), 0.0), 1.0)
        numbers = (1.0 - share) * self.numbers[n - 1] + share * self.numbers[n]
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat(numbers[3:]).as_matrix()
        T[:3, 3] = numbers[:3]
        return T

    def covers(self, times_s: Float64) -> Bool:
        """Return the mask (n,) of times between the first and the last pose."""
        return np.asarray((times_s >= self.times_s[0]) & (times_s <= self.times_s[-1]))


@dataclass(frozen=True, eq=False)
class PoseDelay:
    """The estimate: a frame's pose is the one that the controller stamps `delay_s` after the frame's time.

    `sigma_s` is 1 sigma; `unestimated` says in words why the delay is not known, None where it is. `delays_s`
    (g,) and `ln_likelihood` (g,), 0 at its maximum, are the curve. `observations` are the seam points, and
    `bends_mm` and `scatters_mm` (2,) what the seam bends and its points scatter by, sideways and in height.
    """

    delay_s: float
    sigma_s: float
    unestimated: str | None
    delays_s: Float64
    ln_likelihood: Float64
    observations: SeamObservations
    bends_mm: Float64
    scatters_mm: Float64
    motion_mm_s: float


def estimate_pose_delay(
    setup: Setup,
    frames: Sequence[Frame],
    track: PoseTrack,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> PoseDelay:
    """Track a recording and estimate its delay, in turn, until the delay stays.

    Raises ValueError where the seam is seen in too few frames.
    """
    delay_s = setup.effects.get("pose_delay", {}).get("delay_s", 0.0)
    # A better delay lets the tracker find more.
    n_rounds = 4
    for done in range(n_rounds):
        progress(done, n_rounds)
        here = with_delay(setup, delay_s)
        observations = SeamObservations.of(here, frames, [track.at_time] * len(frames))
        result = fit_pose_delay(here, observations, track)
        moved_s, delay_s = abs(result.delay_s - delay_s), result.delay_s
        if result.unestimated is not None or moved_s < result.sigma_s:
            break
    progress(n_rounds, n_rounds)
    return result


def with_delay(setup: Setup, delay_s: float) -> Setup:
    """Return the setup with a delay of the poses' clock."""
    return replace(setup, effects={**setup.effects, "pose_delay": {"delay_s": delay_s}})


def fit_pose_delay(setup: Setup, observations: SeamObservations, track: PoseTrack) -> PoseDelay:
    """Return the delay that puts seam points on one smooth seam; ValueError for fewer than `MIN_SEEN`."""
    smooth = track.smooth()
    observations = replace(observations, poses=(smooth.at_time,) * len(observations.image_px))
    # A grid's step within the bounds: derivatives look to either side.
    grid = np.arange(DELAY.lower + GRID_S, DELAY.upper - 0.5 * GRID_S, GRID_S)
    bends, scatters = np.array(BEND_MM), np.full(2, POINT_SCATTER_MM)
    delay_s = 0.0
    for _ in range(2):
        # What a delay takes out of the poses' time is left out, once a delay is known.
        problem = _DelayProblem(setup, _with_pose(observations, smooth, delay_s)).with_moves(delay_s)
        seen = [problem.seam_points(float(d)) for d in grid]
        for _ in range(2):
            curve = np.array([problem.ln_likelihood(*points, bends, scatters) for points in seen])
            best = int(np.argmax(curve))
            bends, scatters = problem.nuisances(*seen[best], bends, scatters)
        delay_s, sigma_s = problem.refine(float(grid[best]), bends, scatters)
    curve = np.array([problem.ln_likelihood(*points, bends, scatters) for points in seen])
    highest = problem.ln_likelihood(*problem.seam_points(delay_s), bends, scatters)
    rival_s = problem.rival(grid, curve - highest, delay_s, sigma_s, bends, scatters)
    motion = problem.motion_mm_s(delay_s)
    place = int(np.searchsorted(grid, delay_s))
    return PoseDelay(
        delay_s=delay_s,
        sigma_s=sigma_s,
        unestimated=_reason_unestimated(grid, rival_s, delay_s, sigma_s, motion),
        delays_s=np.insert(grid, place, delay_s),
        ln_likelihood=np.insert(curve - highest, place, 0.0),
        observations=problem.observations,
        bends_mm=bends,
        scatters_mm=scatters,
        motion_mm_s=motion,
    )


def _with_pose(observations: SeamObservations, track: PoseTrack, delay_s: float) -> SeamObservations:
    """Return the seam points of frames whose pose is known about a delay; ValueError for too few."""
    kept = np.flatnonzero(track.covers(observations.timestamps_s + delay_s))
    if len(kept) < MIN_SEEN:
        raise ValueError(
            f"the seam is seen in {len(kept)} frames with a pose, {MIN_SEEN} are needed: record more frames "
            "with the laser on; `arctrack check` says why there are so few"
        )
    return SeamObservations(
        observations.image_px[kept],
        observations.timestamps_s[kept],
        observations.variances_mm2[kept],
        tuple(observations.poses[n] for n in kept),
    )


def _reason_unestimated(
    grid: Float64, rival_s: float | None, delay_s: float, sigma_s: float, motion_mm_s: float
) -> str | None:
    """Return the reason for which a delay is not known, None where it is."""
    if not sigma_s <= MAX_SIGMA_S:
        wanted = f"some {motion_mm_s * sigma_s / MAX_SIGMA_S:.1f}" if math.isfinite(sigma_s) else "some 5"
        return (
            f"the motion is too weak: across the seam and in height the tool moves by {motion_mm_s:.1f} "
            f"mm/s (RMS), {wanted} are needed; weave it sideways while it travels, or record more frames"
        )
    if not grid[1] < delay_s < grid[-2]:
        return (
            f"no delay from {grid[0]:g} to {grid[-1]:g} s puts the seam in place: are poses and frames of "
            "one run?"
        )
    if rival_s is not None:
        return (
            f"the motion repeats: {delay_s:.3f} s and {rival_s:.3f} s put the seam in place as well; move "
            "unevenly, or record for longer"
        )
    return None


@dataclass(frozen=True, eq=False)
class _DelayProblem:
    """Seam points and what moves them; `moves_mm` (m, n, 2) is by the calibration's independent errors."""

    setup: Setup
    observations: SeamObservations
    moves_mm: Float64 | None = None

    def seam_points(self, delay_s: float) -> tuple[Float64, Float64]:
        """Return stations (n,) and displacements (n, 2), mm, for a delay."""
        return self.observations.in_joint(with_delay(self.setup, delay_s))

    def with_moves(self, delay_s: float) -> _DelayProblem:
        """Return the problem with what errors of the calibration, 1 sigma each, do at a delay."""
        here, covariance = with_delay(self.setup, delay_s), self.setup.calibration_errors
        _, unmoved = self.observations.in_joint(here)
        moves = [
            self.observations.in_joint(here.with_errors(covariance.errors(sizes)))[1] - unmoved
            for sizes in np.eye(len(covariance.modes))
        ]
        return replace(self, moves_mm=np.reshape(moves, (-1, *unmoved.shape)))

    def ln_likelihood(
        self, stations: Float64, displacements: Float64, bends_mm: Float64, scatters_mm: Float64
    ) -> float:
        """Return the likelihood's logarithm of points as a delay puts them."""
        if not np.isfinite(displacements).all():
            return -math.inf
        return sum(
            self._of_axis(axis, stations, displacements, bends_mm[axis], scatters_mm[axis]) for axis in (0, 1)
        )

    def _of_axis(
        self, axis: int, stations: Float64, displacements: Float64, bend_mm: float, scatter_mm: float
    ) -> float:
        factor = self._factor(axis, stations, bend_mm, scatter_mm)
        y = displacements[:, axis]
        return float(-0.5 * y @ cho_solve(factor, y) - np.sum(np.log(np.diag(factor[0]))))

    def _factor(
        self, axis: int, stations: Float64, bend_mm: float, scatter_mm: float
    ) -> tuple[Float64, bool]:
        """Return Cholesky's factor of the covariance of an axis' displacements."""
        assert self.moves_mm is not None
        H = self.moves_mm[..., axis]
        middle = 0.5 * float(stations.min() + stations.max())
        covariance = prior_covariance(stations, stations, middle, bend_mm) + H.T @ H
        covariance += np.diag(self.observations.variances_mm2[:, axis] + scatter_mm**2)
        factor: tuple[Float64, bool] = cho_factor(covariance, lower=True)
        return factor

    def refine(self, delay_s: float, bends_mm: Float64, scatters_mm: Float64) -> tuple[float, float]:
        """Return the likeliest delay near one of the grid's, and its 1 sigma."""

        def loss(other_s: float) -> float:
            return -self.ln_likelihood(*self.seam_points(other_s), bends_mm, scatters_mm)

        near_s = np.clip([delay_s - GRID_S, delay_s + GRID_S], DELAY.lower + GRID_S, DELAY.upper - GRID_S)
        best_s = float(minimize_scalar(loss, bounds=near_s, method="bounded", options={"xatol": 1e-6}).x)
        stations, _ = self.seam_points(best_s)
        J, information = self._speeds(best_s), 0.0
        for axis in (0, 1):
            factor = self._factor(axis, stations, bends_mm[axis], scatters_mm[axis])
            information += float(J[:, axis] @ cho_solve(factor, J[:, axis]))
        return best_s, 1.0 / math.sqrt(information) if information > 0.0 else math.inf

    def rival(
        self,
        grid_s: Float64,
        curve: Float64,
        delay_s: float,
        sigma_s: float,
        bends_mm: Float64,
        scatters_mm: Float64,
    ) -> float | None:
        """Return another delay that is almost as likely, None if there is none.

        `curve` (g,) is the likelihood's logarithm at `grid_s` (g,), below its maximum.
        """
        inner = curve[1:-1]
        peaks = 1 + np.flatnonzero((inner >= curve[:-2]) & (inner >= curve[2:]))
        # The three next highest maxima: one leaves two answers within 3 nats, 5 sigmas away.
        for n in peaks[np.argsort(-curve[peaks])][:3]:
            other_s, _ = self.refine(float(grid_s[n]), bends_mm, scatters_mm)
            if abs(other_s - delay_s) <= max(5.0 * sigma_s, GRID_S):
                continue
            below = self.ln_likelihood(
                *self.seam_points(delay_s), bends_mm, scatters_mm
            ) - self.ln_likelihood(*self.seam_points(other_s), bends_mm, scatters_mm)
            if below < 3.0:
                return other_s
        return None

    def _speeds(self, delay_s: float) -> Float64:
        """Return the derivative (n, 2), mm/s, of the displacements with the delay."""
        step_s = 0.5 * GRID_S
        _, later = self.seam_points(delay_s + step_s)
        _, earlier = self.seam_points(delay_s - step_s)
        return np.asarray((later - earlier) / (2.0 * step_s))

    def nuisances(
        self, stations: Float64, displacements: Float64, bends_mm: Float64, scatters_mm: Float64
    ) -> tuple[Float64, Float64]:
        """Return the likeliest bends and scatters (2,), mm, of points as a delay puts them."""
        bounds = [np.log((1e-3, 5.0)), np.log((1e-3, 2.0))]
        best = []
        for axis in (0, 1):
            usual = np.log([BEND_MM[axis], POINT_SCATTER_MM])

            def loss(ln: Float64, axis: int = axis, usual: Float64 = usual) -> float:
                # Short seams hardly determine either: both are known to a factor of e.
                pull = 0.5 * float(np.sum((ln - usual) ** 2))
                return pull - self._of_axis(axis, stations, displacements, *np.exp(ln))

            start = np.log([bends_mm[axis], scatters_mm[axis]])
            result = minimize(loss, start, bounds=bounds, method="L-BFGS-B", options={"maxiter": 20})
            best.append(np.exp(result.x))
        chosen = np.array(best)
        return chosen[:, 0], chosen[:, 1]

    def motion_mm_s(self, delay_s: float) -> float:
        """Return the RMS speed, mm/s, of the seam points with the delay, across and in height."""
        speed = self._speeds(delay_s)
        # A tool that slides evenly to the side makes the seam slant, no more.
        return float(np.sqrt(np.mean((speed - speed.mean(axis=0)) ** 2)) * math.sqrt(2.0))
