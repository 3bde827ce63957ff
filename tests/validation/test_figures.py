import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import arctrack
from arctrack.errors import ArctrackError
from validation.figures import paper_figures
from validation.figures.__main__ import figures
from validation.figures.paper_curves import FIGURES

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("figures") / "made" / "here"
    result = RUNNER.invoke(figures, ["paper", "--out", str(folder)])
    assert result.exit_code == 0, result.output
    for number in FIGURES:
        assert f"figure_{number:02d}.png and .csv" in result.output
    return folder


@pytest.mark.slow
def test_a_picture_and_its_numbers_for_each_figure(drawn: Path) -> None:
    assert len(list(drawn.iterdir())) == 2 * len(FIGURES)
    for number in FIGURES:
        path = drawn / f"figure_{number:02d}.png"
        height, width, _ = cv2.imread(str(path)).shape
        assert (width, height) == (924, 473)
        assert path.stat().st_size < 80_000


@pytest.mark.slow
def test_the_numbers_can_be_read_again(drawn: Path) -> None:
    curves = np.genfromtxt(drawn / "figure_09.csv", delimiter=",", names=True)
    assert curves.dtype.names == ("phi_r_deg", "extended", "point")
    assert curves["extended"][90] == 1.0
    wide = np.genfromtxt(drawn / "figure_11.csv", delimiter=",", names=True)
    assert wide["theta_r_deg"][wide["mild_steel_f_r"].argmax()] == 62.0


@pytest.mark.slow
@pytest.mark.parametrize("number", FIGURES)
def test_nothing_is_cut_off_and_every_axis_has_its_unit(number: int) -> None:
    figure = paper_figures.draw(FIGURES[number]())
    figure.savefig(os.devnull, format="png")
    page = figure.bbox
    for text in (figure.get_suptitle(), figure.get_supxlabel()):
        assert text
    for artist in (figure._suptitle, figure._supxlabel):
        box = artist.get_window_extent()
        assert page.x0 <= box.x0
        assert box.x1 <= page.x1
        assert page.y0 <= box.y0
        assert box.y1 <= page.y1
    for axes in figure.axes:
        assert axes.get_xlabel().endswith(("[mm]", "[deg]"))
        assert axes.get_ylabel()
        assert axes.get_legend() is not None


def test_captions_keep_numbers_and_units_together() -> None:
    caption = str(paper_figures.draw(FIGURES[6]()).get_supxlabel())
    for pair in ("R\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}2\N{NO-BREAK SPACE}mm", "−68\N{NO-BREAK SPACE}%"):
        assert pair in caption


def test_help_shows_an_example() -> None:
    for command in ([], ["paper"]):
        result = RUNNER.invoke(figures, [*command, "--help"])
        assert result.exit_code == 0
        assert "Example: python -m validation.figures paper" in result.output


@pytest.mark.slow
def test_a_folder_that_cannot_be_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(ArctrackError, match="cannot be written"):
        RUNNER.invoke(figures, ["paper", "--out", str(file)], catch_exceptions=False)
    done = subprocess.run(
        [sys.executable, "-m", "validation.figures", "paper", "--out", str(file)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(Path(arctrack.__file__).parents[1])},
    )
    assert done.returncode == 2
    assert done.stderr.startswith(f"arctrack: error: {file}: cannot be written")
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_the_animation_shows_a_frame_a_quarter_of_a_second(
    compiled: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("validation.figures.animation.FRAMES", 3)
    result = RUNNER.invoke(figures, ["animation", "--out", str(tmp_path / "made")])
    assert result.exit_code == 0, result.output
    with Image.open(tmp_path / "made" / "replay.webp") as picture:
        assert (picture.n_frames, picture.width) == (3, 480)
        picture.seek(2)
        picture.load()
        assert picture.info["duration"] == 250
