"""The laser sheet from pairs of images of a board, without and with the laser: a plane, or a bowed one.

The bow is taken where the boards ask for it: each board is left out in turn, and its stripe is nearer to the
bowed sheet of the others than to their plane, in the RMS over all; and the bow is sure.
"""

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
from calibration.laser.plane import MIN_PAIRS, BoardLine, LaserStand, SheetFit, consistent, fit_sheet
from calibration.laser.stripe import BoardStripe
from calibration.outliers import FALSE_ALARM
from calibration.threads import one_thread
from noise_model.compiled.arrays import Float64

MIN_SPREAD = 10.0
"""The stripes' scatter from one line over what noise alone makes of it: below it, the sheet follows noise."""


SURE_SIGMAS = 4.0
"""A bow of fewer sigmas may be none: pairs are few, so the sigma is rough."""


@dataclass(frozen=True)
class Bow:
    """The sheet's bow as the boards show it, `value` with 1 sigma, whether or not the sheet has it.

    `held_out_mm` are the RMS distances of each board's stripe from the plane, and from the bowed sheet, of
    all other boards.
    """

    value: float
    sigma: float
    held_out_mm: tuple[float, float]

    @property
    def is_taken(self) -> bool:
        """True if boards that were held out are nearer to a bowed sheet, and the bow is sure."""
        flat_mm, bowed_mm = self.held_out_mm
        return bowed_mm < flat_mm and abs(self.value) > SURE_SIGMAS * self.sigma


@dataclass(frozen=True)
class LaserCalibration:
    """Calibrated laser sheet and its uncertainty.

    `fit` is the sheet in the camera frame with the pairs' covariance, which `scatter` >= 1 scales over their
    noise; its bow counts from `stand`, and `bow` says why it has one or none, None where the pairs do not
    determine any. `per_lens` (5, k) are derivatives of plane and bow by the lens' parameters, boards' poses
    and stripes included; `lens_covariance` (k, k) is zeros for an exact lens. The pairs used have `names` of
    their images without the laser, `stripes` of the points on a line, `lines` on the boards, `points_mm`
    (n, 3) in the camera frame, and 1 sigma of a corner (k,). `left_out` maps the others to the reason.
    """

    fit: SheetFit
    stand: LaserStand
    bow: Bow | None
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
        """Covariance (5, 5) of plane and bow."""
        return np.asarray(self.own_covariance + self.per_lens @ self.lens_covariance @ self.per_lens.T)

    @property
    def own_covariance(self) -> Float64:
        """Their covariance (5, 5) were the lens exact."""
        return np.asarray(self.scatter * self.fit.covariance)

    @property
    def off_mm(self) -> tuple[Float64, ...]:
        """Distance of each pair's points from the sheet."""
        return tuple(off_sheet_mm(self.fit, self.stand, points) for points in self.points_mm)

    @property
    def rms_mm(self) -> float:
        """The RMS distance of all points from the sheet."""
        return float(np.sqrt(np.mean(np.concatenate(self.off_mm) ** 2)))

    @property
    def half_mm(self) -> float:
        """Half the median stripe's length."""
        return 0.5 * float(np.median([np.linalg.norm(np.ptp(each, axis=0)) for each in self.points_mm]))

    @property
    def ends_mm(self) -> float:
        """Distance of a sheet with a bow of 1 from its plane at half the median stripe's length."""
        depth_mm = (self.stand.origin_mm - np.concatenate(self.points_mm)) @ self.stand.up
        return self.half_mm**2 / float(np.median(depth_mm))

    def in_tool(self, T_tool_camera: Float64, stated: Float64) -> tuple[Float64, float, Float64]:
        """Return plane (4,), bow and their covariance (5, 5) in the tool frame; the camera's pose is exact.

        The normal points as that of the plane (4,) `stated` does.
        """
        R, t = T_tool_camera[:3, :3], T_tool_camera[:3, 3]
        to_tool = np.eye(5)
        to_tool[:3, :3], to_tool[3, :3] = R, -t @ R
        sheet = to_tool @ [*self.plane, self.fit.bow]
        sign = 1.0 if sheet[:3] @ stated[:3] >= 0.0 else -1.0
        return sign * sheet[:4], sign * float(sheet[4]), to_tool @ self.covariance @ to_tool.T

    def distance_sigma_mm(self, points_mm: Float64) -> Float64:
        """Return 1 sigma of the sheet's place along its normal at points (n, 3), mm, camera frame."""
        rise_mm = self.stand.rise_mm(self.plane[:3], points_mm)
        row = np.column_stack([points_mm, np.ones(len(points_mm)), -rise_mm])
        return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", row, self.covariance, row)))


def calibrate_laser(
    scene: BoardScene,
    seen: Sightings,
    stripes: Mapping[str, BoardStripe],
    stand: LaserStand,
    lens_covariance: Float64 | None = None,
) -> LaserCalibration:
    """Calibrate the laser sheet in the camera frame from stripes on boards with known poses.

    `scene` is from `board_poses`; `stripes` is by view, and views without one are not used. A bow counts from
    `stand`. Without `lens_covariance` (n, n) the lens counts as exact. Raises UndeterminedError, which names
    the missing pair, if the pairs do not determine the plane.
    """
    chosen = [n for n, name in enumerate(seen.names) if name in stripes]
    _check_count(len(chosen))
    scene, seen = scene.select_views(chosen), seen.select_views(chosen)
    shown = [stripes[name] for name in seen.names]
    check_corners(scene, seen)
    with one_thread():
        sigma_px = corner_sigmas_px(scene, seen)
        try:
            sheet = _flat_sheet(scene, seen, shown)
        except np.linalg.LinAlgError:
            raise UndeterminedError(_on_one_line(0.0)) from None
        bowed, bow = _bowed_sheet(scene, seen, shown, stand)
        if bowed is not None and bow is not None and bow.is_taken:
            sheet = bowed
        fit, kept, lines = sheet
        scatter = _scatter(fit)
        # A part 10 mm off the boards would be 0.09 mm off.
        is_loose = math.degrees(fit.tilt_sigma * math.sqrt(scatter)) > 0.5
        if is_loose or fit.spread_mm < MIN_SPREAD * fit.spread_noise_mm:
            raise UndeterminedError(_on_one_line(fit.spread_mm))
        left_out = {
            name: "its stripe does not lie in the sheet of the others: the board moved between its images, "
            "or a reflection was taken for the stripe"
            for n, name in enumerate(seen.names)
            if n not in kept
        }
        scene, seen = scene.select_views(kept), seen.select_views(kept)
        shown = [shown[n] for n in kept]
        known_lens = np.zeros((len(scene.lens.values),) * 2) if lens_covariance is None else lens_covariance
        per_lens = _per_lens(scene, seen, shown, known_lens, fit, stand)
    lines = [lines[n] for n in kept]
    stripes_kept = tuple(
        replace(stripe, points_px=stripe.points_px[line.line.kept])
        for stripe, line in zip(shown, lines, strict=True)
    )
    return LaserCalibration(
        fit=fit,
        stand=stand,
        bow=bow,
        lens=scene.lens,
        per_lens=per_lens,
        lens_covariance=known_lens,
        scatter=scatter,
        names=seen.names,
        stripes=stripes_kept,
        lines=tuple(lines),
        points_mm=tuple(_points_mm(scene.lens, shown, lines)),
        corner_sigma_px=sigma_px[kept],
        left_out=left_out,
    )


_FittedSheet = tuple[SheetFit, list[int], list[BoardLine]]
"""A sheet, the numbers of the boards that lie in it, and the stripes' courses on all boards."""


def _flat_sheet(scene: BoardScene, seen: Sightings, stripes: Sequence[BoardStripe]) -> _FittedSheet:
    lines = _board_lines(scene, seen, stripes, degree=1)
    kept = consistent(lines)
    return fit_sheet([lines[n] for n in kept]), kept, lines


def _bowed_sheet(
    scene: BoardScene, seen: Sightings, stripes: Sequence[BoardStripe], stand: LaserStand
) -> tuple[_FittedSheet | None, Bow | None]:
    """Return the sheet with the bow that fits best, and what the boards say of it; None if undetermined."""
    curves = _board_lines(scene, seen, stripes, degree=2)
    straight = _board_lines(scene, seen, stripes, degree=1)
    try:
        kept = consistent(curves, stand)
        fit = fit_sheet([curves[n] for n in kept], stand)
        points = _points_mm(scene.lens, stripes, curves)
        held_out = [
            _held_out_mm([each[n] for n in kept], [points[n] for n in kept], stand, with_stand)
            for each, with_stand in ((straight, None), (curves, stand))
        ]
    except np.linalg.LinAlgError:
        return None, None
    sigma = math.sqrt(_scatter(fit) * fit.covariance[4, 4])
    return (fit, kept, curves), Bow(fit.bow, sigma, (held_out[0], held_out[1]))


def _held_out_mm(
    lines: Sequence[BoardLine], points_mm: Sequence[Float64], stand: LaserStand, with_stand: LaserStand | None
) -> float:
    """Return the RMS distance of each board's points from the sheet of all others."""
    squares = []
    for n, points in enumerate(points_mm):
        fit = fit_sheet([line for k, line in enumerate(lines) if k != n], with_stand)
        squares.append(float(np.mean(off_sheet_mm(fit, stand, points) ** 2)))
    return math.sqrt(float(np.mean(squares)))


def off_sheet_mm(fit: SheetFit, stand: LaserStand, points_mm: Float64) -> Float64:
    """Return the distances (n,) of points (n, 3) from a sheet."""
    off = points_mm @ fit.plane[:3] + fit.plane[3]
    return np.asarray(off - fit.bow * stand.rise_mm(fit.plane[:3], points_mm))


def _points_mm(lens: Lens, stripes: Sequence[BoardStripe], lines: Sequence[BoardLine]) -> list[Float64]:
    """Return the points (n, 3) on the boards, camera frame, of stripes as they are or of their kept ones."""
    return [
        line.points(lens.rays(stripe.points_px[line.line.kept]))
        for stripe, line in zip(stripes, lines, strict=True)
    ]


def _board_lines(
    scene: BoardScene, seen: Sightings, stripes: Sequence[BoardStripe], degree: int
) -> list[BoardLine]:
    """Return the stripes' courses on their boards."""
    sigma_px = corner_sigmas_px(scene, seen)
    motion = linearise(scene, seen, 1.0 / sigma_px[seen.view]).motion
    return [
        BoardLine(fit_line(scene.lens.rays(stripe.points_px), stripe.along_rows, degree), T, covariance)
        for stripe, T, covariance in zip(stripes, scene.T_camera_board, np.linalg.inv(motion), strict=True)
    ]


def _per_lens(
    scene: BoardScene,
    seen: Sightings,
    stripes: Sequence[BoardStripe],
    lens_covariance: Float64,
    fit: SheetFit,
    stand: LaserStand,
) -> Float64:
    """Return derivatives (5, k) of plane and bow by the lens' values that are not exact, others are 0."""
    is_bowed = fit.bow != 0.0

    def sheet_of(lens: Lens) -> Float64:
        other = adjust(replace(scene, lens=lens), seen, np.ones(len(seen)), poses_only=True)
        lines = _board_lines(other, seen, stripes, degree=2 if is_bowed else 1)
        moved = fit_sheet(lines, stand if is_bowed else None)
        sign = np.sign(moved.plane[:3] @ fit.plane[:3])
        return np.asarray(sign * np.array([*moved.plane, moved.bow]))

    return scene.lens.derivatives(lens_covariance, sheet_of)


def _scatter(fit: SheetFit) -> float:
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
