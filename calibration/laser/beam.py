"""Properties of the sheet beyond its plane, from board pairs: origin of the light, angle, thickness.

Everything is taken to the tool frame by the setup's pose of the camera, in which the setup's model has the
sheet's axis and its depth.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calibration.camera.lens import Lens
from calibration.laser.calibrate import LaserCalibration
from calibration.laser.cross_sections import CrossSections
from calibration.laser.fan import Fan, Missing, ends_of, fit_fan
from calibration.laser.plane import BoardLine, foot_on
from calibration.laser.width import Width, fit_width, width_of_pair
from noise_model.compiled.arrays import Bool, Float64
from noise_model.instrument.camera import Camera
from noise_model.instrument.laser import Laser
from noise_model.transforms import transform

NO_LIGHT = (
    "no pair tells the stripe's light: the sensor's gamma is not 1, or the board ends beside the stripe"
)

NO_WIDTH = (
    "in no pair is the stripe's width told: it is saturated, or as narrow as the lens' blur, psf_sigma_px; "
    "take pairs with a shorter exposure, or check psf_sigma_px"
)


@dataclass(frozen=True)
class PairLight:
    """A pair's light in the sheet: points (n, 2) along the model's axis and across it, mm, from the origin.

    `is_lit` (n,) are those of the stripe, `level` (n,) the light there over what the model has on that board,
    in no unit; `ends` are the stripe's that are seen, on the lower and the upper side, as points (2,), or why
    not.
    """

    name: str
    points_mm: Float64
    is_lit: Bool
    level: Float64
    ends: tuple[Float64 | Missing, Float64 | Missing]


@dataclass(frozen=True)
class Beam:
    """The laser sheet in the tool frame beyond its plane.

    Thickness and fan are strings that say what is missing where they are not determined. `origin_mm` (3,) is
    the fan's, or the stated one moved into the plane. `covariance` (9, 9) is of the plane's four numbers, the
    bow, the origin, and the half angle, deg; None with the stated origin.
    """

    width: Width | str
    fan: Fan | str
    pairs: tuple[PairLight, ...]
    origin_mm: Float64
    covariance: Float64 | None


def fit_beam(
    result: LaserCalibration, sections: Mapping[str, CrossSections], lens: Lens, camera: Camera, laser: Laser
) -> Beam:
    """Determine thickness, origin and angle of a sheet whose place is known.

    `sections` has the stripe's light by pair; pairs without one are not used. The camera's pose in the tool
    and its blur count as exact; depths are counted from the stated laser's origin.
    """
    T = camera.T_tool_camera
    plane, _, covariance = result.in_tool(T, laser.plane)
    origin = foot_on(plane, laser.origin_mm)
    axis, side, _ = replace(laser, plane_in_tool=tuple(plane)).fan
    in_sheet = np.stack([axis, side])
    lights, widths, steps = [], {}, []
    for name, line in zip(result.names, result.lines, strict=True):
        if name not in sections:
            continue
        each = sections[name]
        board = _OnBoard(line, lens, T)
        points = board.points(each.points_px())
        lights.append(_light(name, each, board, points, origin, in_sheet))
        steps.append(np.median(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        edges = [board.points(each.points_px(aside_px=0.5 * way)) @ plane[:3] for way in (-1.0, 1.0)]
        width = width_of_pair(each.width_px, np.abs(edges[1] - edges[0]), camera.psf_sigma_px)
        lit = np.isfinite(each.width_px)
        if width is not None:
            widths[float(origin[2] - np.median(points[lit, 2]))] = width
    fan: Fan | str = NO_LIGHT
    if lights:
        ends = [[end for light in lights if not isinstance(end := light.ends[n], Missing)] for n in (0, 1)]
        sides = [np.reshape(np.array(each), (-1, 2)) for each in ends]
        fan = fit_fan(sides, float(np.median(steps))) if min(map(len, sides)) else _no_ends(lights, sides)
    thickness = fit_width(widths, float(origin[2])) or (NO_WIDTH if lights else NO_LIGHT)
    if isinstance(fan, str):
        return Beam(thickness, fan, tuple(lights), origin, None)
    apex = origin + fan.apex @ in_sheet
    # Sheet, origin and half angle by the sheet's errors, and by those of apex and angle within it.
    by_sheet = np.vstack([np.eye(5), -np.outer(plane[:3], [*apex, 1.0, 0.0]), np.zeros(5)])
    by_fan = np.zeros((9, 3))
    by_fan[5:8, :2], by_fan[8, 2] = in_sheet.T, 1.0
    whole = by_sheet @ covariance @ by_sheet.T + by_fan @ fan.covariance[:3, :3] @ by_fan.T
    return Beam(thickness, fan, tuple(lights), apex, whole)


@dataclass(frozen=True)
class _OnBoard:
    """A board and the lens through which it is seen."""

    line: BoardLine
    lens: Lens
    T_tool_camera: Float64

    def points(self, points_px: Float64) -> Float64:
        """Return the points (n, 3) on the board, mm, tool frame, of image points (n, 2)."""
        return transform(self.T_tool_camera, self.line.points(self.lens.rays(points_px)))

    @property
    def normal(self) -> Float64:
        """The board's normal (3,), tool frame."""
        return np.asarray(self.T_tool_camera[:3, :3] @ self.line.T_camera_board[:3, 2])


def _light(
    name: str, each: CrossSections, board: _OnBoard, points: Float64, origin: Float64, in_sheet: Float64
) -> PairLight:
    ends: list[Float64 | Missing] = []
    for end in ends_of(each):
        if isinstance(end, Missing):
            ends.append(end)
        else:
            ends.append((board.points(each.points_px(np.array([end])))[0] - origin) @ in_sheet.T)
    from_origin = points - origin
    flat = from_origin @ in_sheet.T
    distance = np.linalg.norm(from_origin, axis=1)
    cos_i = np.abs(from_origin @ board.normal) / distance
    # The model's: (h/z)² cos(theta_i) / cos(psi).
    level = each.amount * np.square(from_origin[:, 2]) * np.abs(from_origin[:, 2]) / distance / cos_i
    lit = np.isfinite(each.width_px)
    along = flat[:, 1]
    if along[-1] < along[0]:
        ends.reverse()
    return PairLight(name, flat, lit, level, (ends[0], ends[1]))


def _no_ends(lights: list[PairLight], sides: list[Float64]) -> str:
    """Return the reason for which a side has no end."""
    n = 0 if not len(sides[0]) else 1
    reasons = [light.ends[n] for light in lights]
    where = "both sides" if not len(sides[0]) and not len(sides[1]) else f"the {('lower', 'upper')[n]} side"
    commonest = max(Missing, key=reasons.count)
    cure = (
        "take pairs on a larger board, or farther from the laser's middle, so that the stripe ends on it"
        if commonest is Missing.BOARD
        else "shift the board so that the stripe's ends lie in light squares"
    )
    return f"on {where} no pair shows where the stripe ends, which is {commonest}: {cure}"
