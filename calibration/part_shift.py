"""Rigid shift of a part by points found on it against the same points found on the master part.

A point anywhere along a seam tells where the part lies across the seam, not along it; a start, an end or a
corner tells both. Its direction, where two sections were seen, and its faces tell how the part is turned.
With u = T^-1 f, a found point f taken back to the master, the residuals across the master's seam at m are
N (u - m), those of a direction d are N R^T d, and that of a face's line l is n . R^T l. They are weighed by
the covariance of both finds; the master's direction counts by how far the part lies off along it. What the
calibration has wrong moves both finds, and cancels where one sensor found both from like poses.

The least squares in SE(3) go by Gauss-Newton steps of a twist about the points' middle. One wrong point is
named by the likelihood ratio of leaving it out, and its p-value by chi-squared. What one wrong point may do
unnoticed is Baarda's external reliability (Baarda 1968, A testing procedure for use in geodetic networks).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from calibration.outliers import FALSE_ALARM
from calibration.rigid import cross_matrices, motions
from noise_model.compiled.arrays import Bool, Float64
from noise_model.transforms import invert, transform
from tracker.find import FoundJoint
from tracker.seam.gaussian_process import MODEL_SIGMA_MM, SLOPE_SIGMA

FREEDOMS = ("rx", "ry", "rz", "x", "y", "z")
"""Names of a twist's parts: turns about base's axes, then displacements along them."""

FACE_MM, PLACES_MM = 10.0, 20.0
"""Lengths over which a face and a direction are seen: over them a point's own scatter makes an angle's."""

SURE_99 = math.sqrt(float(chi2.ppf(0.99, 1)))
"""Sigmas within which 99 % of a normal error lies."""

SURE_NAME = 2.0 * math.log(1.0 / FALSE_ALARM)
"""Chi-squared by which the likeliest wrong point must beat the next one to be named."""

MAX_STEPS, STEP_MM = 30, 1e-7


class PartPoint(NamedTuple):
    """A point that was found on the master part and on the part.

    Attributes
    ----------
    name : str
        Its name.
    master, part : FoundJoint
        The finds.
    """

    name: str
    master: FoundJoint
    part: FoundJoint


class ShiftError(ValueError):
    """Points that do not tell the shift; the text says why, and what point would help."""


class WrongPoint(NamedTuple):
    """A point that was left out, and the probability that a right one lies so far off the others."""

    name: str
    p_value: float

    def __str__(self) -> str:
        return f"{self.name} is wrong ({_p_text(self.p_value)})"


@dataclass(frozen=True, eq=False)
class PartShift:
    """Rigid shift of a part.

    Attributes
    ----------
    T_shift : array (4, 4)
        It takes the master's points, and the program's, to the part, mm, base.
    center_mm : array (3,)
        The middle of the part's points.
    covariance : array (6, 6)
        Of a small turn about the middle, rad, and a displacement, mm, behind the shift.
    sigma_mm : float
        The largest 1 sigma of a point of the program, in its worst direction.
    unnoticed_mm : float
        How far one wrong point may displace the program before it is noticed in 99 of 100 cases.
    chi2, redundancy : float, int
        The residuals' chi-squared, and its degrees of freedom.
    wrong : WrongPoint or None
        The point that was left out.
    """

    T_shift: Float64
    center_mm: Float64
    covariance: Float64
    sigma_mm: float
    unnoticed_mm: float
    chi2: float
    redundancy: int
    wrong: WrongPoint | None = None


def find_shift(
    points: Sequence[PartPoint],
    program_mm: Float64 | None = None,
    within_mm: float = 0.25,
    scatter_mm: float = 0.0,
    free: Sequence[str] = FREEDOMS,
) -> PartShift:
    """Return the rigid shift of a part; one wrong point is left out.

    Parameters
    ----------
    points : sequence of PartPoint
        The same points on both parts.
    program_mm : array (n, 3), optional
        Points of the program, mm, base: all of it must be known `within_mm`. By default the master's points.
    within_mm : float
        99 % of the program's errors must be within this.
    scatter_mm : float
        1 sigma by which a part's points lie off the master's shape, as parts differ.
    free : sequence of str
        Freedoms of the part, of `FREEDOMS`; the others are none, as of a part that lies on a table.

    Returns
    -------
    PartShift
        The shift with its covariance.

    Raises
    ------
    ShiftError
        Where the points do not determine the shift: it names the direction, and the point that would tell it.
        Where they contradict each other, and it cannot be told which is wrong.
    """
    masters_mm = np.array([point.master.point_base_mm for point in points])
    program = masters_mm if program_mm is None else program_mm
    fit = _Fit(points, scatter_mm, np.array([name in free for name in FREEDOMS]))
    wrong = None
    if fit.p_value < FALSE_ALARM:
        n, p_value, fit = _without_wrong(points, fit)
        wrong = WrongPoint(points[n].name, p_value)
    places_mm = transform(fit.T, program) - fit.center_mm
    sigma_mm = float(_sigmas_mm(fit.covariance, places_mm).max())
    if not SURE_99 * sigma_mm <= within_mm:
        subject = "the points" if wrong is None else f"{wrong}, and the others"
        raise ShiftError(subject + _undetermined(fit, places_mm, within_mm))
    return PartShift(
        T_shift=fit.T,
        center_mm=fit.center_mm,
        covariance=fit.covariance,
        sigma_mm=sigma_mm,
        unnoticed_mm=fit.unnoticed_mm(places_mm),
        chi2=fit.chi2,
        redundancy=fit.redundancy,
        wrong=wrong,
    )


class _Rows(NamedTuple):
    """Residuals (k,) of a point, the first `n_place` of its place, and their own covariance (k, k).

    They change by a twist (k, 6), and by errors of the calibration (k, m).
    """

    residuals: Float64
    jacobian: Float64
    covariance: Float64
    by_calibration: Float64
    n_place: int


class _Fit:
    """Least squares of some points; what they do not determine of the shift stays at none."""

    def __init__(self, points: Sequence[PartPoint], scatter_mm: float, free: Bool) -> None:
        self.points, self.scatter_mm, self.free = points, scatter_mm, free
        self.T = np.eye(4)
        self.center_mm = np.mean([point.part.point_base_mm for point in points], axis=0)
        for _ in range(MAX_STEPS):
            self._weigh()
            step = np.zeros(6)
            step[free] = -np.linalg.lstsq(self._jacobian, self._residuals, rcond=1e-9)[0] * self._scale
            about = np.eye(4)
            about[:3, 3] = self.center_mm
            self.T = about @ motions(step[np.newaxis])[0] @ invert(about) @ self.T
            if np.abs(step / np.where(np.arange(6) < 3, 1e-2, 1.0)).max() < STEP_MM:
                break
        self._weigh()
        self.chi2 = float(self._residuals @ self._residuals)
        # What is not determined takes no residual away.
        rank = int(np.linalg.matrix_rank(self._jacobian, tol=1e-9 * np.linalg.norm(self._jacobian)))
        self.redundancy = len(self._residuals) - rank
        self.p_value = float(chi2.sf(self.chi2, self.redundancy)) if self.redundancy else 1.0
        _, values, axes = np.linalg.svd(self._jacobian, full_matrices=True)
        values = np.pad(values, (0, axes.shape[0] - len(values)))
        # One over the least information that counts: a kilometre is as good as not known.
        modes = axes.T * self._scale[:, np.newaxis] / np.maximum(values, 1e-6)
        self.modes = np.zeros((6, modes.shape[1]))
        self.modes[free] = modes
        self.covariance = self.modes @ self.modes.T

    def _weigh(self) -> None:
        """Compute the residuals and their derivatives, whitened; turns are scaled by the points' lever."""
        rows = [_rows(point, self.T, self.center_mm, self.scatter_mm) for point in self.points]
        by_calibration = np.concatenate([each.by_calibration for each in rows])
        covariance = block_diag(*(each.covariance for each in rows)) + by_calibration @ by_calibration.T
        self._root = np.linalg.cholesky(covariance)
        lever_mm = [np.linalg.norm(point.part.point_base_mm - self.center_mm) for point in self.points]
        self._scale = np.where(np.arange(6) < 3, 1.0 / max(float(np.max(lever_mm)), FACE_MM), 1.0)[self.free]
        jacobian = np.concatenate([each.jacobian for each in rows])[:, self.free] * self._scale
        self._residuals = np.linalg.solve(self._root, np.concatenate([each.residuals for each in rows]))
        self._jacobian = np.linalg.solve(self._root, jacobian)
        starts = np.cumsum([0, *(len(each.residuals) for each in rows)])
        self._places = [slice(start, start + each.n_place) for start, each in zip(starts, rows, strict=False)]

    def without(self, n: int) -> _Fit:
        """Return the fit of the other points."""
        return _Fit([*self.points[:n], *self.points[n + 1 :]], self.scatter_mm, self.free)

    def unnoticed_mm(self, places_mm: Float64) -> float:
        """Return the largest displacement of places (n, 3) about the middle by one wrong point, unnoticed."""
        if not self.redundancy:
            return math.inf
        limit = chi2.isf(FALSE_ALARM, self.redundancy)
        # The noncentrality of a chi-squared that exceeds its limit in 99 of 100 cases.
        size = brentq(lambda size: ncx2.sf(limit, self.redundancy, size) - 0.99, 1.0, 1e4)
        gain = np.linalg.pinv(self._jacobian)
        kept = np.eye(len(self._residuals)) - self._jacobian @ gain
        worst = 0.0
        for place in self._places:
            bias = np.linalg.inv(self._root)[:, place]
            noticed = bias.T @ kept @ bias
            twist = np.zeros((6, bias.shape[1]))
            twist[self.free] = self._scale[:, np.newaxis] * (gain @ bias)
            # An error that the residuals do not show at all is bounded by nothing.
            shares, axes = np.linalg.eigh(noticed)
            errors = axes * np.sqrt(size / np.maximum(shares, 1e-9 * np.trace(bias.T @ bias)))
            worst = max(worst, float(_norms_mm(twist @ errors, places_mm).max()))
        return worst


def _rows(point: PartPoint, T: Float64, center_mm: Float64, scatter_mm: float) -> _Rows:
    """Return the residuals of a point at a shift (4, 4); a twist turns about a middle (3,), mm."""
    master, part, R_back = point.master, point.part, T[:3, :3].T
    first = 1 if master.kind == "seam" else 0
    across, along = master.axes_base[first:], master.axes_base[0]
    off_mm = transform(invert(T), part.point_base_mm) - master.point_base_mm
    turned, is_known = master.direction_covariance, bool(np.isfinite(master.direction_covariance).all())
    if not is_known:
        turned = SLOPE_SIGMA**2 * np.eye(2)
    back = across @ R_back
    of_part = back @ part.axes_base[first:].T
    covariance = of_part @ part.covariance_mm2[first:, first:] @ of_part.T
    covariance += master.covariance_mm2[first:, first:] + scatter_mm**2 * np.eye(3 - first)
    if first:
        # Off along the seam the master's direction tells where across it is.
        covariance += (along @ off_mm) ** 2 * turned
    residuals, blocks = [across @ off_mm], [covariance]
    lever = cross_matrices((part.point_base_mm - center_mm)[np.newaxis])[0]
    jacobian = [np.hstack([back @ lever, -back])]
    angle2 = (scatter_mm / PLACES_MM) ** 2
    if first and is_known and np.isfinite(part.direction_covariance).all():
        residuals.append(across @ R_back @ part.axes_base[0])
        jacobian.append(_of_turn(back, part.axes_base[0]))
        blocks.append(part.direction_covariance + turned + angle2 * np.eye(2))
    for n in range(2):
        variance = part.face_sigmas_rad[n] ** 2 + master.face_sigmas_rad[n] ** 2
        if not math.isfinite(variance):
            continue
        normal = np.cross(along, master.faces_base[n])
        normal /= np.linalg.norm(normal)
        seen = R_back @ part.faces_base[n]
        aslant = along @ (seen - master.faces_base[n])
        residuals.append(np.array([normal @ seen]))
        jacobian.append(_of_turn(normal[np.newaxis] @ R_back, part.faces_base[n]))
        variance += aslant**2 * turned[1, 1] + (MODEL_SIGMA_MM**2 + scatter_mm**2) / FACE_MM**2
        blocks.append(np.array([[variance]]))
    stacked = np.concatenate(residuals)
    moves = [back @ part.calibration_base_mm.T, -across @ master.calibration_base_mm.T]
    is_one = part.calibration == master.calibration
    moved = moves[0] + moves[1] if is_one else np.hstack(moves)
    by_calibration = np.zeros((len(stacked), moved.shape[1]))
    by_calibration[: 3 - first] = moved
    return _Rows(stacked, np.concatenate(jacobian), block_diag(*blocks), by_calibration, 3 - first)


def _of_turn(back: Float64, direction: Float64) -> Float64:
    """Return the derivatives (k, 6) of a direction's (3,) components by a twist."""
    turn = back @ cross_matrices(direction[np.newaxis])[0]
    return np.hstack([turn, np.zeros_like(turn)])


def _without_wrong(points: Sequence[PartPoint], fit: _Fit) -> tuple[int, float, _Fit]:
    """Return the number of the one wrong point, its p-value, and the fit of the others.

    ShiftError where the others contradict each other too, and where another point may be the wrong one.
    """
    text = f"the points contradict each other ({_p_text(fit.p_value)})"
    others = [fit.without(n) for n in range(len(points))] if len(points) > 1 else []
    order = sorted(range(len(others)), key=lambda n: others[n].chi2)
    if not order or others[order[0]].p_value < FALSE_ALARM:
        raise ShiftError(f"{text}, and more than one is wrong; find them anew")
    best = others[order[0]]
    doubtful = [n for n in order if others[n].chi2 - best.chi2 < SURE_NAME]
    if len(doubtful) > 1:
        names = ", ".join(sorted(points[n].name for n in doubtful))
        raise ShiftError(f"{text}, and which of {names} is wrong cannot be told; find them anew, or one more")
    gained = fit.redundancy - best.redundancy
    return order[0], float(chi2.sf(fit.chi2 - best.chi2, gained)), best


def _norms_mm(twists: Float64, places_mm: Float64) -> Float64:
    """Return the largest displacements (n,) of places (n, 3) by unit combinations of twists (6, k)."""
    turns = np.einsum("nij,jk->nik", -cross_matrices(places_mm), twists[:3])
    return np.asarray(np.linalg.norm(turns + twists[3:], ord=2, axis=(1, 2)))


def _sigmas_mm(covariance: Float64, places_mm: Float64) -> Float64:
    values, axes = np.linalg.eigh(covariance)
    return _norms_mm(axes * np.sqrt(np.maximum(values, 0.0)), places_mm)


def _undetermined(fit: _Fit, places_mm: Float64, within_mm: float) -> str:
    """Return what points do not determine of the shift, and the point that would, for a sentence's end."""
    sizes = [float(_norms_mm(mode[:, np.newaxis], places_mm).max()) for mode in fit.modes.T]
    worst = int(np.argmax(sizes))
    turn, move = fit.modes[:3, worst], fit.modes[3:, worst]
    lever_mm = float(np.linalg.norm(places_mm, axis=1).max())
    if np.linalg.norm(turn) * max(lever_mm, FACE_MM) < 0.3 * np.linalg.norm(move):
        way = move / np.linalg.norm(move)
        what = f"a shift along {_text(way)}"
        cure = f"a point on a seam that runs across {_text(way)}"
    else:
        axis = turn / np.linalg.norm(turn)
        foot_mm = fit.center_mm + np.cross(turn, move) / (turn @ turn)
        what = f"a turn about the axis along {_text(axis)} through {_text(foot_mm, 0)} mm"
        cure = "a point away from that axis, on a seam that runs across its motion there"
    ends = []
    for point in fit.points:
        motion = move + np.cross(turn, point.part.point_base_mm - fit.center_mm)
        along = abs(point.part.axes_base[0] @ motion)
        if point.master.kind == "seam" and along > 0.5 * np.linalg.norm(motion) > 0.0:
            ends.append((along, point.name))
    if ends:
        cure = f"the start, the end or a corner of the seam at {max(ends)[1]}, or {cure}"
    known = f"to {SURE_99 * sizes[worst]:.2g} mm" if sizes[worst] < 1e3 else "not at all"
    return f" do not determine {what} within {within_mm:g} mm: it is known {known} (99 %); find {cure}"


def _p_text(p_value: float) -> str:
    return "p < 1e-9" if p_value < 1e-9 else f"p = {p_value:.1g}"


def _text(vector: Float64, digits: int = 2) -> str:
    return "(" + ", ".join(f"{round(float(value), digits) + 0.0:.{digits}f}" for value in vector) + ")"
