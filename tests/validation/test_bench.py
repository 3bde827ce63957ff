"""The benchmark: its scores by hand, its rivals on a plain stripe, a stranger's method, scenes from seeds."""

import math
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tracker.state import Frame, Pose
from validation.bench import unet
from validation.bench.__main__ import bench
from validation.bench.methods import MethodReading, corner_of, on_sheet
from validation.bench.rivals import READERS, scaled
from validation.bench.scenes import HERE, JUDGED, KEPT, TruthFrame, drawn, read_scene, seeds_of
from validation.bench.score import SEAM, STRIPE, FrameScore, figures, score_frame

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})
WIDTH_PX = 3.0


def given(stripe_px, seam_mm=(35.0, 1.0, -2.0)) -> TruthFrame:
    frame = Frame(0, 0.0, np.zeros((4, 4), np.uint8), 1e-3, 0.0, True, False)
    seam = np.array(seam_mm, dtype=float)
    return TruthFrame(frame, Pose(np.eye(4)), np.array(stripe_px, dtype=float), seam, np.zeros(2))


def of(scores, statistics):
    return {name: figure.value for name, figure in figures([scores], statistics)}


def test_a_stripe_is_scored_line_by_line() -> None:
    nan = math.nan
    true = given([10.0, 10.0, 10.0, 10.0, 10.0, nan])
    reading = MethodReading(np.array([10.5, 9.5, nan, 30.0, 10.0, 7.0]), np.array([0.5] * 6))
    (score,) = [score_frame(reading, true, WIDTH_PX, 2.0)]
    assert (score.lines, score.found, score.gross, score.false_lines, score.run) == (5, 3, 1, 1, 2)
    told = of([score], STRIPE)
    assert told["found"] == pytest.approx(3 / 5)
    assert told["RMS px"] == pytest.approx(math.sqrt(0.5 / 3))
    assert told["bias px"] == pytest.approx(0.0)
    assert told["error/σ"] == pytest.approx(math.sqrt(2.0 / 3))
    # Masks of 12 px: 11.5, 11.5, 12 and nothing of 20 px off are common to five true ones and five read ones.
    assert told["IoU"] == pytest.approx(35.0 / (12 * 10 - 35.0))
    assert told["continuity"] == pytest.approx(2 / 5)
    assert told["CPU"] == 2.0


@pytest.mark.parametrize(
    ("seam", "sigma", "is_false"),
    [
        ((35.0, 1.1, -2.0), None, False),
        ((35.0, 1.3, -2.0), None, True),
        # It says that it is unsure.
        ((35.0, 1.3, -2.0), (0.1, 0.1), False),
        ((35.0, 1.3, -2.0), (0.02, 0.1), True),
    ],
)
def test_a_seam_is_false_beyond_a_quarter_millimetre_and_its_own_doubt(seam, sigma, is_false) -> None:
    stated = None if sigma is None else np.array(sigma)
    reading = MethodReading(seam_mm=np.array(seam), seam_sigma_mm=stated, is_valid=True)
    assert score_frame(reading, given([1.0]), WIDTH_PX, 1.0).is_false is is_false


def test_a_valid_seam_on_a_plate_is_false() -> None:
    plate = given([1.0], (math.nan,) * 3)
    reading = MethodReading(seam_mm=np.array([35.0, 0.0, 0.0]), is_valid=True)
    score = score_frame(reading, plate, WIDTH_PX, 1.0)
    assert score.is_false
    assert math.isnan(of([score], SEAM)["RMS y mm"])
    assert of([score, FrameScore(reads_seam=True)], SEAM)["false"] == 1.0


def test_an_interval_holds_the_value() -> None:
    draw = np.random.default_rng(0)
    scenes = [
        [score_frame(MethodReading(np.array([10.0 + draw.normal()])), given([10.0]), WIDTH_PX, 1.0)]
        for _ in range(40)
    ]
    rms = dict(figures(scenes, STRIPE))["RMS px"]
    assert rms.low < rms.value < rms.high
    assert rms.high - rms.low == pytest.approx(4.0 / math.sqrt(80.0), rel=0.6)


@pytest.mark.parametrize("name", READERS)
def test_a_reader_finds_a_plain_stripe(name: str) -> None:
    """A Gaussian that falls by one pixel in ten columns, over noise: within a tenth of its sigma."""
    draw = np.random.default_rng(1)
    rows, columns = np.mgrid[:120, :160].astype(float)
    true = 60.0 + 0.1 * columns[0]
    image = 20.0 + 150.0 * np.exp(-0.5 * ((rows - true) / WIDTH_PX) ** 2) + draw.normal(0.0, 1.0, rows.shape)
    read = scaled(name, 1.0)(np.rint(image).astype(np.uint8), WIDTH_PX)
    error = (read - true)[20:-20]
    assert np.isfinite(error).all()
    assert abs(np.median(error)) < 0.1 * WIDTH_PX
    assert np.sqrt(np.mean(error**2)) < 0.15 * WIDTH_PX


def test_the_corner_is_the_place_farthest_off_the_chord() -> None:
    columns = np.arange(200)
    rows = 50.0 + 0.5 * np.abs(columns - 120)
    rows[40] = 300.0
    column, row = corner_of(rows, 5.0)
    assert column == pytest.approx(120, abs=2)
    assert row == pytest.approx(50.0, abs=2)
    assert corner_of(np.full(200, 50.0), 5.0) is None


def test_the_truth_of_a_kept_scene_fits_its_geometry() -> None:
    """The seam's pixel, carried onto the sheet, is the seam."""
    for path in sorted(HERE.iterdir())[:3]:
        scene = read_scene(path)
        for frame in scene.frames:
            if np.isfinite(frame.seam_px).all():
                assert on_sheet(scene.setup, frame.seam_px) == pytest.approx(frame.seam_mm, abs=0.02)


def test_the_repository_has_the_first_scenes_of_each_set() -> None:
    wanted = {f"{kind}_{seed}" for kind in JUDGED for seed in seeds_of(kind, KEPT[kind])}
    assert {path.name for path in HERE.iterdir()} == wanted


@pytest.mark.slow
def test_a_scene_is_drawn_anew_from_its_seed_to_the_bit() -> None:
    seed = seeds_of("plain")[1]
    kept, anew = read_scene(HERE / f"plain_{seed}"), drawn("plain", seed)
    for ours, other in zip(kept.frames, anew.frames, strict=True):
        assert np.array_equal(ours.frame.image_dn, other.frame.image_dn)
        assert ours.stripe_px == pytest.approx(other.stripe_px, abs=1e-4, nan_ok=True)
        assert ours.seam_mm == pytest.approx(other.seam_mm, abs=1e-5, nan_ok=True)


@pytest.mark.slow
def test_a_strangers_method_stands_in_the_table(compiled: None, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "import numpy as np\n\n\ndef read(image, width_px):\n    return image.argmax(axis=0).astype(float)\n"
    )
    folder = tmp_path / "scenes"
    for path in sorted(HERE.iterdir())[:2]:
        shutil.copytree(path, folder / path.name)
    words = ["run", str(folder), "--only", "arctrack", "--only", "centroid", "--method", "mine:read"]
    ran = subprocess.run(
        [sys.executable, "-m", "validation.bench", *words],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONPATH": f"{tmp_path}:{Path(__file__).parents[2]}"} | _environment(),
    )
    rows = [line for line in ran.stdout.splitlines() if line.startswith("| ") and "---" not in line]
    assert [row.split(" | ")[0] for row in rows] == [
        *("| stripe", "| arctrack", "| centroid", "| mine:read"),
        *("| seam", "| arctrack", "| centroid", "| mine:read"),
    ]


def _environment() -> dict[str, str]:
    import os

    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["run", "nowhere"], "nowhere: holds no scenes; python -m validation.bench make --out nowhere"),
        (
            ["run", "--only", "magic"],
            "--only magic: there is no such method; there are arctrack, ",
        ),
        (
            ["run", "--method", "math:magic"],
            "--method math:magic: module 'math' has no attribute 'magic'",
        ),
    ],
)
def test_a_mistake_is_told_in_one_line(words: list[str], problem: str) -> None:
    result = RUNNER.invoke(bench, words)
    assert str(result.exception).startswith(problem)


def test_a_network_that_is_not_there_is_named_with_its_cure(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(unet, "WEIGHTS", tmp_path / "unet.npz")
    result = RUNNER.invoke(bench, ["run", "--only", "u-net"])
    assert str(result.exception).startswith("--only u-net: needs pip install torch, and its weights: ")
