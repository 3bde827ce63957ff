import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.camera.enough import UndeterminedError
from calibration.camera.lens import Lens
from calibration.gauge.calibrate import GaugeCalibration, calibrate_gauge, check_gauge
from calibration.gauge.shape import Gauge
from calibration.gauge.sightings import PosedPieces, StatedSensor
from calibration.gauge.stripe_pieces import Piece, Pieces, stripe_pieces
from calibration.laser.image_line import fit_line
from noise_model.compiled.arrays import Float64
from noise_model.instrument.laser import Laser
from noise_model.transforms import invert

sys.path.append(str(Path(__file__).parents[2] / "examples"))

from make_gauge import (
    ANGLE_DEG,
    CAMERA_IN_TOOL_MM,
    CAMERA_IN_TOOL_XYZW,
    CENTRE_PX,
    DEPTH_MM,
    FOCAL_PX,
    HEIGHT,
    SHEET_IN_TOOL,
    WIDTH,
    draw,
    pose,
    rotation,
    turned,
    v_faces,
)

LENS = Lens(WIDTH, HEIGHT, ("fx", "fy", "cx", "cy"), np.array([FOCAL_PX, FOCAL_PX, *CENTRE_PX]))
T_TOOL_CAMERA = pose(rotation(*CAMERA_IN_TOOL_XYZW), CAMERA_IN_TOOL_MM)
UP = np.array([0.0, 0.0, 1.0])
V, STEP = Gauge.parse("v:90deg:5mm"), Gauge.parse("step:5mm")
NOISE_PX, ROBOT_MM = 0.1, 0.02

MOTIONS = [
    (0, 0, 0, 0),
    (8, 0, 0, 20),
    (-8, 0, 0, -20),
    (0, 12, 0, 30),
    (0, -12, 0, -30),
    (4, 0, 12, 10),
    (-4, 0, -12, -10),
    (0, 10, 0, 180),
    (0, 0, 12, 150),
    (5, 10, -12, -160),
]
"""How high the tool is, mm, and its turns about x, y and z, deg."""


def faces_of(gauge: Gauge) -> list[tuple[Float64, Float64, float, float]]:
    """Return points, normals and reaches of the faces in their order across the gauge."""
    if gauge == V:
        return v_faces(ANGLE_DEG, DEPTH_MM)
    return [(np.zeros(3), UP, -20.0, 0.0), (np.array([0.0, 0.0, -5.0]), UP, 0.0, 20.0)]


def stripe_on(gauge: Gauge, T_base_tool: Float64, rng: np.random.Generator) -> Pieces:
    """Return the pieces of the stripe on a gauge that lies in base's origin, by the sheet's true place."""
    to_camera = invert(T_base_tool @ T_TOOL_CAMERA)
    to_base = T_base_tool[:3, :3]
    n = to_base @ SHEET_IN_TOOL[:3]
    d = SHEET_IN_TOOL[3] - n @ T_base_tool[:3, 3]
    pieces = []
    for point, m, low, high in faces_of(gauge):
        y = np.linspace(max(low, -10.0), min(high, 10.0), 60)
        z = point[2] - m[1] * (y - point[1]) / m[2]
        x = -(d + n[1] * y + n[2] * z) / n[0]
        seen = np.column_stack([x, y, z]) @ to_camera[:3, :3].T + to_camera[:3, 3]
        image = FOCAL_PX * seen[:, :2] / seen[:, 2:] + CENTRE_PX
        image = image[np.argsort(image[:, 0])]
        ends = image[0].copy(), image[-1].copy()
        image[:, 1] += NOISE_PX * rng.standard_normal(len(image))
        pieces.append(Piece(image, fit_line(LENS.rays(image), along_rows=True), *ends))
    pieces.sort(key=lambda piece: float(piece.points_px[:, 0].mean()))
    return Pieces(tuple(pieces), along_rows=True, scale_px=3.0)


def shown_at(motions: list[tuple[float, ...]], gauge: Gauge = V, seed: int = 1) -> list[PosedPieces]:
    rng, shown = np.random.default_rng(seed), []
    for n, (higher_mm, *angles) in enumerate(motions):
        R = turned(*angles)
        T = pose(R, np.array([*rng.uniform(-2.0, 2.0, 2), higher_mm]) - R @ np.array([35.0, 0.0, 0.0]))
        stated = T.copy()
        stated[:3, 3] += ROBOT_MM * rng.standard_normal(3)
        shown.append(PosedPieces(f"{n}", stripe_on(gauge, T, rng), stated))
    return shown


def z_of(result: GaugeCalibration) -> Float64:
    """Return the errors of leans and place over their sigmas."""
    state = result.fitted.state
    rows = np.zeros((3, 4))
    rows[:2, :3], rows[2] = state.leans, [*state.centre_mm, 1.0]
    return np.asarray(rows @ (result.plane - SHEET_IN_TOOL) / result.sigma)


def sensor_with(plane: Float64) -> StatedSensor:
    x, _, z, d_mm = plane.tolist()
    origin = (-(d_mm + 300.0 * z) / x, 0.0, 300.0)
    return StatedSensor(LENS, T_TOOL_CAMERA, Laser(660.0, (x, 0.0, z, d_mm), origin, 0.25, 1000.0))


STATED = sensor_with(np.array([np.cos(0.02), 0.0, np.sin(0.02), -35.5]))
"""A sheet that is one degree and half a millimetre off."""

RIGHT = sensor_with(SHEET_IN_TOOL)


@pytest.mark.slow
@pytest.mark.parametrize("gauge", [V, STEP], ids=["V", "step"])
def test_the_sheet_is_within_its_sigmas_and_the_robots_error_is_told(gauge: Gauge) -> None:
    result = calibrate_gauge(shown_at(MOTIONS, gauge), gauge, STATED, UP)
    assert np.abs(z_of(result)).max() < 3.5
    assert result.sigma[2] < 0.2
    assert np.degrees(result.sigma[:2]).max() < 0.1
    assert result.fitted.noise_mm[0] == pytest.approx(ROBOT_MM, rel=0.6)
    assert result.left_out == {}
    row = np.array([*result.fitted.state.centre_mm, 1.0])
    assert np.sqrt(row @ result.covariance @ row) == pytest.approx(result.sigma[2], rel=1e-6)


@pytest.mark.slow
def test_a_pose_of_another_image_is_named() -> None:
    shown = shown_at(MOTIONS)
    moved = shown[4].T_base_tool.copy()
    moved[:3, 3] += [0.0, 1.0, 1.0]
    shown[4] = replace(shown[4], T_base_tool=moved)
    result = calibrate_gauge(shown, V, STATED, UP)
    assert list(result.left_out) == ["4"]
    assert np.abs(z_of(result)).max() < 3.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motions", "missing"),
    [
        ([(0, 0, 0, 0)] * 8, "Add images for which you tilt the tool by ±15° about its y"),
        (
            [(z, 0, 0, 0) for z in (-8, -4, 0, 4, 8)],
            "Add images for which you tilt the tool by ±15° about its y",
        ),
        (MOTIONS[:3], "3 images show the gauge: 4 at least are needed"),
    ],
    ids=["none", "heights alone", "few"],
)
def test_a_motion_that_is_missing_is_named(motions: list[tuple[float, ...]], missing: str) -> None:
    with pytest.raises(UndeterminedError, match=missing):
        calibrate_gauge(shown_at(motions, STEP), STEP, RIGHT, UP)


@pytest.mark.slow
def test_one_image_checks_the_gauges_size() -> None:
    shown = shown_at([(0, 0, 0, 0)])
    right = check_gauge(shown, V, RIGHT, UP)
    assert abs(right.off_mm) < 3.5 * right.sigma_mm < 0.2
    wrong = check_gauge(shown, V, sensor_with(np.array([np.cos(0.1), 0.0, np.sin(0.1), -35.0])), UP)
    assert abs(wrong.off_mm) > 5.0 * wrong.sigma_mm


def test_another_gauge_is_refused() -> None:
    other = Gauge.parse("v:90deg:9mm")
    with pytest.raises(UndeterminedError, match=r"0 shows a V 5\.\d+ mm deep, the gauge's has 9 mm"):
        check_gauge(shown_at([(0, 0, 0, 0)]), other, RIGHT, UP)


@pytest.mark.slow
def test_a_stripes_pieces_are_cut_at_the_corners() -> None:
    at = np.array([400.0, 50.0, 20.0]) - np.array([35.0, 0.0, 0.0])
    pieces = stripe_pieces(draw(pose(np.eye(3), at), np.random.default_rng(1)), LENS, 4)
    assert isinstance(pieces, Pieces)
    cuts = [piece.last[0] for piece in pieces.pieces[:-1]]
    # The mouth is 10 mm wide, and 2190 px of focal length see a millimetre as some 15 px.
    assert np.diff(cuts) == pytest.approx([77.0, 77.0], abs=6.0)
    assert stripe_pieces(np.full((HEIGHT, WIDTH), 9, np.uint8), LENS, 4) == "shows no stripe"


@pytest.mark.parametrize(
    ("text", "why"),
    [("step:5", "is no gauge"), ("v:5deg:3mm", "must be 10 to 170 deg"), ("step:0mm", "must be > 0 mm")],
)
def test_what_is_no_gauge_is_refused(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        Gauge.parse(text)
