import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.nominal import nominal_setup
from arctrack.plan.plan_files import draw_designs, draw_path, write_tables
from arctrack.recording import format_setup
from arctrack.simulation.simulate import balance
from noise_model.plan.plan import Plan, PlanOptions, make_plan
from noise_model.setup import Setup

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})
FEW = ["--tilt", "20", "30", "--azimuth", "0", "30", "--preview", "35", "35", "--stand-off", "100", "175"]
FEW += ["--filter-nm", "10"]
OPTIONS = PlanOptions(
    tilt_deg=(20.0, 30.0),
    azimuth_deg=(-30.0, 150.0),
    preview_mm=(35.0, 35.0),
    stand_off_mm=(143.0, 143.0),
    filters_nm=(10.0,),
)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def written(setup: Setup, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "recording.toml").write_text(format_setup(setup))
    return folder


@pytest.fixture(scope="module")
def glare() -> Plan:
    """Return the plan of a steel corrugation whose flanks mirror the arc into the camera."""
    setup = balance(nominal_setup("corrugation", "mild_steel", width=320, height=240))
    joint = replace(setup.joint, seam_in_base_mm=((0.0, 0.0, 0.0), (120.0, 0.0, 0.0)))
    return make_plan(replace(setup, joint=joint), OPTIONS)


@pytest.mark.slow
def test_a_plan_from_a_setup(simulated: Path, tmp_path: Path) -> None:
    out = tmp_path / "plans" / "v"
    result = RUNNER.invoke(app, ["plan", str(simulated), "--out", str(out), *FEW])
    assert result.exit_code == 0, result.output
    for text in ("yours", "paper's rules, for mild_steel", "small tilt", "plane of incidence", "61 stations"):
        assert text in result.output
    assert sorted(path.name for path in out.iterdir()) == [
        "costs.csv",
        "path.csv",
        "path.png",
        "plan.csv",
        "plan.png",
    ]
    designs = rows(out / "plan.csv")
    assert [row["design"] for row in designs] == ["yours"] + ["front"] * (len(designs) - 1)
    assert len(designs) > 1
    sigmas = [float(row["sigma_mm"]) for row in designs]
    assert sigmas[1:] == sorted(sigmas[1:])
    assert float(designs[0]["stand_off_mm"]) == pytest.approx(142.8, abs=0.1)
    assert {row["stand_off_mm"] for row in designs[1:]} <= {"100", "175"}
    stations = rows(out / "path.csv")
    assert len(stations) == 61
    assert all(row["blind"] == "0" and row["cure_exposure_s"] == "" for row in stations)
    for name in ("plan.png", "path.png"):
        assert cv2.imread(str(out / name)).shape[1] > 1000
    costs = {(row["id"], row["size"]): row for row in rows(out / "costs.csv")}
    assert float(costs["hand_eye", "tolerance"]["lateral_mm"]) > 0.05
    assert float(costs["gamma", "typical"]["lateral_mm"]) < 0.05
    assert costs["interreflection", "typical"]["flag"] == "not_rendered"
    assert "cost of an effect that the tracker does not know" in result.output


@pytest.mark.slow
def test_a_plan_along_recorded_poses(simulated: Path, tmp_path: Path) -> None:
    result = RUNNER.invoke(app, ["plan", str(simulated), "--out", str(tmp_path), "--recorded", *FEW])
    assert result.exit_code == 0, result.output
    stations = rows(tmp_path / "path.csv")
    place = np.array([float(row["station_mm"]) for row in stations])
    # The seam begins at x = -100 mm and the tool travels forward from x = 0 at 8 mm/s.
    assert place[0] == pytest.approx(100.0 - 0.4 * 8.0, abs=0.5)
    assert (np.diff(place) > 0.0).all()
    sigma = np.array([float(row["sigma_mm"]) for row in stations])
    assert np.ptp(sigma) > 1e-5


@pytest.mark.slow
def test_blind_stretches_and_their_cures_are_in_table_and_picture(glare: Plan, tmp_path: Path) -> None:
    assert glare.cures
    write_tables(glare, tmp_path)
    stations = rows(tmp_path / "path.csv")
    blind = [n for n, row in enumerate(stations) if row["blind"] == "1"]
    assert blind == [n for cure in glare.cures for n in range(cure.first, cure.last + 1)]
    for n in blind:
        assert float(stations[n]["saturated_share"]) > 0.1
        assert float(stations[n]["cure_exposure_s"]) < 0.005
        assert float(stations[n]["cure_exposed_sigma_mm"]) < glare.limit_mm
        assert stations[n]["cure_azimuth_deg"] != ""
    assert float(stations[0]["sigma_mm"] or "inf") > glare.limit_mm or stations[0]["blind"] == "0"
    figure = draw_path(glare)
    figure.savefig(tmp_path / "path.png")
    spans = [patch for axes in figure.axes for patch in axes.patches]
    assert len(spans) >= 2 * len(glare.cures)
    draw_designs(glare, 12.5).savefig(tmp_path / "plan.png")


@pytest.mark.slow
def test_a_bent_seam_is_drawn_from_above(glare: Plan) -> None:
    bent = ((0.0, 0.0, 0.0), (60.0, 0.0, 0.0), (60.0, 60.0, 0.0))
    setup = replace(glare.setup, joint=replace(glare.setup.joint, seam_in_base_mm=bent))
    figure = draw_path(replace(glare, setup=setup))
    assert figure.axes[0].get_xlabel() == "base x [mm]"


@pytest.mark.slow
def test_nothing_of_the_pictures_is_cut_off(glare: Plan, tmp_path: Path) -> None:
    for figure in (draw_designs(glare, 12.5), draw_path(glare)):
        figure.savefig(tmp_path / "page.png")
        for axes in figure.axes:
            for text in (axes.title, axes._left_title, axes.xaxis.label, axes.yaxis.label):
                box = text.get_window_extent()
                if text.get_text():
                    assert figure.bbox.x0 <= box.x0
                    assert box.x1 <= figure.bbox.x1
                    assert figure.bbox.y0 <= box.y0
                    assert box.y1 <= figure.bbox.y1


def test_help_shows_an_example() -> None:
    result = RUNNER.invoke(app, ["plan", "--help"])
    assert result.exit_code == 0
    assert "Example: arctrack plan examples/v_groove" in result.output


def test_what_cannot_be_planned_is_one_line(seen_setup: Setup, tmp_path: Path) -> None:
    flat = replace(seen_setup, joint=replace(seen_setup.joint, type="flat", dimensions={}))
    folder = written(flat, tmp_path / "flat")
    for arguments, message in (
        ([str(folder)], "no seam point"),
        ([str(tmp_path / "nowhere")], "no such file"),
        ([str(written(seen_setup, tmp_path / "v")), "--tilt", "30", "20"], "tilt_deg 30 to 20"),
        ([str(tmp_path / "v"), "--speckle", "2"], "speckle contrast"),
        ([str(tmp_path / "v"), "--speckle", "nan"], "speckle contrast"),
        ([str(tmp_path / "v"), "--filter-nm", "inf"], "filters_nm: must be > 0 and finite"),
        ([str(tmp_path / "v"), "--exposure-ms", "nan"], "--exposure-ms nan: must be > 0 and finite"),
        ([str(tmp_path / "v"), "--exposure-ms", "-5"], "--exposure-ms -5: must be > 0 and finite"),
        ([str(tmp_path / "v"), "--recorded"], "frames.csv"),
    ):
        with pytest.raises(ArctrackError, match=message):
            RUNNER.invoke(app, ["plan", *arguments, "--out", str(tmp_path / "out")], catch_exceptions=False)


def test_a_folder_that_cannot_be_is_one_line(simulated: Path, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(ArctrackError, match="cannot be written"):
        RUNNER.invoke(app, ["plan", str(simulated), "--out", str(file), *FEW], catch_exceptions=False)
