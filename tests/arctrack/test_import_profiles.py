"""`arctrack import` of profilers' files: each layout gives its heights back, and nothing is guessed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from profiler_setup import profiler_setup
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.recording import BadFrame, read_recording
from arctrack.recording.importing.profile_files import on_columns, profiles_of, write_frames
from arctrack.recording.importing.profile_layout import ProfileLayout
from noise_model.compiled.arrays import Float64
from noise_model.instrument.profiler import Profiler

RUNNER = CliRunner(env={"COLUMNS": "200", "TERM": "dumb", "NO_COLOR": "1"})
COLUMNS, PITCH_MM = 20, 0.5
SETUP = profiler_setup(COLUMNS, PITCH_MM)
heights = st.lists(
    st.lists(st.integers(-1900, 1900) | st.none(), min_size=COLUMNS, max_size=COLUMNS), min_size=1, max_size=4
)
separators = st.sampled_from([("comma", ",", "point"), ("semicolon", ";", "comma"), ("tab", "\t", "point")])


def profiler() -> Profiler:
    return Profiler(COLUMNS, PITCH_MM, 40.0, 150.0, np.eye(4))


def as_mm(units: list[int | None], up_mm: float) -> Float64:
    return np.array([np.nan if unit is None else unit * up_mm for unit in units])


def read(path: Path, text: str, *options: str) -> list[Float64]:
    path.write_text(text)
    return [each.z_mm for each in profiles_of(path, ProfileLayout.of(options), profiler())]


def check(read_mm: list[Float64], units: list[list[int | None]], up_mm: float) -> None:
    assert len(read_mm) == len(units)
    for found, wanted in zip(read_mm, units, strict=True):
        np.testing.assert_allclose(found, as_mm(wanted, up_mm), atol=1e-6)


@given(heights, separators, st.booleans())
def test_rows_of_codes(
    tmp_path_factory: pytest.TempPathFactory,
    units: list[list[int | None]],
    parted: tuple[str, str, str],
    has_head: bool,
) -> None:
    name, mark, decimal = parted
    rows = [[f"{-7777 if unit is None else unit}" for unit in row] for row in units]
    lines = [mark.join(row) for row in ([list(map(str, range(COLUMNS)))] if has_head else []) + rows]
    found = read(
        tmp_path_factory.mktemp("rows") / "rows.csv",
        "\n".join(lines) + "\n",
        "layout=rows",
        f"separator={name}",
        f"decimal={decimal}",
        "nothing=-7777",
        "up_mm=-0.01",
        "across_mm=0.5",
    )
    check(found, units, -0.01)


@given(heights)
def test_blocks_with_decimal_commas_leave_invalid_points_out(
    tmp_path_factory: pytest.TempPathFactory, units: list[list[int | None]]
) -> None:
    places = profiler().y_mm
    blocks: list[list[str]] = [[], [], []]
    for n, row in enumerate(units):
        known = [i for i, unit in enumerate(row) if unit is not None]
        for block, values in zip(
            blocks,
            ([places[i] for i in known], [0.2 * n] * len(known), [0.01 * (row[i] or 0) for i in known]),
            strict=True,
        ):
            block.append(";".join(f"{value:.3f}".replace(".", ",") for value in values))
    if any(not line for block in blocks for line in block):
        return
    text = "".join("\n".join(block) + "\n\n" for block in blocks)
    options = (
        "layout=blocks",
        "separator=semicolon",
        "decimal=comma",
        "axes=x,y,z",
        "up_mm=1",
        "across_mm=1",
    )
    found = read(tmp_path_factory.mktemp("blocks") / "blocks.csv", text, *options)
    for mm, row in zip(found, units, strict=True):
        known = np.array([unit is not None for unit in row])
        # A single point has no neighbour to tell its distance by.
        if known.sum() > 1:
            np.testing.assert_allclose(mm[known], as_mm(row, 0.01)[known], atol=1e-6)


@given(heights)
def test_clouds_part_where_the_travel_changes(
    tmp_path_factory: pytest.TempPathFactory, units: list[list[int | None]]
) -> None:
    rows = [[0 if unit is None else unit for unit in row] for row in units]
    points = [
        f"{place:.6f} {0.01 * unit:.6f} {5.0 + 0.2 * n:.6f}"
        for n, row in enumerate(rows)
        for place, unit in zip(profiler().y_mm, row, strict=True)
    ]
    head = f"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nPOINTS {len(points)}\nDATA ascii\n"
    options = ("layout=cloud", "axes=x,z,y", "up_mm=1", "across_mm=1")
    found = read(tmp_path_factory.mktemp("cloud") / "cloud.pcd", head + "\n".join(points) + "\n", *options)
    check(found, [list(row) for row in rows], 0.01)


@pytest.mark.parametrize(("head", "name"), [("FIELDS x y z noise\nDATA ascii\n", "noise"), ("", "4")])
def test_clouds_have_a_sigma_of_each_point(tmp_path: Path, head: str, name: str) -> None:
    points = [f"{place:.6f} 1000 0 {n + 1}" for n, place in enumerate(profiler().y_mm)]
    path, layout = tmp_path / "cloud.pcd", ("layout=cloud", "axes=x,z,y", "up_mm=-0.001", "across_mm=1")
    path.write_text(("# .PCD v0.7\n" + head if head else "") + "\n".join(points) + "\n")
    (found,) = profiles_of(path, ProfileLayout.of([*layout, f"sigma={name}"]), profiler())
    np.testing.assert_allclose(found.sigma_mm, 0.001 * (1 + np.arange(COLUMNS)))
    (without,) = profiles_of(path, ProfileLayout.of(layout), profiler())
    assert np.isnan(without.sigma_mm).all()
    with pytest.raises(ArctrackError, match="sigma=width: must be one of x, y, z"):
        list(profiles_of(path, ProfileLayout.of([*layout, "sigma=width"]), profiler()))


@pytest.mark.parametrize(
    ("layout", "is_stated", "problem"),
    [("rows", True, "layouts cloud and mcap have sigmas"), ("cloud", False, "state .* point_sigma = true")],
)
def test_sigmas_that_nothing_holds_are_refused(
    tmp_path: Path, layout: str, is_stated: bool, problem: str
) -> None:
    sensor = replace(profiler(), point_sigma=is_stated)
    with pytest.raises(ArctrackError, match=f"--profile sigma: {problem}"):
        write_frames(
            [tmp_path / "no.csv"], ProfileLayout.of([f"layout={layout}", "sigma=4"]), sensor, tmp_path
        )


@given(heights)
def test_gocators_parts(tmp_path_factory: pytest.TempPathFactory, units: list[list[int | None]]) -> None:
    places = ",".join(f"{place:.5f}" for place in profiler().y_mm)
    rows = [
        f"{0.3 * n:.5f}," + ",".join("" if unit is None else f"{0.01 * unit:.5f}" for unit in row)
        for n, row in enumerate(units)
    ]
    head = "Info\nXResolution\n0.3\nEnd\n\nPart\nFrame,Source\n1,0\nY\\X,"
    text = head + places + "\n" + "\n".join(rows) + "\nEnd\n"
    check(read(tmp_path_factory.mktemp("gocator") / "g.csv", text, "layout=gocator"), units, 0.01)


def test_between_neighbours_heights_are_interpolated_and_across_a_gap_never() -> None:
    y_mm = np.array([-4.95, -4.45, -3.95, -2.45, -1.95])
    z_mm = 2.0 * y_mm
    (found,) = on_columns(y_mm, z_mm[None], profiler())
    places = profiler().y_mm
    is_between = ((places >= -4.95) & (places <= -3.95)) | ((places >= -2.45) & (places <= -1.95))
    np.testing.assert_allclose(found[is_between], 2.0 * places[is_between])
    assert np.isnan(found[~is_between]).all()


STATED = {
    "layout": "rows",
    "up_mm": "-0.01",
    "across_mm": "0.5",
    "nothing": "0",
    "separator": "comma",
    "decimal": "point",
}


@pytest.mark.parametrize("missing", STATED)
def test_what_a_file_does_not_say_is_asked_for(tmp_path: Path, missing: str) -> None:
    options = [f"{name}={value}" for name, value in STATED.items() if name != missing]
    with pytest.raises(ArctrackError, match=f"--profile {missing}="):
        read(tmp_path / "rows.csv", "1,2,3\n", *options)


@pytest.mark.parametrize(
    ("option", "problem"),
    [
        ("layuot=rows", "did you mean layout"),
        ("layout", "give KEY=VALUE"),
        ("separator=;", "must be one of comma"),
        ("up_mm=0", "must not be 0"),
        ("across_mm=wide", "must be a finite number"),
    ],
)
def test_a_wrong_key_is_named(tmp_path: Path, option: str, problem: str) -> None:
    name = option.partition("=")[0]
    options = [f"{key}={value}" for key, value in STATED.items() if key != name]
    with pytest.raises(ArctrackError, match=problem):
        read(tmp_path / "rows.csv", "1,2,3\n", *options, option)


def test_a_recording_is_made_and_its_errors_are_lines(tmp_path: Path) -> None:
    (tmp_path / "recording.toml").write_text(SETUP)
    poses = "".join(f"{0.1 * n:.1f},{n},0,0,0,0,0,1\n" for n in range(-1, 5))
    (tmp_path / "poses.csv").write_text("timestamp_s,x_mm,y_mm,z_mm,qx,qy,qz,qw\n" + poses)
    units = [[100 * n + column for column in range(COLUMNS)] for n in range(1, 4)]
    (tmp_path / "rows.csv").write_text("\n".join(",".join(map(str, row)) for row in units))
    files = [tmp_path / "rows.csv", "--setup", tmp_path / "recording.toml", "--poses", tmp_path / "poses.csv"]
    command = ["import", *map(str, files), "--rate-hz", "10", "--out", str(tmp_path / "made")]
    refused = RUNNER.invoke(app, command)
    assert "[camera] is a profiler's: give --profile" in str(refused.exception)
    far = [word for name, value in STATED.items() for word in ("--profile", f"{name}={value}")]
    far[far.index("up_mm=-0.01")] = "up_mm=-10"
    beyond = RUNNER.invoke(app, [*command, *far])
    assert "lie outside [camera] range_mm" in str(beyond.exception)
    assert not (tmp_path / "made").exists()
    options = [word for name, value in STATED.items() for word in ("--profile", f"{name}={value}")]
    done = RUNNER.invoke(app, [*command, *options])
    assert done.exit_code == 0, done.output
    frames = list(read_recording(tmp_path / "made").frames())
    assert len(frames) == len(units)
    for frame, row in zip(frames, units, strict=True):
        assert not isinstance(frame, BadFrame)
        assert frame.image_dn.shape == (2, COLUMNS)
        np.testing.assert_allclose(profiler().z_mm(frame.image_dn[0]), as_mm(list(row), -0.01), atol=1e-3)
