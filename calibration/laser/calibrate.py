"""The laser sheet's plane from pairs of images of a board, without and with the laser."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from calibration.camera.adjustment import BoardScene, adjust, linearise
from calibration.camera.enough import UndeterminedError
from calibration.camera.known_lens import check_corners
from calibration.camera.lens import Lens
from calibration.camera.noise import corner_sigmas_px
from calibration.camera.sightings import Sightings
from calibration.laser.image_line import fit_line
from calibration.laser.plane import MIN_PAIRS, BoardLine, PlaneFit, consistent, fit_plane
from calibration.laser.stripe import BoardStripe
from calibration.outliers import FALSE_ALARM
from calibration.threads import one_thread
from noise_model.compiled.arrays import Float64

MIN_SPREAD = 10.0
"""The stripes' scatter from one line over what noise alone makes of it: below it, the sheet follows noise."""


@dataclass(frozen=True)
class Bow:
    """The sheet's bow: distance of its ends from its middle along the plane's normal.

    Line lasers draw a smile, which a plane does not describe. `sigma_mm` follows from the scatter of pairs;
    `half_mm` is half the median stripe's length.
    """

    bow_mm: float
    sigma_mm: float
    half_mm: float

    @property
    def is_sure(self) -> bool:
        """True if the sheet is bent significantly."""
        # Pairs are few, so the sigma is rough.
        return abs(self.bow_mm) > 4.0 * self.sigma_mm


@dataclass(frozen=True)
class LaserCalibration:
    """Calibrated laser sheet and its uncertainty.

    `fit` is the plane in the camera frame with the pairs' covariance, which `scatter` >= 1 scales over their
    noise. `per_lens` (4, k) are the plane's derivatives by the lens' parameters, boards' poses and stripes
    included; `lens_covariance` (k, k) is zeros for an exact lens. The pairs used have `names` of their images
    without the laser, `stripes` of the points on a line, `lines` on the boards, `points_mm` (n, 3) in the
    camera frame, and 1 sigma of a corner (k,). `left_out` maps the others to the reason.
    """

    fit: PlaneFit
    lens: Lens
    per_lens: Float64
    lens_covariance: Float64
    scatter: float
    names: tuple[str, ...]
    stripes: tuple[BoardStripe, ...]
    lines: tuple[BoardLine, ...]
    points_mm: tuple[Float64, ...]
    corner_sigma_px: Float64
    left_out: dict[str, str]

    @property
    def plane(self) -> Float64:
        """The plane (4,), n.X + d = 0, camera frame, mm."""
        return self.fit.plane

    @property
    def covariance(self) -> Float64:
        """Its covariance (4, 4), of rank 3."""
        return np.asarray(self.own_covariance + self.per_lens @ self.lens_covariance @ self.per_lens.T)

    @property
    def own_covariance(self) -> Float64:
        """Its covariance (4, 4) were the lens exact."""
        return np.asarray(self.scatter * self.fit.covariance)

    @property
    def off_mm(self) -> tuple[Float64, ...]:
        """Distance of each pair's points from the plane."""
        return tuple(points @ self.plane[:3] + self.plane[3] for points in self.points_mm)

    @property
    def rms_mm(self) -> float:
        """The RMS distance of all points from the plane."""
        return float(np.sqrt(np.mean(np.concatenate(self.off_mm) ** 2)))

    @property
    def bow(self) -> Bow:
        """Bow of the sheet along the stripes."""
        return _fit_bow(self.points_mm, self.off_mm)

    def in_tool(self, T_tool_camera: Float64, stated: Float64) -> tuple[Float64, Float64]:
        """Return plane (4,) and covariance (4, 4) in the tool frame; the camera's pose counts as exact.

        The normal points as that of the plane (4,) `stated` does.
        """
        R, t = T_tool_camera[:3, :3], T_tool_camera[:3, 3]
        to_tool = np.zeros((4, 4))
        to_tool[:3, :3], to_tool[3, :3], to_tool[3, 3] = R, -t @ R, 1.0
        plane = to_tool @ self.plane
        sign = 1.0 if plane[:3] @ stated[:3] >= 0.0 else -1.0
        return sign * plane, to_tool @ self.covariance @ to_tool.T

    def distance_sigma_mm(self, points_mm: Float64) -> Float64:
        """Return 1 sigma of the plane's place along its normal at points (n, 3), mm, camera frame."""
        row = np.column_stack([points_mm, np.ones(len(points_mm))])
        return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", row, self.covariance, row)))


def calibrate_laser(
    scene: BoardScene,
    seen: Sightings,
    stripes: Mapping[str, BoardStripe],
    lens_covariance: Float64 | None = None,
) -> LaserCalibration:
    """Calibrate the laser sheet's plane in the camera frame from stripes on boards with known poses.

    `scene` is from `board_poses`; `stripes` is by view, and views without one are not used. Without
    `lens_covariance` (n, n) the lens counts as exact. Raises UndeterminedError, which names the missing pair,
    if the pairs do not determine the plane.
    """
    chosen = [n for n, name in enumerate(seen.names) if name in stripes]
    _check_count(len(chosen))
    scene, seen = scene.select_views(chosen), seen.select_views(chosen)
    shown = [stripes[name] for name in seen.names]
    check_corners(scene, seen)
    with one_thread():
        lines, sigma_px = _board_lines(scene, seen, shown)
        try:
            kept = consistent(lines)
            fit = fit_plane([lines[n] for n in kept])
        except np.linalg.LinAlgError:
            raise UndeterminedError(_on_one_line(0.0)) from None
        scatter = _scatter(fit)
        # A part 10 mm off the boards would be 0.09 mm off.
        is_loose = math.degrees(fit.tilt_sigma * math.sqrt(scatter)) > 0.5
        if is_loose or fit.spread_mm < MIN_SPREAD * fit.spread_noise_mm:
            raise UndeterminedError(_on_one_line(fit.spread_mm))
        left_out = {
            name: "its stripe does not lie in the plane of the others: the board moved between its images, "
            "or a reflection was taken for the stripe"
            for n, name in enumerate(seen.names)
            if n not in kept
        }
        scene, seen = scene.select_views(kept), seen.select_views(kept)
        shown = [shown[n] for n in kept]
        known_lens = np.zeros((len(scene.lens.values),) * 2) if lens_covariance is None else lens_covariance
        per_lens = _per_lens(scene, seen, shown, known_lens, fit.plane)
    lines = [lines[n] for n in kept]
    stripes_kept = tuple(
        replace(stripe, points_px=stripe.points_px[line.line.kept])
        for stripe, line in zip(shown, lines, strict=True)
    )
    points = tuple(
        line.points(scene.lens.rays(stripe.points_px))
        for stripe, line in zip(stripes_kept, lines, strict=True)
    )
    return LaserCalibration(
        fit=fit,
        lens=scene.lens,
        per_lens=per_lens,
        lens_covariance=known_lens,
        scatter=scatter,
        names=seen.names,
        stripes=stripes_kept,
        lines=tuple(lines),
        points_mm=points,
        corner_sigma_px=sigma_px[kept],
        left_out=left_out,
    )


def _board_lines(
    scene: BoardScene, seen: Sightings, stripes: Sequence[BoardStripe]
) -> tuple[list[BoardLine], Float64]:
    """Return the stripes' lines on their boards, and 1 sigma of a corner in each image."""
    sigma_px = corner_sigmas_px(scene, seen)
    motion = linearise(scene, seen, 1.0 / sigma_px[seen.view]).motion
    lines = [
        BoardLine(fit_line(scene.lens.rays(stripe.points_px), stripe.along_rows), T, covariance)
        for stripe, T, covariance in zip(stripes, scene.T_camera_board, np.linalg.inv(motion), strict=True)
    ]
    return lines, sigma_px


def _per_lens(
    scene: BoardScene,
    seen: Sightings,
    stripes: Sequence[BoardStripe],
    lens_covariance: Float64,
    plane: Float64,
) -> Float64:
    """Return the plane's derivatives (4, k) by the lens' values that are not exact, others are 0."""

    def plane_of(lens: Lens) -> Float64:
        other = adjust(replace(scene, lens=lens), seen, np.ones(len(seen)), poses_only=True)
        other_plane = fit_plane(_board_lines(other, seen, stripes)[0]).plane
        return np.asarray(other_plane * np.sign(other_plane[:3] @ plane[:3]))

    return scene.lens.derivatives(lens_covariance, plane_of)


def _scatter(fit: PlaneFit) -> float:
    """Return by what factor the covariance is too small, 1 where the lines' noise explains all."""
    total = float(fit.squares.sum())
    return total / fit.freedom if chi2.sf(total, fit.freedom) < FALSE_ALARM else 1.0


def _check_count(pairs: int) -> None:
    if pairs < MIN_PAIRS:
        raise UndeterminedError(
            f"{pairs} pair{'s show' if pairs != 1 else ' shows'} board and stripe: {MIN_PAIRS} at least "
            "are needed, and 8 are good; take more, with the board at other distances"
        )


def _on_one_line(spread_mm: float) -> str:
    return (
        f"the stripes of all boards lie within {spread_mm:.2g} mm of one line, and the sheet's lean about it "
        "is unknown: add a pair with the board nearer to the camera and one with it farther away, by a tenth "
        "of the distance or more"
    )


def _fit_bow(points_mm: Sequence[Float64], off_mm: Sequence[Float64]) -> Bow:
    """Return the mean bow over the median stripe, from a parabola fitted to each stripe.

    Each stripe has points (n, 3), which lie `off_mm` (n,) off the plane.
    """
    curvatures, halves = [], []
    for points, off in zip(points_mm, off_mm, strict=True):
        centred = points - points.mean(axis=0)
        along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
        curvatures.append(float(np.polyfit(along, off, 2)[0]))
        halves.append(0.5 * float(np.ptp(along)))
    half_mm = float(np.median(halves))
    spread = float(np.std(curvatures, ddof=1)) / math.sqrt(len(curvatures))
    return Bow(float(np.mean(curvatures)) * half_mm**2, spread * half_mm**2, half_mm)
