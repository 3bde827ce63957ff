"""Five passes of a V-groove in the simulated cell: the root sees it, the others follow it again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arctrack.control.cell_file.choices import AgainChoice, CellJob
from arctrack.control.job import PartLimits
from arctrack.recording.seam_file import read_seam
from arctrack.simulation.cell.weld.closed_loop import ClosedLoop, LoopPlan
from robot_io import Validity
from tracker.seam.correction import UNSTATED

PLAN = LoopPlan(
    joint="v_groove",
    displaced_mm=1.5,
    slope=0.01,
    bend_mm=0.4,
    length_mm=60.0,
    weave_mm=0.5,
    rate_hz=12.5,
    size_px=(320, 240),
)
"""A seam that lies off, leans and bends."""

PLACES_MM = ((-1.5, 1.5), (1.5, 1.5), (-3.0, 3.0), (3.0, 3.0))
"""Side and height of the passes above the root."""

WITHIN_MM = 0.1


def root_job(seam: Path) -> CellJob:
    return CellJob("root", None, UNSTATED, False, PartLimits(), None, keep_seam=seam)


def upper_job(seam: Path, side_mm: float, height_mm: float, laser: bool = False) -> CellJob:
    again = AgainChoice(seam, side_mm=side_mm, height_mm=height_mm, laser=laser)
    return CellJob("fill", None, again.displaced(UNSTATED), False, PartLimits(), None, again=again)


def off_mm(loop: ClosedLoop, side_mm: float = 0.0, height_mm: float = 0.0) -> np.ndarray:
    """Return the torch's distance from its pass's true place after lock (n, 2), mm."""
    lock_s = loop.lock_s()
    locked = [sample for sample in loop.samples if sample.time_s >= lock_s]
    assert locked
    return np.array(
        [np.subtract(sample.torch_mm, sample.seam_mm) - (side_mm, height_mm) for sample in locked]
    )


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> tuple[ClosedLoop, Path]:
    seam = tmp_path_factory.mktemp("passes") / "root.json"
    loop = ClosedLoop(replace(PLAN, job=root_job(seam)))
    loop.run()
    assert not seam.exists()
    loop.cell.tracker.service.close()
    return loop, seam


@pytest.mark.slow
def test_a_pass_keeps_its_seam_with_its_sigma(root: tuple[ClosedLoop, Path]) -> None:
    loop, seam = root
    kept = read_seam(seam)
    stations_mm = kept.points_base_mm[:, 0]
    world = loop.cell.world
    true_mm = np.array([world.seam_mm(x_mm - world.start_base_mm[0]) for x_mm in stations_mm])
    errors = (kept.points_base_mm[:, 1:] - true_mm) / kept.sigmas_mm
    assert np.sqrt((errors**2).mean()) < 2.0
    assert (np.diff(stations_mm) > 0.5).all()
    assert stations_mm[-1] - stations_mm[0] > 50.0
    assert np.isfinite(kept.gaps_mm).mean() > 0.8
    assert np.isfinite(kept.areas_mm2).mean() > 0.8


@pytest.mark.slow
def test_five_passes_are_placed_within_a_tenth_of_a_millimetre(root: tuple[ClosedLoop, Path]) -> None:
    loop, seam = root
    worst = [np.hypot(*off_mm(loop).T).max()]
    for side_mm, height_mm in PLACES_MM:
        upper = ClosedLoop(replace(PLAN, job=upper_job(seam, side_mm, height_mm)))
        upper.run()
        worst.append(np.hypot(*off_mm(upper, side_mm, height_mm).T).max())
        settled = [f for f in upper.frames if f.sample.time_s >= upper.lock_s()]
        assert {f.offset.validity for f in settled} == {Validity.VALID}
        assert all("pass_followed" in f.track.flag_names for f in settled)
    print("largest distance of each pass, mm:", np.round(worst, 3))
    assert max(worst) <= WITHIN_MM


@pytest.mark.slow
def test_an_error_of_the_calibration_moves_all_passes_alike(tmp_path: Path) -> None:
    plan, seam = replace(PLAN, exact=False, seed=2), tmp_path / "root.json"
    first = ClosedLoop(replace(plan, job=root_job(seam)))
    first.run()
    first.cell.tracker.service.close()
    of_root = off_mm(first)
    upper = ClosedLoop(replace(plan, job=upper_job(seam, 3.0, 3.0)))
    upper.run()
    assert np.hypot(*of_root.T).max() > WITHIN_MM
    assert np.hypot(*(off_mm(upper, 3.0, 3.0) - of_root.mean(axis=0)).T).max() <= WITHIN_MM


@pytest.mark.slow
@pytest.mark.parametrize("moved_mm", [0.0, 1.0])
def test_a_pass_that_sees_the_seam_goes_by_both_or_not_at_all(
    root: tuple[ClosedLoop, Path], moved_mm: float
) -> None:
    _, seam = root
    displaced_mm = PLAN.displaced_mm + moved_mm
    plan = replace(PLAN, displaced_mm=displaced_mm, job=upper_job(seam, 0.0, 2.0, laser=True))
    loop = ClosedLoop(plan)
    loop.run()
    names = [f.track.flag_names for f in loop.frames if f.sample.station_mm > 40.0]
    if moved_mm == 0.0:
        assert np.hypot(*off_mm(loop, 0.0, 2.0).T).max() <= WITHIN_MM
        # What is seen now is surer than what may have moved since.
        assert not any("pass_followed" in flags for flags in names)
    else:
        # The part has moved, or what the sensor takes for the seam is none: nobody knows which.
        assert all("pass_contradicted" in flags for flags in names)
        late = [f.offset.validity for f in loop.frames if f.sample.station_mm > 52.0]
        assert set(late) == {Validity.REFUSED}


@pytest.mark.slow
def test_without_the_seam_of_the_root_nothing_is_sent(tmp_path: Path) -> None:
    loop = ClosedLoop(replace(PLAN, job=upper_job(tmp_path / "none.json", 0.0, 2.0)))
    with pytest.warns(UserWarning, match=r"none\.json: there is no such file"):
        loop.run()
    assert {f.offset.validity for f in loop.frames} == {Validity.REFUSED}
    assert all("pass_unusable" in f.track.flag_names for f in loop.frames[5:])
