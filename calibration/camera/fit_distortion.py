"""OpenCV's distortion fitted to that of another model of the same pinhole."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from calibration.camera.lens import ORDERS, Lens
from noise_model.compiled.arrays import Float64

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
