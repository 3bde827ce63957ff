import json
import tomllib
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from documented import run_once
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner, Result

from arctrack import cli
from arctrack.calibrate.reflectance.goniometer import read_goniometer
from arctrack.errors import ArctrackError
from arctrack.recording.scene_tables import MaterialTable
from arctrack.recording.setup_file import read_setup_file
from arctrack.simulation.simulate import true_values
from calibration.goniometer import GreyResponse, Settings
from examples.make_goniometer import main as make_goniometer
from examples.make_goniometer import write_goniometer
from noise_model.surface.brdf import TABLE_1
from noise_model.transforms import invert

EXAMPLES = Path(__file__).parents[2] / "examples"
RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})
AS_TAKEN = ["--gamma", "0.45", "--black", "10"]
WHITE = ["--white", str(EXAMPLES / "goniometer_white.csv")]


def calibrate(data: Path, *options: str) -> Result:
    return RUNNER.invoke(cli.app, ["calibrate", "reflectance", str(data), *options])


def spoilt(path: Path, change: Callable[[list[str]], list[str]]) -> Path:
    lines = (EXAMPLES / "goniometer_mild_steel.csv").read_text().splitlines()
    target = path / "spoilt.csv"
    target.write_text("\n".join(change(lines)) + "\n")
    return target


def error_of(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, data: Path, *options: str
) -> str:
    """Return the one line that the command leaves on stderr with exit code 2."""
    monkeypatch.setattr("sys.argv", ["arctrack", "calibrate", "reflectance", str(data), *options])
    with pytest.raises(SystemExit) as caught:
        cli.main()
    assert caught.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    return lines[0]


def test_help_has_an_example() -> None:
    for command in (["calibrate"], ["calibrate", "reflectance"]):
        result = RUNNER.invoke(cli.app, [*command, "--help"])
        assert result.exit_code == 0
        assert "Example: arctrack calibrate reflectance examples/" in result.output


@pytest.mark.slow
def test_the_hand_eye_example_finds_its_camera(scratch: Path, shared: Path) -> None:
    command = "arctrack calibrate hand-eye examples/v_groove --out /tmp/found.toml"
    output, out = run_once(command, scratch, shared), scratch / "tmp" / "found.toml"
    stated = read_setup_file(EXAMPLES / "v_groove" / "recording.toml").setup
    # The example was simulated with seed 1.
    true = true_values(stated, np.random.default_rng([1, 0])).camera.T_tool_camera
    to_true, to_found = (
        invert(stated.camera.T_tool_camera) @ T
        for T in (true, read_setup_file(out).setup.camera.T_tool_camera)
    )
    off_deg = np.degrees(Rotation.from_matrix(to_found[:3, :3] @ to_true[:3, :3].T).as_rotvec())
    lines = {line.split()[0]: line.split() for line in output.splitlines() if "±" in line}
    sigmas_deg, sigmas_mm = (
        np.array([float(lines[f"{kind}_{axis}"][3]) for axis in "xyz"]) for kind in ("rot", "move")
    )
    assert (np.abs(off_deg) < 3.0 * sigmas_deg).all()
    assert (np.abs(to_found[:3, 3] - to_true[:3, 3]) < 3.0 * sigmas_mm).all()
    # The expected error of the seam is said before and after, and clearly smaller after.
    for axis in ("lateral", "vertical"):
        words = next(line.split() for line in output.splitlines() if line.split()[:1] == [axis])
        before_mm, after_mm = float(words[1]), float(words[4])
        assert 0.0 < after_mm < 0.7 * before_mm


@pytest.mark.slow
def test_a_hand_eye_calibration_that_gains_nothing_is_refused(tmp_path: Path) -> None:
    recording, out = tmp_path / "two_frames", tmp_path / "found.toml"
    size = ["--width", "320", "--height", "240", "--frames", "2", "--production"]
    straight = ["--tilt-deg", "0", "--weave-mm", "0", "--seam-wander-mm", "0", "--seed", "3"]
    assert RUNNER.invoke(cli.app, ["simulate", str(recording), *size, *straight]).exit_code == 0
    result = RUNNER.invoke(cli.app, ["calibrate", "hand-eye", str(recording), "--out", str(out)])
    assert isinstance(result.exception, ArctrackError)
    assert "no clear gain" in str(result.exception)
    assert "record more frames with the arc on" in str(result.exception)
    assert not out.exists()


def test_examples_are_what_their_script_makes(tmp_path: Path) -> None:
    make_goniometer(tmp_path)
    made = sorted(tmp_path.iterdir())
    assert len(made) == 3
    for file in made:
        assert file.read_text() == (EXAMPLES / file.name).read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLE_1)
def test_examples_return_table_1(name: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    data = EXAMPLES / f"goniometer_{name}.csv"
    result = calibrate(data, *AS_TAKEN, *WHITE, "--name", name, "--out", str(out))
    assert result.exit_code == 0, result.output
    assert "960 at 48 settings, 20 each, 0.2 s apart" in result.output
    assert "1/sr, by the white standard" in result.output

    material = tomllib.loads((out / "material.toml").read_text())["material"]
    assert MaterialTable.model_validate(material).name == name
    assert "[material]" in result.output
    found = json.loads((out / "reflectance.json").read_text())
    truth = np.array([getattr(TABLE_1[name], key) for key in found["names"]])
    np.testing.assert_allclose([material[key] for key in found["names"]], found["values"], rtol=1e-5)
    assert (np.abs(np.array(found["values"]) - truth) < 3.5 * np.array(found["sigmas"])).all()
    assert np.shape(found["covariance"]) == (3, 3)
    residuals = (out / "residuals.csv").read_text().splitlines()
    assert len(residuals) == 52
    assert [line.rsplit(",", 1)[1] for line in residuals] == ["patch"] + 48 * ["sample"] + 3 * ["white"]
    assert residuals[0].startswith("theta_i_deg,theta_r_deg,phi_r_deg,readings,gray_level")
    assert matplotlib.image.imread(out / "reflectance.png").std() > 0.05


def test_without_a_white_standard_the_total_is_held() -> None:
    result = calibrate(EXAMPLES / "goniometer_mild_steel.csv", *AS_TAKEN, "--total", "0.347")
    assert result.exit_code == 0, result.output
    assert "kappa_diff + kappa_spec = 0.347 by convention" in result.output
    material = tomllib.loads(result.output[result.output.index("[material]") :])["material"]
    assert material["kappa_diff"] == pytest.approx(0.021, rel=0.02)
    assert material["name"] == "goniometer_mild_steel"


def test_readings_at_another_gamma_are_warned_of() -> None:
    result = calibrate(EXAMPLES / "goniometer_mild_steel.csv", "--black", "10")
    assert result.exit_code == 0
    assert "times as much about the fit as their repeats allow" in result.stderr


def test_an_outlier_is_named_with_its_line(tmp_path: Path) -> None:
    def lift(lines: list[str]) -> list[str]:
        cells = [line.split(",") for line in lines]
        for row in cells[101:121]:
            row[4] = str(float(row[4]) + 30.0)
        return [",".join(row) for row in cells]

    result = calibrate(spoilt(tmp_path, lift), *AS_TAKEN)
    assert result.exit_code == 0, result.output
    assert "spoilt.csv, line 102: +" in result.stderr


def test_single_readings_and_unknown_columns_are_warned_of(tmp_path: Path) -> None:
    def single(lines: list[str]) -> list[str]:
        return [lines[0] + ",operator", *(line + ",me" for line in lines[1::20])]

    result = calibrate(spoilt(tmp_path, single), *AS_TAKEN)
    assert result.exit_code == 0, result.output
    assert "unknown columns operator have no effect" in result.stderr
    assert "no setting was read twice" in result.stderr


def test_identical_repeats_tell_nothing(tmp_path: Path) -> None:
    def copied(lines: list[str]) -> list[str]:
        rows = [line.split(",") for line in lines[1:]]
        return [lines[0], *(",".join([*row[:4], rows[i - i % 20][4]]) for i, row in enumerate(rows))]

    result = calibrate(spoilt(tmp_path, copied), *AS_TAKEN)
    assert result.exit_code == 0, result.output
    assert "all readings of a setting are identical and tell nothing of the noise" in result.stderr
    assert "no setting was read twice" not in result.stderr


def test_readings_cut_at_0_are_warned_of(tmp_path: Path) -> None:
    def cut(lines: list[str]) -> list[str]:
        cells = [line.split(",") for line in lines]
        for row in (30, 31, 70):
            cells[row][4] = "0"
        return [",".join(row) for row in cells]

    result = calibrate(spoilt(tmp_path, cut), *AS_TAKEN)
    assert "spoilt.csv, line 31: gray_level = 0, at 2 settings in all: " in result.stderr.replace("\n", " ")
    assert "raise the sensor's black level" in result.stderr.replace("\n", " ")


def white_file(path: Path, change: Callable[[int, float], float]) -> Path:
    """Write the white standard's readings, changed by their number and grey level."""
    lines = (EXAMPLES / "goniometer_white.csv").read_text().splitlines()
    target = path / "white.csv"
    rows = [line.split(",") for line in lines[1:]]
    changed = [",".join([*row[:4], f"{change(i, float(row[4])):g}"]) for i, row in enumerate(rows)]
    target.write_text("\n".join([lines[0], *changed]) + "\n")
    return target


def test_a_bad_setting_of_the_white_standard_is_named(tmp_path: Path) -> None:
    white = white_file(tmp_path, lambda i, level: level + (12.0 if i < 20 else 0.0))
    steel = EXAMPLES / "goniometer_mild_steel.csv"
    result = calibrate(steel, *AS_TAKEN, "--white", str(white), "--out", str(tmp_path / "out"))
    assert result.exit_code == 0, result.output
    said = result.stderr.replace("\n", "")
    assert "white.csv: settings scatter " in said
    assert "white.csv, line 2: +" in said
    assert "goniometer_mild_steel.csv: settings scatter" not in said
    assert "(the white standard's " in result.output
    rows = [line.split(",") for line in (tmp_path / "out" / "residuals.csv").read_text().splitlines()]
    assert abs(float(rows[49][8])) > 4.0


@pytest.mark.parametrize("level", [10.0, 9.0, 0.0])
def test_a_dark_white_standard_is_named(
    level: float, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    white = white_file(tmp_path, lambda i, _: level)
    steel = EXAMPLES / "goniometer_mild_steel.csv"
    line = error_of(capsys, monkeypatch, steel, *AS_TAKEN, "--white", str(white))
    assert line == f"arctrack: error: {white}: no reading is above black (10)"


def cell(line: int, column: int, text: str) -> Callable[[list[str]], list[str]]:
    def change(lines: list[str]) -> list[str]:
        cells = lines[line - 1].split(",")
        cells[column] = text
        return [*lines[: line - 1], ",".join(cells), *lines[line:]]

    return change


BAD: dict[str, tuple[Callable[[list[str]], list[str]], list[str], str]] = {
    "no column": (cell(1, 4, "grey"), [], "spoilt.csv, line 1: the column gray_level is missing"),
    "not a number": (cell(7, 4, "bright"), [], "spoilt.csv, line 7: gray_level = 'bright'"),
    "NaN": (cell(7, 4, "nan"), [], "spoilt.csv, line 7: gray_level = 'nan': must be a finite number"),
    "saturated": (cell(9, 4, "255"), [], "line 9: gray_level = 255 is saturated (at 255)"),
    "negative": (cell(9, 4, "-1"), [], "line 9: gray_level = -1 must be >= 0"),
    "grazing": (cell(9, 1, "90"), [], "line 9: theta_i_deg = 90 lies"),
    "below": (cell(9, 2, "95"), [], "line 9: theta_r_deg = 95 lies"),
    "no distance": (
        lambda lines: [f"{line},{'distance_mm' if n == 0 else '1e-300'}" for n, line in enumerate(lines)],
        [],
        "line 2: distance_mm = 1e-300 must be 1e-09 to 1e+09",
    ),
    "no rows": (lambda lines: lines[:1], [], "holds no rows"),
    "one setting": (lambda lines: lines[:21], [], "readings at 1 different setting cannot determine"),
    "out of the lobe": (
        lambda lines: [lines[0], *lines[641:681], *lines[681:741]],
        AS_TAKEN,
        "kappa_spec and c2 are not determined",
    ),
    "gamma": (lambda lines: lines, ["--gamma", "0"], "gamma = 0.0: must be > 0"),
    "black": (lambda lines: lines, ["--black", "300"], "must be above black"),
    "total": (
        lambda lines: lines,
        [*AS_TAKEN, "--total", "-1"],
        "--total -1: kappa_diff + kappa_spec must be > 0",
    ),
    "albedo of nothing": (lambda lines: lines, [*AS_TAKEN, "--albedo", "0.9"], "no effect without --white"),
    "total beside white": (
        lambda lines: lines,
        [*AS_TAKEN, *WHITE, "--total", "1"],
        "no effect with --white",
    ),
    "albedo": (
        lambda lines: lines,
        [*AS_TAKEN, *WHITE, "--albedo", "2"],
        "--albedo 2: a white standard's lies",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    change, options, message = BAD[name]
    line = error_of(capsys, monkeypatch, spoilt(tmp_path, change), *options)
    assert line.startswith("arctrack: error: ")
    assert message in line


@pytest.mark.slow
def test_a_file_or_folder_that_is_not_there_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert f"{tmp_path}: is a folder: a regular file is needed" in error_of(capsys, monkeypatch, tmp_path)
    assert "gone.csv: there is no such file" in error_of(capsys, monkeypatch, tmp_path / "gone.csv")
    (tmp_path / "taken").write_text("")
    (tmp_path / "out" / "reflectance.png").mkdir(parents=True)
    steel = EXAMPLES / "goniometer_mild_steel.csv"
    for name in ("taken", "out"):
        line = error_of(capsys, monkeypatch, steel, *AS_TAKEN, "--out", str(tmp_path / name))
        assert "cannot be written" in line


def test_a_white_standard_must_state_its_source_alike(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def with_distance(lines: list[str]) -> list[str]:
        return [lines[0] + ",distance_mm", *(line + ",250" for line in lines[1:])]

    line = error_of(capsys, monkeypatch, spoilt(tmp_path, with_distance), *AS_TAKEN, *WHITE)
    assert "states of distance_mm and intensity: neither, but" in line


def test_distances_and_intensities_make_the_source(tmp_path: Path) -> None:
    file = tmp_path / "d.csv"
    file.write_text(
        "theta_i_deg,theta_r_deg,phi_r_deg,gray_level,distance_mm,intensity,repeat\n"
        "40,40,0,100,200,2,1\n40,40,0,102,200,2,2\n40,40,0,50,400,2,1\n"
    )
    read = read_goniometer(file, GreyResponse())
    np.testing.assert_allclose(read.readings.settings.source, [2 / 200**2, 2 / 400**2])
    np.testing.assert_allclose(read.readings.gray_level, [101.0, 50.0])
    assert read.lines == (2, 4)
    assert read.source_columns == ("distance_mm", "intensity")
    assert np.isnan(read.interval_s)
    assert read.unknown_columns == ()
    file.write_text(file.read_text().replace(",400,", ",0,"))
    with pytest.raises(ArctrackError, match="line 4: distance_mm = 0 must be > 0"):
        read_goniometer(file, GreyResponse())


def test_written_readings_come_back(tmp_path: Path) -> None:
    settings = Settings.in_plane([20.0, 30.5], [-10.0, 12.25])
    write_goniometer(tmp_path / "g.csv", settings, np.array([1.0, 20.0, 30.5, 254.0]))
    read = read_goniometer(tmp_path / "g.csv", GreyResponse())
    np.testing.assert_array_equal(read.readings.gray_level, [1.0, 20.0, 30.5, 254.0])
    for name in vars(settings):
        np.testing.assert_array_equal(getattr(read.readings.settings, name), getattr(settings, name))
