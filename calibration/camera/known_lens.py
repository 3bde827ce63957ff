"""A lens that is known: by a setup, with boards' poses before it, or by another model of its distortion."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from calibration.boards.board import Board
from calibration.boards.detect import MIN_CORNERS
from calibration.camera.adjustment import BoardScene, adjust
from calibration.camera.enough import UndeterminedError
from calibration.camera.lens import ORDERS, Lens
from calibration.camera.noise import wrong_corners
from calibration.camera.sightings import BoardView, Sightings
from calibration.camera.start import with_better_poses
from calibration.threads import one_thread
from noise_model.calibration_errors import OPENCV, PINHOLE
from noise_model.compiled.arrays import Float64
from noise_model.instrument.camera import Camera

SAMPLES = 25
"""Points across and down the image that the fit compares."""

CLOSE_PX = 1e-3
"""Largest error of a distortion than which no richer one is tried: a tenth of the best stripe's sigma."""


def fit_distortion(pinhole: Lens, undistorted: Callable[[Float64], Float64]) -> tuple[Lens, float]:
    """Return a pinhole with the leanest distortion that is close, and its largest error over the image, px.

    `undistorted` maps slopes x/z, y/z (N, 2) of the distorted image to those of the rays, NaN where there is
    none. Raises ValueError for such points in the image, or where each of OpenCV's would fold the image.
    """
    columns, rows = (np.linspace(0.0, side - 1.0, SAMPLES) for side in (pinhole.width, pinhole.height))
    points_px = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    with np.errstate(all="ignore"):
        slopes = undistorted((points_px - pinhole.values[2:4]) / pinhole.values[:2])
    if not np.isfinite(slopes).all():
        raise ValueError("has no ray for parts of the image: no pinhole sees so")
    rays = np.column_stack([slopes, np.ones(len(slopes))])
    best, error_px = pinhole, np.inf
    for order in ORDERS.values():
        lens, largest_px = _fit(pinhole.with_distortion(order), rays, points_px)
        if lens.is_invertible and largest_px < error_px:
            best, error_px = lens, largest_px
        if error_px < CLOSE_PX:
            break
    if not np.isfinite(error_px):
        raise ValueError("has a distortion that OpenCV's cannot stand for: it would fold the image")
    return best, error_px


def _fit(start: Lens, rays: Float64, points_px: Float64) -> tuple[Lens, float]:
    def with_values(coefficients: Float64) -> Lens:
        return replace(start, values=np.concatenate([start.values[:4], coefficients]))

    def errors(coefficients: Float64) -> Float64:
        return (with_values(coefficients).project(rays) - points_px).ravel()

    def jacobian(coefficients: Float64) -> Float64:
        return with_values(coefficients).project_with_jacobian(rays)[2][..., 4:].reshape(2 * len(rays), -1)

    coefficients = start.values[4:]
    if len(coefficients):
        coefficients = least_squares(errors, coefficients, jacobian, method="lm", x_scale="jac", xtol=1e-12).x
    return with_values(coefficients), float(np.linalg.norm(errors(coefficients).reshape(-1, 2), axis=1).max())


FAR_MM = 1e3
"""Initial distance of boards."""


def lens_from_camera(camera: Camera, free: Sequence[str] = ()) -> Lens:
    """Return a stated camera's lens, with the coefficients that are not 0, or that are `free`."""
    stated = dict(zip(OPENCV, camera.distortion, strict=False))
    names = tuple(name for name in OPENCV if stated.get(name, 0.0) != 0.0 or name in free)
    values = [camera.fx, camera.fy, camera.cx, camera.cy, *(stated.get(name, 0.0) for name in names)]
    return Lens(camera.width, camera.height, (*PINHOLE, *names), np.array(values))


def board_poses(board: Board, views: Sequence[BoardView], lens: Lens) -> tuple[BoardScene, Sightings]:
    """Return the boards' poses before a known lens, and the corners that are where the board has them."""
    seen = Sightings.of(board, views)
    far = np.tile(np.eye(4), (len(views), 1, 1))
    far[:, 2, 3] = FAR_MM
    scene = BoardScene(lens, np.zeros(2), far, np.zeros((len(board.points_mm), 2)))
    with one_thread():
        scene = with_better_poses(scene, seen)
        kept = ~wrong_corners(scene, seen)
        if not kept.all() and (seen.where(kept).counts >= MIN_CORNERS).all():
            seen = seen.where(kept)
            scene = adjust(scene, seen, np.ones(len(seen)), poses_only=True)
    return scene, seen


def check_corners(scene: BoardScene, seen: Sightings) -> None:
    """Raise UndeterminedError for corners that are not where the stated lens sees them."""
    rms = scene.rms_px(seen)
    if rms > 2.0:
        raise UndeterminedError(
            f"the boards' corners are {rms:.1f} px off where the setup's camera sees them: calibrate the "
            "camera first, `arctrack calibrate camera`; or the board's counts or squares are others"
        )
