"""The camera's calibration from corners to a lens with its covariance, and what speaks against it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import chi2

from calibration.boards.board import Board
from calibration.boards.detect import MIN_CORNERS
from calibration.camera.adjustment import BoardScene, with_prior
from calibration.camera.enough import UndeterminedError, check_count, check_cover, check_focal_length
from calibration.camera.halves import MAX_RATIO, Difference, difference_of_halves, splits
from calibration.camera.lens import ORDERS, TILT
from calibration.camera.next_board import NextBoard, best_next_board
from calibration.camera.noise import CornerNoise, fit_robust, fit_scene, robust_noise, wrong_corners
from calibration.camera.normal_equations import scaled_inverse
from calibration.camera.order import DistortionScore, cross_validate
from calibration.camera.printed import has_distinct_ends, print_sigma_mm
from calibration.camera.projection import Knowledge, image_grid, rms_sigma
from calibration.camera.sightings import BoardView, Sightings
from calibration.camera.start import first_scene, with_better_poses
from calibration.held_out import choose_leanest
from calibration.outliers import FALSE_ALARM, MAX_OUTLIER_SHARE
from calibration.threads import one_thread
from noise_model.compiled.arrays import Float64

MAX_NOISE = 10.0
"""Ratio of an image's corner noise to the usual one at which it was moved, or its board misread."""

MAX_SIGMA_PX = 1.0
"""A distortion that leaves the projection less known than this, anywhere in the image, is not determined."""


@dataclass(frozen=True)
class WrongCorner:
    """A corner that was left out: of which image, which corner, and its residual (2,), px."""

    view: int
    corner: int
    point_px: Float64
    residual_px: Float64


@dataclass(frozen=True)
class CameraCalibration:
    """Calibrated lens and its uncertainty.

    `scene` and `seen` are of the images and corners used; `wrong` corners and `left_out` images (with
    reasons) are not. `order` is the distortion chosen from `ORDERS`, `scores` how well each one predicts.
    `known` is the corners' information at their noise; the covariance is larger by `scatter` >= 1, since
    images differ by more. `print_sigma_mm` is 1 sigma of the printing errors, 0 where corners are as stated.
    The projection is judged at `distance_mm`, the corners' median depth. `halves` compares halves of the
    images; `next_board` is the pose of the most useful further image.
    """

    scene: BoardScene
    seen: Sightings
    noise: CornerNoise
    order: str
    scores: list[DistortionScore]
    known: Knowledge
    scatter: float
    print_sigma_mm: float
    wrong: tuple[WrongCorner, ...]
    left_out: dict[str, str]
    distance_mm: float
    halves: list[Difference] = field(default_factory=list)
    next_board: NextBoard | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters of the covariance: those of the lens, then the warp along columns and rows."""
        return (*self.scene.lens.names, "warp_x_mm", "warp_y_mm")

    @property
    def covariance(self) -> Float64:
        """The covariance (m, m) of lens and warp."""
        n = len(self.names)
        return self.scatter * self.known.covariance()[:n, :n]

    @property
    def sigma(self) -> Float64:
        """1 sigma of lens and warp (m,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def rms_px(self) -> float:
        """The RMS distance of the corners used from where the scene puts them, px."""
        return self.scene.rms_px(self.seen)

    def sigma_map(self) -> tuple[Float64, Float64]:
        """Return points over the image (h, w, 2), px, and the projection's sigma there (h, w), px."""
        grid, shape = image_grid(self.scene.lens)
        covariance = self.scatter * self.known.projection_covariance(self.scene.lens, grid, self.distance_mm)
        return grid.reshape(*shape, 2), rms_sigma(covariance).reshape(shape)

    @property
    def ratio_of_halves(self) -> float:
        """The difference of two halves over what the corners' noise predicts, the splits' median."""
        return float(np.median([difference.ratio for difference in self.halves]))

    @property
    def model_error(self) -> str | None:
        """Error text where two halves contradict each other, None if they agree."""
        if self.ratio_of_halves <= MAX_RATIO:
            return None
        if not math.isfinite(self.ratio_of_halves):
            return (
                f"half of the images does not tell the distortion {self.order}: take more images, or give "
                "--distortion fewer coefficients"
            )
        is_tilted = any(name in TILT for name in self.scene.lens.names)
        tilt = "" if is_tilted else "; give --tilted if the sensor is tilted to the lens"
        return (
            f"two halves of the images differ {self.ratio_of_halves:.1f} times as much as their noise "
            f"predicts, {MAX_RATIO:g} is the most: the model is wrong. Try: hold the board still; lock "
            "focus and aperture; use a stiff flat board, its squares' side the same both ways; leave out "
            f"images with large residuals{tilt}"
        )


def calibrate_camera(
    board: Board,
    views: Sequence[BoardView],
    size: tuple[int, int],
    *,
    tilted: bool = False,
    orders: Sequence[str] = tuple(ORDERS),
    progress: Callable[[int, int], None] | None = None,
) -> CameraCalibration:
    """Calibrate a camera's lens from corners of a board in several images, and compare halves of them.

    Each view has at least `MIN_CORNERS`; `size` is the images' width and height, px. `tilted` adds a tilt of
    the sensor (Scheimpflug). `orders` are the distortions of `ORDERS` to choose from. `progress` is called
    with the steps done and their number. The result's `model_error` says whether to use it. Raises
    UndeterminedError, which names the missing image, if the images do not determine the lens.
    """
    ways = splits(len(views))
    steps = len(orders) + len(ways) + 1

    def tell(done: int) -> None:
        if progress is not None:
            progress(done, steps)

    with one_thread():
        result = fit_lens(board, views, size, tilted=tilted, orders=orders, progress=tell)
        halves = []
        for n, first in enumerate(splits(len(result.seen.names))):
            halves.append(difference_of_halves(result.scene, result.seen, first))
            tell(len(orders) + n + 1)
        sigma_px = float(np.median(result.noise.sigma_px))
        pose = best_next_board(result.known, result.scene, result.seen, sigma_px, result.distance_mm)
    tell(steps)
    return replace(result, halves=halves, next_board=pose)


def fit_lens(
    board: Board,
    views: Sequence[BoardView],
    size: tuple[int, int],
    *,
    tilted: bool = False,
    orders: Sequence[str] = tuple(ORDERS),
    progress: Callable[[int], None] | None = None,
) -> CameraCalibration:
    """Fit a lens without comparing halves of the images; see `calibrate_camera`."""
    check_count(len(views), 0)
    all_seen = Sightings.of(board, views)
    start = first_scene(*size, all_seen)
    # Wrong corners are sought with a usual distortion, before one is chosen.
    agreed = _fit_poses_robustly(
        replace(start, lens=start.lens.with_distortion(ORDERS["k1 k2 p1 p2"])), all_seen
    )
    kept, left_out = _views_to_keep(agreed, all_seen)
    check_count(len(kept), len(left_out))
    all_seen, agreed = all_seen.select_views(kept), agreed.select_views(kept)
    seen = all_seen.where(~wrong_corners(agreed, all_seen))
    scene, noise = fit_scene(agreed, seen)
    _check(scene, seen, noise)
    distance_mm = float(np.median(scene.points_camera(seen)[:, 2]))
    scores = cross_validate(scene, seen, noise, orders, tilted=tilted, progress=progress)
    known = [each for each in scores if _is_determined(each, seen, noise, distance_mm)] or scores[:1]
    while True:
        chosen = choose_leanest(known)
        result = _final_fit(chosen, scores, all_seen, left_out, distance_mm)
        # The last fit knows how the images scatter and how the board is printed: sigmas are wider.
        fault = _fault(result)
        if fault is None or not ORDERS[chosen.name]:
            break
        known = known[: known.index(chosen)]
        if not known:
            raise UndeterminedError(
                f"the distortion {chosen.name} {fault}: take images with the board nearer to the image's "
                "corners, or give --distortion fewer coefficients"
            )
    if tilted:
        _check_tilt(result)
    return result


def _fault(result: CameraCalibration) -> str | None:
    """Return the reason for which a distortion is useless, None if it is usable."""
    if not result.scene.lens.is_invertible:
        return "folds the image: two points of the scene are seen at the same place"
    if result.sigma_map()[1].max() > MAX_SIGMA_PX:
        return f"leaves the image unknown to more than {MAX_SIGMA_PX:g} px"
    return None


def _final_fit(
    chosen: DistortionScore,
    scores: list[DistortionScore],
    all_seen: Sightings,
    left_out: dict[str, str],
    distance_mm: float,
) -> CameraCalibration:
    agreed = _fit_poses_robustly(chosen.scene, all_seen)
    is_wrong = wrong_corners(agreed, all_seen)
    seen = all_seen.where(~is_wrong)
    scene, noise, print_sigma = _fit_print(*fit_scene(agreed, seen), seen)
    weight = noise.weight(seen)
    return CameraCalibration(
        scene=scene,
        seen=seen,
        noise=noise,
        order=chosen.name,
        scores=scores,
        known=Knowledge.of(with_prior(scene, seen, weight, print_sigma)),
        scatter=_scatter_between_images(scene, seen, weight),
        print_sigma_mm=print_sigma,
        wrong=_wrong_corner_list(scene, all_seen.where(is_wrong)),
        left_out=left_out,
        distance_mm=distance_mm,
    )


def _fit_poses_robustly(scene: BoardScene, seen: Sightings) -> BoardScene:
    return fit_robust(with_better_poses(fit_robust(scene, seen), seen), seen)


def _views_to_keep(scene: BoardScene, seen: Sightings) -> tuple[list[int], dict[str, str]]:
    is_wrong, kept, left_out = wrong_corners(scene, seen), [], {}
    sigma_px = robust_noise(scene, seen).sigma_px
    typical_px = float(np.median(sigma_px))
    for n, (name, part) in enumerate(zip(seen.names, seen.slices, strict=True)):
        bad, count = int(is_wrong[part].sum()), part.stop - part.start
        if bad > MAX_OUTLIER_SHARE * count or count - bad < MIN_CORNERS:
            left_out[name] = f"{bad} of {count} corners are not where the board has them"
        elif sigma_px[n] > MAX_NOISE * typical_px:
            left_out[name] = (
                f"its corners scatter by {sigma_px[n]:.2g} px, those of most by {typical_px:.2g} px"
            )
        else:
            kept.append(n)
    return kept, left_out


def _fit_print(
    scene: BoardScene, noise: CornerNoise, seen: Sightings
) -> tuple[BoardScene, CornerNoise, float]:
    """Return scene and noise with the corners where the print has them, and 1 sigma of that, mm."""
    sigma_mm = 0.0
    if not has_distinct_ends(seen.board):
        return scene, noise, sigma_mm
    # Print and noise are estimated in turn until the print's sigma settles.
    for _ in range(5):
        before, sigma_mm = sigma_mm, print_sigma_mm(scene, seen, noise)
        if sigma_mm == 0.0:
            break
        scene, noise = fit_scene(scene, seen, sigma_mm)
        if abs(sigma_mm / max(before, 1e-12) - 1.0) < 0.02:
            break
    return scene, noise, sigma_mm


def _check(scene: BoardScene, seen: Sightings, noise: CornerNoise) -> None:
    """Raise UndeterminedError if the images do not determine the lens."""
    try:
        covariance = scaled_inverse(with_prior(scene, seen, noise.weight(seen)).information())
        sigma = np.sqrt(np.abs(np.diag(covariance)))
    except np.linalg.LinAlgError:
        sigma = np.full(len(scene.lens.values) + 2, np.inf)
    check_focal_length(scene, sigma, float(np.median(noise.sigma_px)))
    check_cover(scene.lens, seen)


def _check_tilt(result: CameraCalibration) -> None:
    """Raise UndeterminedError if the sensor's tilt cannot be separated from the principal point.

    Without distortion a tilted sensor is equivalent to a rotated and shifted one.
    """
    variance = np.diag(result.covariance)[[result.names.index(name) for name in TILT]]
    # Beyond 3 deg the tilt is as good as unknown.
    if not ((variance > 0.0) & (variance <= math.radians(3.0) ** 2)).all():
        raise UndeterminedError(
            "the sensor's tilt is unknown: the lens has too little distortion to tell it from the principal "
            "point; leave --tilted, the projection is the same without"
        )


def _is_determined(score: DistortionScore, seen: Sightings, noise: CornerNoise, distance_mm: float) -> bool:
    lens = score.scene.lens
    if not lens.is_invertible:
        return False
    try:
        known = Knowledge.of(with_prior(score.scene, seen, noise.weight(seen)))
        variance = known.projection_covariance(lens, image_grid(lens)[0], distance_mm)
    except np.linalg.LinAlgError:
        return False
    return bool(rms_sigma(variance).max() <= MAX_SIGMA_PX)


def _wrong_corner_list(scene: BoardScene, wrong: Sightings) -> tuple[WrongCorner, ...]:
    residuals = scene.residuals(wrong) if len(wrong) else np.empty((0, 2))
    return tuple(
        WrongCorner(int(view), int(corner), point, residual)
        for view, corner, point, residual in zip(
            wrong.view, wrong.corner, wrong.points_px, residuals, strict=True
        )
    )


def _scatter_between_images(scene: BoardScene, seen: Sightings, weight: Float64) -> float:
    """Return the images' scatter over that which the noise predicts; 1 where that is not significant.

    Corners of one image may err together: the board is not as printed, it moved, light shifts its edges. The
    covariance of lens and warp is too small by this factor. With u_i an image's gradient on them at the
    solution, S_i its information, and S the sum with the prior, sum u_i' S^-1 u_i is expected to be
    sum tr(S^-1 S_i) - sum tr((S^-1 S_i)²). The ratio is roughly chi² over its m degrees of freedom.
    """
    equations = with_prior(scene, seen, weight)
    covariance, gradients = scaled_inverse(equations.information()), equations.view_gradients()
    share = covariance @ equations.view_information()
    expected = float(np.trace(share.sum(axis=0)) - np.einsum("vij,vji->", share, share))
    ratio = float(np.einsum("vi,ij,vj->", gradients, covariance, gradients)) / expected
    return ratio if chi2.sf(ratio * len(covariance), len(covariance)) < FALSE_ALARM else 1.0
