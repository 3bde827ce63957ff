import tomllib
from pathlib import Path

import numpy as np
import pytest

from arctrack.calibrate.laser.record import moved_with_camera
from arctrack.errors import ArctrackError
from arctrack.nominal import nominal_setup
from arctrack.output import write_keeping
from arctrack.recording import (
    CalibrationValues,
    format_setup,
    read_setup_file,
    with_calibrated,
    with_camera_pose,
)
from arctrack.recording.setup_file import parse_setup
from noise_model.calibration_errors import CalibrationCovariance
from noise_model.compiled.arrays import Float64
from noise_model.transforms import invert, moved


def lens(**values: float) -> CalibrationValues:
    return CalibrationValues(
        "camera", values, ("fx", "k1"), np.array([[4.0, 0.1], [0.1, 0.01]]), "arctrack calibrate camera"
    )


@pytest.fixture
def setup_toml(tmp_path: Path) -> Path:
    path = tmp_path / "recording.toml"
    text = format_setup(nominal_setup("v_groove", "mild_steel"))
    path.write_text(text.replace("fx =", 'bought = "in May"\nfx =').replace("fy =", "# square pixels\nfy ="))
    return path


def test_values_and_their_covariance_are_added_and_all_else_stays(setup_toml: Path) -> None:
    before = setup_toml.read_text().splitlines()
    text = with_calibrated(setup_toml, lens(fx=1432.25))
    # What `calibrate` adds stands behind all that was there, where one line alone has changed.
    changed = [(a, b) for a, b in zip(before, text.splitlines(), strict=False) if a != b]
    assert [b for _, b in changed] == ["fx = 1432.25"]
    record = tomllib.loads(text)["calibration"]["camera"]
    assert record["sigma"] == [2.0, 0.1]
    assert np.array_equal(record["covariance"], lens().covariance)
    assert record["made_by"] == "arctrack calibrate camera"


def test_the_file_reads_back_without_a_new_warning(setup_toml: Path) -> None:
    unknown = read_setup_file(setup_toml).unknown_keys
    setup_toml.write_text(with_calibrated(setup_toml, lens(fx=1432.25)))
    read = read_setup_file(setup_toml)
    assert read.setup.camera.fx == 1432.25
    assert read.unknown_keys == unknown == ("[camera] bought",)


def test_a_later_calibration_replaces_the_earlier_one_and_leaves_others(setup_toml: Path) -> None:
    sensor = CalibrationValues(
        "sensor", {"read_noise_e": 9.0}, ("read_noise_e",), np.array([[0.25]]), "arctrack calibrate sensor"
    )
    for found in (lens(fx=1.0e3), sensor, lens(fx=2.0e3)):
        setup_toml.write_text(with_calibrated(setup_toml, found))
    assert list(tomllib.loads(setup_toml.read_text())["calibration"]) == ["camera", "sensor"]
    setup = read_setup_file(setup_toml).setup
    assert (setup.camera.fx, setup.sensor.read_noise_e) == (2.0e3, 9.0)


def test_comments_in_and_behind_an_earlier_calibration_stay(setup_toml: Path) -> None:
    text = with_calibrated(setup_toml, lens(fx=1.0e3)).replace("made_by =", "# by hand\nlot = 7\nmade_by =")
    setup_toml.write_text(f"{text}# the last line\n")
    again = with_calibrated(setup_toml, lens(fx=2.0e3))
    assert "# by hand\n" in again
    assert again.endswith("# the last line\n")
    assert "lot" not in tomllib.loads(again)["calibration"]["camera"]


def joint(names: tuple[str, ...], covariance: Float64) -> CalibrationValues:
    return CalibrationValues("camera", {}, names, covariance, "a test", name="geometry")


def test_a_joint_covariance_reads_back_and_ends_with_what_it_is_of(setup_toml: Path) -> None:
    names, rows = ("fx", "rot_x_deg", "d_mm"), np.array([[4.0, 0.1, 0.0], [0.1, 0.02, 0.0], [0.0, 0.0, 0.3]])
    text = with_calibrated(setup_toml, joint(names, rows))
    setup_toml.write_text(text)
    setup = read_setup_file(setup_toml).setup
    assert setup.calibration == CalibrationCovariance.of(names, rows)
    setup_toml.write_text(format_setup(setup))
    assert read_setup_file(setup_toml).setup.calibration == setup.calibration
    # Of another camera nothing is known of how its errors go with the sheet's.
    for other in (with_calibrated(setup_toml, lens(fx=2.0e3)), with_camera_pose(setup_toml, np.eye(4))):
        assert parse_setup(other, setup_toml).setup.calibration is None
    late = CalibrationValues("effects.pose_delay", {"delay_s": 0.02}, ("delay_s",), np.eye(1), "a test")
    assert parse_setup(with_calibrated(setup_toml, late), setup_toml).setup.calibration is not None


def test_what_is_no_joint_covariance_names_its_table(setup_toml: Path) -> None:
    with pytest.raises(ArctrackError, match=r"\[calibration.geometry\] covariance: .* calibrate anew"):
        with_calibrated(setup_toml, joint(("fx", "fy"), np.array([[1.0, 2.0], [2.0, 1.0]])))
    with pytest.raises(ArctrackError, match=r"\[calibration.geometry\] parameters: 'fz' is none of fx"):
        with_calibrated(setup_toml, joint(("fz",), np.eye(1)))


def test_a_value_goes_into_effects_that_are_one_line(setup_toml: Path) -> None:
    line = "effects = {hand_eye = {move_x_mm = 0.1}} # moved"
    setup_toml.write_text(f"{line}\n{setup_toml.read_text()}")
    late = CalibrationValues(
        "effects.pose_delay", {"delay_s": 0.02}, ("delay_s",), np.eye(1), "arctrack", name="late"
    )
    setup_toml.write_text(with_calibrated(setup_toml, late))
    effects = read_setup_file(setup_toml).setup.effects
    assert effects["pose_delay"]["delay_s"] == 0.02
    assert effects["hand_eye"]["move_x_mm"] == 0.1
    assert "# moved" in setup_toml.read_text()


@pytest.mark.parametrize("count", [5, 8, 14])
def test_a_distortion_of_many_coefficients_reads_back(setup_toml: Path, count: int) -> None:
    values = tuple(0.01 * n for n in range(count))
    result = CalibrationValues("camera", {"distortion": values}, ("k1",), np.eye(1), "a test")
    setup_toml.write_text(with_calibrated(setup_toml, result))
    setup = read_setup_file(setup_toml).setup
    assert setup.camera.distortion == values
    setup_toml.write_text(format_setup(setup))
    assert read_setup_file(setup_toml).setup.camera.distortion == values


def test_a_distortion_of_another_count_is_refused(setup_toml: Path) -> None:
    result = CalibrationValues("camera", {"distortion": (0.0,) * 6}, ("k1",), np.eye(1), "a test")
    with pytest.raises(ArctrackError, match=r"\[camera\] distortion: needs the five values"):
        with_calibrated(setup_toml, result)


def test_a_value_that_the_file_cannot_hold_is_refused(setup_toml: Path) -> None:
    with pytest.raises(ArctrackError, match=r"recording.toml: \[camera\] fx"):
        with_calibrated(setup_toml, lens(fx=-5.0))
    with pytest.raises(ValueError, match="covariance of 2 parameters must be 2 x 2"):
        CalibrationValues("camera", {}, ("fx", "fy"), np.eye(3), "a test")


def test_earlier_files_are_kept_under_rising_numbers(tmp_path: Path) -> None:
    path = tmp_path / "recording.toml"
    assert write_keeping(path, "a") is None
    assert write_keeping(path, "a") is None
    kept = [write_keeping(path, text) for text in "bc"]
    assert [(file.name, file.read_text()) for file in kept if file is not None] == [
        ("recording.toml.1", "a"),
        ("recording.toml.2", "b"),
    ]
    assert path.read_text() == "c"


def test_a_calibrated_sheet_moves_with_the_camera(setup_toml: Path) -> None:
    """It stays where it is in the camera's frame, and so does how well it is known."""
    stated = read_setup_file(setup_toml)
    T_old = stated.setup.camera.T_tool_camera
    assert moved_with_camera(stated, T_old) is None
    names = ("n_x", "n_y", "n_z", "d_mm", "origin_x_mm", "origin_y_mm", "origin_z_mm", "fan_half_angle_deg")
    root = np.random.default_rng(2).standard_normal((8, 8))
    found = CalibrationValues("laser", {}, names, root @ root.T, "arctrack calibrate laser", {"pairs": 8})
    setup_toml.write_text(with_calibrated(setup_toml, found))
    stated = read_setup_file(setup_toml)
    T_new = moved(T_old, [1.0, -2.0, 3.0], [4.0, 5.0, -6.0])
    record = moved_with_camera(stated, T_new)
    assert record is not None
    assert record.about == {"pairs": 8}
    laser = stated.setup.laser
    pairs = (
        (laser.plane, laser.origin_mm, found.covariance, T_old),
        (*record.values.values(), record.covariance, T_new),
    )
    in_camera = []
    for plane, origin, covariance, T in pairs:
        to_camera = np.eye(8)
        to_camera[:4, :4] = T.T
        to_camera[4:7, 4:7] = T[:3, :3].T
        in_camera.append((T.T @ plane, invert(T)[:3] @ [*origin, 1.0], to_camera @ covariance @ to_camera.T))
    for old, new in zip(*in_camera, strict=True):
        np.testing.assert_allclose(new, old, atol=1e-4)
