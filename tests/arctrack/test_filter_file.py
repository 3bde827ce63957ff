from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from arctrack.calibrate.filter_curve import read_filter_curve
from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.nominal import nominal_setup
from arctrack.recording import format_setup
from arctrack.recording.setup_file import parse_setup, read_setup_file
from noise_model.instrument.spectrum import FilterCurve, transmission

DENSITIES = """wavelength_nm,optical_density
680,4.1
684,0.35
690,0.011
696,0.342
697,1.008
700,4.2
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "690fs10.csv"
    path.write_text(text)
    return path


def test_density_and_transmission_are_the_same_curve(tmp_path: Path) -> None:
    by_density = read_filter_curve(written(tmp_path, DENSITIES), 1.8)
    lines = DENSITIES.split()[1:]
    rows = [f"{nm},x,{10.0 ** -float(od)!r}" for nm, od in (line.split(",") for line in lines)]
    text = "\n".join(["wavelength_nm,note,transmission", *rows])
    by_transmission = read_filter_curve(written(tmp_path, text), 1.8)
    np.testing.assert_allclose(by_transmission.transmission, by_density.transmission)
    np.testing.assert_allclose(transmission(by_density, [690.0, 696.0]), [10**-0.011, 10**-0.342])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("684,", "679,", "line 3: wavelength 679 nm does not come after"),
        ("690,0.011", "690,-0.011", "line 4: transmission 1.02565: must be <= 1, an optical density >= 0"),
        ("690,0.011", "690,-999", "line 4: transmission inf"),
        ("696,0.342", "696,nan", "line 5: optical_density = 'nan'"),
        ("696,0.342", "696", "line 5: has 1 values"),
        ("700,4.2\n", "", "line 6: the curve does not cover the band"),
        ("optical_density", "od", "line 1: has neither of the columns transmission and optical_density"),
        ("wavelength_nm", "nm", "line 1: the column wavelength_nm is missing"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = written(tmp_path, DENSITIES.replace(old, new))
    with pytest.raises(ArctrackError) as caught:
        read_filter_curve(path, 1.8)
    assert f"{path}, {message}" in str(caught.value)


def test_a_negative_transmission_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "wavelength_nm,transmission\n680,0\n690,0.9\n699,-0.001\n700,0\n")
    with pytest.raises(ArctrackError, match=r"line 4: transmission -0\.001: must be >= 0"):
        read_filter_curve(path, 1.8)


def test_both_columns_leave_it_open(tmp_path: Path) -> None:
    path = written(tmp_path, "wavelength_nm,transmission,optical_density\n680,0,9\n690,1,0\n700,0,9\n")
    with pytest.raises(ArctrackError, match="line 1: has both of the columns"):
        read_filter_curve(path, 1.8)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ArctrackError, match="is a folder: a regular file is needed"):
        read_filter_curve(tmp_path, 1.8)
    with pytest.raises(ArctrackError, match=r"none\.csv: there is no such file"):
        read_filter_curve(tmp_path / "none.csv", 1.8)


def test_a_curve_goes_into_a_setup_and_comes_back(tmp_path: Path) -> None:
    setup_file, out = tmp_path / "recording.toml", tmp_path / "filtered.toml"
    setup_file.write_text("# the cell by the door\n" + format_setup(nominal_setup("lap", "mild_steel")))
    arguments = [str(written(tmp_path, DENSITIES)), "--setup", str(setup_file), "--out", str(out)]
    done = CliRunner().invoke(app, ["calibrate", "filter", *arguments])
    assert done.exit_code == 0, done.output
    assert "# the cell by the door" in out.read_text()
    found = read_setup_file(out)
    assert found.unknown_keys == ()
    curve = found.setup.filter
    assert isinstance(curve, FilterCurve)
    np.testing.assert_allclose(
        transmission(curve, [690.0, 696.0, 697.0]), 10.0 ** -np.array([0.011, 0.342, 1.008])
    )
    # Half of the peak, optical density 0.312, lies just before 696 nm and soon after 684 nm.
    assert 694.0 < curve.center_nm + 0.5 * curve.fwhm_nm < 696.0
    assert 684.0 < curve.center_nm - 0.5 * curve.fwhm_nm < 685.0
    text = format_setup(found.setup)
    assert format_setup(parse_setup(text, out).setup) == text


def test_keys_that_mean_nothing_are_told(tmp_path: Path) -> None:
    (tmp_path / "recording.toml").write_text(
        format_setup(nominal_setup("lap", "mild_steel")) + "[door]\nside = 1\n"
    )
    arguments = [
        str(written(tmp_path, DENSITIES)),
        "--setup",
        str(tmp_path),
        "--out",
        str(tmp_path / "out.toml"),
    ]
    done = CliRunner().invoke(app, ["calibrate", "filter", *arguments])
    assert done.exit_code == 0, done.output
    assert "recording.toml: [door] is not known" in done.stderr


def test_a_setup_is_not_written_over_itself(tmp_path: Path) -> None:
    setup_file = tmp_path / "recording.toml"
    setup_file.write_text(format_setup(nominal_setup("lap", "mild_steel")))
    before = setup_file.read_text()
    arguments = [str(written(tmp_path, DENSITIES)), "--setup", str(tmp_path), "--out", str(setup_file)]
    done = CliRunner().invoke(app, ["calibrate", "filter", *arguments])
    assert isinstance(done.exception, ArctrackError)
    assert "give --out another file" in str(done.exception)
    assert setup_file.read_text() == before


@pytest.mark.parametrize(
    ("keys", "named"),
    [
        ("curve_wavelength_nm = [680, 690, 700]\n", "one is given without the other"),
        (
            "curve_wavelength_nm = [680, 690, 700]\ncurve_transmission = [0, 0.9, 0.8]\n",
            "does not cover the band",
        ),
    ],
)
def test_a_curve_in_a_setup_that_cannot_be(tmp_path: Path, keys: str, named: str) -> None:
    text = format_setup(nominal_setup("lap", "mild_steel")).replace("[filter]\n", "[filter]\n" + keys)
    with pytest.raises(ArctrackError, match=rf"recording.toml: \[filter\] curve_wavelength_nm.*{named}"):
        parse_setup(text, tmp_path / "recording.toml")


def filter_command(tmp_path: Path, out: Path, *options: str) -> str:
    """Return the error of the command with a measured curve and a setup."""
    setup_file = tmp_path / "recording.toml"
    setup_file.write_text(format_setup(nominal_setup("lap", "mild_steel")))
    data = written(tmp_path, DENSITIES)
    done = CliRunner().invoke(
        app, ["calibrate", "filter", str(data), "--setup", str(setup_file), "--out", str(out), *options]
    )
    assert isinstance(done.exception, ArctrackError)
    assert data.read_text() == DENSITIES
    return str(done.exception)


def test_a_measurement_is_not_written_over(tmp_path: Path) -> None:
    out = tmp_path / "690fs10.csv"
    assert filter_command(tmp_path, out) == f"{out}: is the measurement itself; give --out another file"
    link = tmp_path / "link.toml"
    link.symlink_to(out)
    assert "is the measurement itself" in filter_command(tmp_path, link)


@pytest.mark.parametrize("index", ["inf", "nan", "0.5"])
def test_an_effective_index_that_cannot_be_is_the_options(tmp_path: Path, index: str) -> None:
    out = tmp_path / "out.toml"
    message = filter_command(tmp_path, out, "--effective-index", index)
    assert message == f"--effective-index {index}: must be a finite number, 1 or more"
    assert not out.exists()
