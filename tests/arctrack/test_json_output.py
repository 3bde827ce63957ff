"""`--json`: one object on stdout, with the keys that docs/reference/json_output.md names."""

import json
import math
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import arctrack
from arctrack.cli import app
from arctrack.cli.doctor import json_content
from arctrack.cli.json_output import say_json
from arctrack.control.cell_file.new import write_new_cell
from arctrack.errors import ArctrackError
from arctrack.live.doctor.examine import Budget, LatencyPart
from arctrack.live.doctor.finding import DoctorFinding, FindingState

PAGE = Path(arctrack.__file__).parents[1] / "docs" / "reference" / "json_output.md"
RUNNER = CliRunner()


def paths(value: Any, above: str = "") -> Iterator[str]:
    """Yield the places of all values but objects, `flags` and `keys`, whose names are free."""
    if isinstance(value, dict) and above not in ("flags", "keys"):
        for key, each in value.items():
            yield from paths(each, f"{above}.{key}" if above else key)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for each in value:
            yield from paths(each, f"{above}[]")
    else:
        yield above


def documented(command: str) -> set[str]:
    """Return the keys that the page names for a command."""
    section = PAGE.read_text().split(f"## arctrack {command}\n")[1].split("\n## ")[0]
    cells = re.findall(r"^\| (`.*?) \|", section, re.M)
    return {key for cell in cells for key in re.findall(r"`([^`]+)`", cell)}


def result_of(*words: str, exit_code: int = 0) -> dict[str, Any]:
    result = RUNNER.invoke(app, [*words, "--json"])
    assert result.exit_code == exit_code, result.output

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    content: dict[str, Any] = json.loads(result.stdout, parse_constant=refuse)
    assert content["format"] == f"arctrack-{words[0]}/1"
    return content


@pytest.mark.slow
def test_check(simulated: Path, tmp_path: Path) -> None:
    found = result_of("check", str(simulated), "--out", str(tmp_path / "seen.png"))
    assert set(paths(found)) == documented("check")
    assert found["frames"] == 14
    assert found["valid"] == found["looked_at"] > 5
    assert found["refusal"] is None
    assert (found["warnings"], found["keys"]) == ([], {})
    assert Path(found["picture"]).exists()


@pytest.mark.slow
def test_a_check_that_refuses_has_its_object_and_its_line(simulated: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(simulated, tmp_path / "r"))
    head, *rows = (path / "poses.csv").read_text().splitlines()
    late = [f"{float(time) + 1000.0},{rest}" for time, rest in (row.split(",", 1) for row in rows)]
    (path / "poses.csv").write_text("\n".join([head, *late]))
    result = RUNNER.invoke(app, ["check", str(path), "--json"])
    assert isinstance(result.exception, ArctrackError)
    assert json.loads(result.stdout)["refusal"] == str(result.exception)


@pytest.mark.slow
def test_inspect(simulated: Path, tmp_path: Path) -> None:
    found = result_of("inspect", str(simulated), "--out", str(tmp_path / "seen.png"))
    assert set(paths(found)) == documented("inspect")
    assert (found["width_px"], found["height_px"], found["frames"]) == (160, 120, 14)
    assert sum(condition["frames"] for condition in found["conditions"]) == 14
    assert found["has_truth"] is True
    assert len(found["motion"]["lateral_mm"]) == 2


@pytest.mark.slow
def test_doctor(tmp_path: Path) -> None:
    found = result_of("doctor")
    assert found["budget"] is None
    assert sum(found["counts"].values()) == len(found["findings"])
    cell, _ = write_new_cell(tmp_path / "cell", "lap", "mild_steel")
    budget = Budget((LatencyPart("step", math.nan, math.inf, "not measured"),), 0.1)
    with_cell = json_content(
        cell, [DoctorFinding("clock", FindingState.OK, "tsc")], dict.fromkeys(FindingState, 0), budget
    )
    assert set(paths({"format": "", **with_cell})) == documented("doctor")


@pytest.mark.slow
def test_plan(simulated: Path, tmp_path: Path) -> None:
    options = ["--tilt", "20", "40", "--preview", "35", "36", "--stand-off", "140", "150"]
    found = result_of("plan", str(simulated), *options, "--out", str(tmp_path))
    rules = found["rules"]
    assert rules["tilt"].keys() == rules["head"].keys() == rules["azimuth"].keys()
    found["rules"] = rules | {"head": None, "azimuth": None}
    # Each effect has parameters of its own.
    assert all(each["parameters"] for each in found["costs"])
    found["costs"] = [each | {"parameters": None} for each in found["costs"]]
    assert set(paths(found)) == documented("plan")
    assert found["designs"][0]["design"] == "yours"
    assert found["stations"]


def test_what_is_not_known_is_null(capsys: pytest.CaptureFixture[str]) -> None:
    say_json("check", {"a": math.nan, "b": [math.inf, (1.5, -math.inf)], "c": {"d": Path("/x")}})
    said = json.loads(capsys.readouterr().out)
    assert said == {"format": "arctrack-check/1", "a": None, "b": [None, [1.5, None]], "c": {"d": "/x"}}


def test_an_error_is_a_line_and_no_object(tmp_path: Path) -> None:
    for command in ("check", "inspect", "plan", "doctor"):
        result = RUNNER.invoke(app, [command, str(tmp_path / "gone"), "--json"])
        assert result.stdout == ""
        assert "there is no such" in str(result.exception)
