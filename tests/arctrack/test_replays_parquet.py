"""The frames of several replays as one Parquet file, read back by Arrow's own reader."""

import csv
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.recording.parquet_file import ReplayedRecording, check_parquet, write_parquet
from arctrack.recording.results import COLUMNS
from tests.arctrack.test_replays_at_once import copies, run

parquet = pytest.importorskip("pyarrow.parquet")

OWN_TEXTS = ("run_validity", "run_gate_reason", "run_pose_doubt", "weld_refusal")
TEXTS = (
    "recording",
    "recording_path",
    "flags",
    "pose_doubt",
    "validity",
    "gate_reason",
    *OWN_TEXTS,
    "arc_height_unknown",
)


def expected(recording: Path, results: Path) -> list[dict[str, object]]:
    """Return the rows that a replay's results.csv makes."""
    rows = []
    with (results / "results.csv").open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            values: dict[str, object] = {"recording": recording.name, "recording_path": str(recording)}
            for name, text in row.items():
                values[name] = None if text == "" else text if name in TEXTS else float(text)
            rows.append(values)
    return rows


@pytest.mark.slow
def test_a_fleets_frames_are_one_table(compiled: None, simulated: Path, tmp_path: Path) -> None:
    first, broken, last = copies(simulated, tmp_path, "a", "b", "c")
    (broken / "poses.csv").unlink()
    file, out = tmp_path / "fleet.parquet", tmp_path / "out"
    command = (first, broken, last, "--parquet", file, "--out", out)
    done = run(*command)
    assert done.exit_code == 2
    assert f"28 frames of 2 recordings in {file}" in done.stdout.splitlines()
    table = parquet.read_table(file)
    assert table.column_names == ["recording", "recording_path", *COLUMNS]
    types = {name: str(table.schema.field(name).type) for name in table.column_names}
    assert {types.pop(name) for name in TEXTS} == {"string"}
    assert (types.pop("frame"), types.pop("valid")) == ("int64", "bool")
    assert set(types.values()) == {"double"}
    rows = table.to_pylist()
    assert rows == expected(first, out / "a") + expected(last, out / "c")
    assert any(row["valid"] for row in rows)
    # What an earlier run finished is in the table too.
    resumed = run(*command, "--resume", "--workers", "2")
    assert "c: taken over: results in" in resumed.stdout
    assert parquet.read_table(file).to_pylist() == rows


def test_a_frame_without_values_has_nulls(tmp_path: Path) -> None:
    values = {"frame": "7", "timestamp_s": "0.140000", "valid": "0", "flags": "frame_unreadable"}
    row = ",".join(values.get(name, "") for name in COLUMNS)
    (tmp_path / "results.csv").write_text(f"{','.join(COLUMNS)}\n{row}\n")
    file = tmp_path / "fleet.parquet"
    assert write_parquet(file, [ReplayedRecording(tmp_path, tmp_path)]) == 1
    (kept,) = parquet.read_table(file).to_pylist()
    assert {name: value for name, value in kept.items() if value is not None} == {
        "recording": tmp_path.name,
        "recording_path": str(tmp_path),
        "frame": 7,
        "timestamp_s": 0.14,
        "valid": False,
        "flags": "frame_unreadable",
    }


def test_a_table_that_cannot_be_made_leaves_the_one_that_is_there(tmp_path: Path) -> None:
    file = tmp_path / "fleet.parquet"
    assert write_parquet(file, []) == 0
    assert parquet.read_table(file).num_rows == 0
    before = file.read_bytes()
    with pytest.raises(ArctrackError, match=r"results\.csv: there is no such file$"):
        write_parquet(file, [ReplayedRecording(tmp_path, tmp_path / "gone")])
    assert file.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == [file.name]


def test_a_place_where_no_file_can_be_is_named_before_the_replay(tmp_path: Path) -> None:
    with pytest.raises(ArctrackError, match=r"is a folder; --parquet takes a file$"):
        check_parquet(tmp_path)
    with pytest.raises(
        ArctrackError, match=r"gone/fleet\.parquet: cannot be written: there is no such folder$"
    ):
        check_parquet(tmp_path / "gone" / "fleet.parquet")


def test_without_its_package_the_command_says_how_to_get_it(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "pyarrow.parquet")
    done = CliRunner().invoke(
        app, ["replay", str(recording), "--out", str(tmp_path / "out"), "--parquet", str(tmp_path / "f")]
    )
    assert isinstance(done.exception, ArctrackError)
    assert str(done.exception) == (
        "--parquet: needs the package pyarrow, which is not installed; pip install 'arctrack[parquet]'"
    )
    assert list(tmp_path.iterdir()) == []
