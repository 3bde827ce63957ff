"""`arctrack new`: a setup that reads back, with a word on each of its numbers."""

from __future__ import annotations

import runpy
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.control.cell_file.model import CellToml
from arctrack.errors import ArctrackError
from arctrack.nominal import DIMENSIONS, nominal_setup
from arctrack.recording import format_setup, read_recording, read_setup_file
from arctrack.recording.new import RADIANCE_E, commented_setup, write_new
from arctrack.recording.schema import keys_of, table_in
from arctrack.recording.setup_model import RecordingToml
from noise_model.surface.brdf import TABLE_1

ROOT = Path(__file__).parents[2]
RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})


@pytest.mark.parametrize("material", TABLE_1)
@pytest.mark.parametrize("joint", DIMENSIONS)
def test_what_is_written_is_a_setup(joint: str, material: str, tmp_path: Path) -> None:
    written, *_ = write_new(tmp_path / "mine", joint, material)
    stated = read_setup_file(written)
    assert stated.unknown_keys == ()
    assert stated.setup.joint == nominal_setup(joint, material).joint
    assert stated.setup.material == nominal_setup(joint, material).material
    assert stated.setup.arc.radiance_e == RADIANCE_E


def test_comments_change_nothing() -> None:
    setup = nominal_setup("lap", "zn_coated")
    plain = [line for line in commented_setup(setup).splitlines() if line and not line.startswith("#")]
    assert plain == [line for line in format_setup(setup).splitlines() if line]


def test_each_key_has_a_comment() -> None:
    lines = commented_setup(nominal_setup("v_groove", "mild_steel")).splitlines()
    first_table = lines.index("[camera]")
    for before, line in zip(lines[first_table:], lines[first_table + 1 :], strict=False):
        if " = " in line and not line.startswith("#"):
            assert before.startswith("#"), line


def test_each_key_that_is_needed_is_written() -> None:
    texts = [commented_setup(nominal_setup(joint, "mild_steel")) for joint in DIMENSIONS]
    for key in keys_of(RecordingToml):
        is_needed = key.field.is_required() and not key.table.startswith(("robot", "calibration"))
        # A free joint's section is taught: there is no nominal one.
        is_taught = key.name == "section_mm"
        if is_needed or (key.table == "joint" and not key.text("example") and not is_taught):
            above = f"[{key.table}]\n" if key.table else ""
            assert any(f"\n{key.name} = " in text.partition(above or "\n")[2] for text in texts), key


def plain_fields(model: type[BaseModel]) -> Iterator[tuple[str, FieldInfo]]:
    for name, info in model.model_fields.items():
        below = table_in(info)
        yield from [(name, info)] if below is None else plain_fields(below)


@pytest.mark.parametrize("file", [RecordingToml, CellToml])
def test_each_key_of_a_file_is_described(file: type[BaseModel]) -> None:
    named = {name for name, info in plain_fields(file) if not info.description}
    assert named <= {"effects"}, "state it by arctrack.recording.schema.key"


def test_each_number_of_a_setup_says_its_unit_and_where_it_comes_from() -> None:
    units = {"mm": "mm", "deg": "deg", "nm": "nm", "px": "px", "s": "s", "a": "A", "e": "e-", "dn": "DN"}
    for key in keys_of(RecordingToml):
        if key.table.startswith(("follow", "robot", "calibration")) or not key.table:
            continue
        assert key.text("source"), key
        unit = units.get(key.name.rpartition("_")[2])
        assert unit is None or unit in key.text("unit"), key


def test_an_optional_key_is_read_once_its_mark_is_gone(tmp_path: Path) -> None:
    path = tmp_path / "recording.toml"
    text = commented_setup(nominal_setup("v_groove", "mild_steel"))
    path.write_text(text.replace("# fan_half_angle_deg", "fan_half_angle_deg"))
    stated = read_setup_file(path)
    assert stated.setup.laser.fan_half_angle_deg == 30.0
    assert read_setup_file(path).unknown_keys == ()
    path.write_text(format_setup(stated.setup))
    assert read_setup_file(path).setup.laser == stated.setup.laser


def test_a_robot_with_z_into_the_part_is_read_as_the_comment_says(tmp_path: Path) -> None:
    path = tmp_path / "recording.toml"
    text = commented_setup(nominal_setup("v_groove", "mild_steel"))
    head, foot = text.split("# [robot.controllertool_to_tool]\n")
    lines = foot.splitlines()
    path.write_text("\n".join([head, "[robot.controllertool_to_tool]", *(line[2:] for line in lines[:2])]))
    T_tool_controllertool = read_setup_file(path).T_tool_controllertool
    assert T_tool_controllertool is not None
    assert T_tool_controllertool[:3, 2].tolist() == [0.0, 0.0, -1.0]


def test_a_new_recording_with_frames_and_poses_is_one(tmp_path: Path) -> None:
    example, mine = ROOT / "examples" / "v_groove", tmp_path / "mine"
    result = RUNNER.invoke(app, ["new", str(mine)])
    assert result.exit_code == 0
    assert str(mine / "recording.toml") in result.stdout
    with pytest.raises(ArctrackError, match=r"frames\.csv: holds no rows"):
        read_recording(mine)
    for name in ("frames.csv", "poses.csv"):
        header = (mine / name).read_text()
        text = (example / name).read_text()
        assert text.startswith(header)
        (mine / name).write_text(text)
    shutil.copytree(example / "frames", mine / "frames", dirs_exist_ok=True)
    assert read_recording(mine).warnings == ()


def test_what_is_there_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ArctrackError, match="exists already; remove it or choose another name"):
        write_new(tmp_path, "lap", "mild_steel")
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_the_documentation_is_in_step() -> None:
    pages = runpy.run_path(str(ROOT / "docs" / "keys_table.py"))["pages"]()
    for name, text in pages.items():
        page = (ROOT / "docs" / "reference" / name).read_text(encoding="utf-8")
        assert page == text, "make it anew: python docs/keys_table.py"
