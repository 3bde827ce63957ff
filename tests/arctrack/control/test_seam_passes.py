"""A job's seam from pass to pass: kept, laid along the next pass, refused where it is not that pass's."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from arctrack.control.cell_file.choices import AgainChoice, CellJob
from arctrack.control.frame_tracking import Capture, FrameTracking, PassFrame, seam_measurement
from arctrack.control.job import PartLimits
from arctrack.control.seam_passes import SeamPasses
from arctrack.errors import ArctrackError
from arctrack.nominal import nominal_setup
from arctrack.recording.seam_file import read_seam
from arctrack.recording.weld_schedule import read_schedule
from noise_model.setup import Setup
from noise_model.surface.joint import seam_height_mm
from noise_model.transforms import moved
from robot_io import GateLimits, PoseAt, PoseStatus
from tracker import flags
from tracker.geometry import SensorGeometry
from tracker.seam.correction import UNSTATED
from tracker.state import AT_ONCE, JointShape, Pose, Track

V_GROOVE = nominal_setup("v_groove", "mild_steel", width=320, height=240)
LINE = ((10.0, 5.0, 2.0), (210.0, 5.0, 2.0))
SETUP = replace(V_GROOVE, joint=replace(V_GROOVE.joint, seam_in_base_mm=LINE))
GEOMETRY = SensorGeometry.of(SETUP)
SIGMA_MM, NOON = (0.03, 0.04), datetime(2026, 1, 2, 12, tzinfo=UTC)
SEEN_MM = np.arange(0.1, 61.0, 0.4)


def job_of(again: AgainChoice | None = None, **changes: object) -> CellJob:
    correction = UNSTATED if again is None else again.displaced(UNSTATED)
    return replace(CellJob("pass", None, correction, False, PartLimits(), None), again=again, **changes)


def see(passes: SeamPasses, y_mm: float = 1.0, z_mm: float = -0.5, flag: int = 0) -> None:
    """Drive along the nominal seam with a seam that lies off it; its gap grows by 0.01 mm a millimetre."""
    for n, station_mm in enumerate(SEEN_MM):
        T_base_tool = moved(np.eye(4), (12.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        T_base_tool[:3, 3] = 10.0 + station_mm - 35.0, 5.0, 2.0
        seam_base = np.array([10.0 + station_mm, 5.0 + y_mm, 2.0 + z_mm + seam_height_mm(SETUP.joint)])
        x, y, z = T_base_tool[:3, :3].T @ (seam_base - T_base_tool[:3, 3])
        track = Track(
            n,
            0.04 * n,
            flag,
            (x, y, z),
            *np.hypot(SIGMA_MM, 0.2).tolist(),
            gap_mm=1.0 + 0.01 * station_mm,
            shape=JointShape(gap_sigma_mm=0.05),
        )
        seam = seam_measurement(SETUP, track, Pose(T_base_tool), (0.04, 0.04))
        passes.add(PassFrame(track, seam, T_base_tool, (0.04, 0.04)))


def kept_in(path: Path, **seen: float) -> Path:
    passes = SeamPasses(job_of(keep_seam=path), GEOMETRY, True, lambda: NOON)
    assert passes.begin() is None
    see(passes, **seen)
    passes.finish()
    return path


@pytest.fixture
def seam(tmp_path: Path) -> Path:
    return kept_in(tmp_path / "seam.json")


def following(
    seam: Path, setup: Setup = SETUP, later_s: float = 60.0, is_live: bool = True, **keys: object
) -> SeamPasses:
    job = job_of(again=AgainChoice(seam, **keys))
    geometry = SensorGeometry.of(job.setup_for(setup))
    return SeamPasses(job, geometry, is_live, lambda: NOON + timedelta(seconds=later_s))


def test_what_is_kept_is_the_path_moved_onto_the_seam(seam: Path) -> None:
    kept = read_seam(seam)
    assert 60 <= len(kept.points_base_mm) <= 62
    np.testing.assert_allclose(kept.points_base_mm[:, 1], 6.0)
    np.testing.assert_allclose(kept.points_base_mm[:, 2], 1.5)
    assert kept.kept_at == NOON
    assert kept.calibration_sigma_mm == pytest.approx((0.2, 0.2))
    # Two or three frames a millimetre, and what does not average out.
    per_mm = np.hypot(np.array(SIGMA_MM) / np.sqrt(2.5), 0.01)
    np.testing.assert_allclose(kept.sigmas_mm.mean(axis=0), per_mm, rtol=0.1)
    np.testing.assert_allclose(kept.gaps_mm, 1.0 + 0.01 * (kept.points_base_mm[:, 0] - 10.0), atol=1e-6)
    assert np.isnan(kept.areas_mm2).all()


def test_a_later_pass_follows_it_where_it_lies(seam: Path) -> None:
    earlier = following(seam, tilt_deg=10.0, sigma_mm=0.07, laser=False).begin()
    assert earlier is not None
    np.testing.assert_allclose(earlier.history.displacements_mm[:, 0], 1.0)
    np.testing.assert_allclose(earlier.history.displacements_mm[:, 1], -0.5)
    np.testing.assert_allclose(earlier.tilts_deg, 22.0)
    assert (earlier.moved_sigma_mm, earlier.uses_laser) == (0.07, False)
    assert earlier.history.stations_mm[0] == pytest.approx(10.5)


def test_a_pass_that_goes_back_has_it_on_its_other_side(seam: Path) -> None:
    passes = following(seam, reverse=True, laser=False)
    earlier = passes.begin()
    assert earlier is not None
    stations_mm = earlier.history.stations_mm
    assert (np.diff(stations_mm) > 0.0).all()
    # The torch leans to the same plate: that is the travel's other side.
    np.testing.assert_allclose(earlier.history.displacements_mm[:, 0], -1.0)
    np.testing.assert_allclose(earlier.history.displacements_mm[:, 1], -0.5)
    np.testing.assert_allclose(earlier.tilts_deg, -12.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"later_s": 3601.0}, "kept_at: is 3601 s ago"),
        ({"later_s": -1.0}, "kept_at"),
        ({"setup": replace(SETUP, camera=replace(SETUP.camera, fx=SETUP.camera.fx + 1.0))}, "calibration"),
        (
            {
                "setup": replace(
                    SETUP,
                    joint=replace(SETUP.joint, seam_in_base_mm=((10.0, 25.0, 2.0), (210.0, 25.0, 2.0))),
                )
            },
            "off the job's nominal seam",
        ),
    ],
)
def test_a_seam_that_is_not_this_pass_s_is_refused_by_its_key(
    seam: Path, change: dict[str, object], words: str
) -> None:
    passes = following(seam, **change)
    earlier = passes.begin()
    assert earlier is not None
    assert earlier.history.n == 0
    with pytest.warns(UserWarning, match=re.escape(words)):
        see(passes)
    assert passes.problem is not None
    assert str(seam) in passes.problem
    assert words in passes.problem


def test_a_replay_follows_a_seam_of_any_age(seam: Path) -> None:
    earlier = following(seam, later_s=1e7, is_live=False).begin()
    assert earlier is not None
    assert earlier.history.n > 0


def test_frames_without_a_seam_keep_none(tmp_path: Path) -> None:
    passes = SeamPasses(job_of(keep_seam=tmp_path / "seam.json"), GEOMETRY, False)
    see(passes, flag=flags.SEAM_JUMP.mask)
    passes.finish()
    assert not (tmp_path / "seam.json").exists()


def test_the_seam_of_the_part_before_goes_as_the_next_is_measured(seam: Path) -> None:
    passes = SeamPasses(job_of(keep_seam=seam), GEOMETRY, False)
    passes.begin()
    assert seam.exists()
    see(passes)
    assert not seam.exists()


def test_a_seam_that_cannot_be_written_ends_no_run(tmp_path: Path) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    passes = SeamPasses(job_of(keep_seam=folder / "seam.json"), GEOMETRY)
    folder.rmdir()
    see(passes)
    with pytest.warns(UserWarning, match=r"seam\.json: cannot be written"):
        passes.finish()


def test_a_seam_takes_no_other_file_s_place(tmp_path: Path) -> None:
    setup = tmp_path / "recording.toml"
    setup.write_text("[camera]\n")
    with pytest.raises(ArctrackError, match=r"recording\.toml.*name another file"):
        SeamPasses(job_of(keep_seam=setup), GEOMETRY)
    with pytest.raises(ArctrackError, match="folder is missing"):
        SeamPasses(job_of(keep_seam=tmp_path / "none" / "seam.json"), GEOMETRY)


def test_a_live_run_follows_no_seam_that_a_replay_has_kept(tmp_path: Path) -> None:
    path = tmp_path / "seam.json"
    replay = SeamPasses(job_of(keep_seam=path), GEOMETRY)
    see(replay)
    replay.finish()
    assert read_seam(path).kept_at is None
    assert following(path, is_live=False).begin().history.n > 0
    live = following(path)
    assert live.begin().history.n == 0
    assert "a replay has kept it" in live.problem


def test_a_seam_grows_too_old_before_its_pass_begins_not_in_it(seam: Path) -> None:
    now = [NOON]
    job = job_of(again=AgainChoice(seam))
    tracking = FrameTracking(
        SETUP, job.correction, make_passes=lambda geometry: SeamPasses(job, geometry, True, lambda: now[0])
    )
    assert tracking.tracker.state.earlier.history.n > 0
    now[0] += timedelta(hours=2)
    still = np.zeros(3)
    pose = PoseAt(0.0, PoseStatus.INTERPOLATED, None, np.eye(4), still, still, 0.01)
    for is_armed, n in ((True, 61), (False, 0)):
        tracking.track(None, Capture(0, 0.0, pose, None, True, AT_ONCE, is_armed))
        assert tracking.tracker.state.earlier.history.n == pytest.approx(n, abs=1)


def test_points_of_unknown_sigma_are_not_kept(tmp_path: Path) -> None:
    path = tmp_path / "seam.json"
    passes = SeamPasses(job_of(keep_seam=path), GEOMETRY)
    see(passes)
    T_base_tool = np.eye(4)
    T_base_tool[:3, 3] = 60.0, 5.0, 2.0
    track = Track(0, 0.0, 0, (35.0, 0.0, 0.0), math.nan, 0.1)
    seam = seam_measurement(SETUP, track, Pose(T_base_tool), (0.04, 0.04))
    passes.add(PassFrame(track, seam, T_base_tool, (0.04, 0.04)))
    passes.finish()
    assert np.isfinite(read_seam(path).sigmas_mm).all()


SCHEDULE = "gap_mm,speed_mm_s,wire_m_min\n1.0,4.0,1.0\n1.5,3.0,2.0\n"


def test_the_weld_goes_by_the_gap_where_the_torch_stands(tmp_path: Path, seam: Path) -> None:
    table = tmp_path / "schedule.csv"
    table.write_text(SCHEDULE)
    job = job_of(again=AgainChoice(seam), schedule=table)
    passes = SeamPasses(job, GEOMETRY, False)
    passes.begin()
    T_base_tool = np.eye(4)
    T_base_tool[:3, 3] = 35.0, 5.0, 2.0
    weld = passes.weld_at(T_base_tool, AT_ONCE)
    assert weld is not None
    assert weld.speed_mm_s == pytest.approx(3.5, abs=0.02)
    assert weld.wire_m_min == pytest.approx(1.5, abs=0.02)
    assert math.isnan(weld.weave_mm)
    T_base_tool[0, 3] = 66.0
    assert passes.weld_at(T_base_tool, AT_ONCE)[3] == "gap_mm_above"
    T_base_tool[0, 3] = 166.0
    assert passes.weld_at(T_base_tool, AT_ONCE)[3] == "gap_mm_unknown"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gap_mm,speed_mm_s\n1,4\n", "two rows"),
        ("gap_mm,speed_mm_s\n1,4\n1,3\n", "line 3: gap_mm = 1: must rise"),
        ("gap_mm,speed_mm_s\n1,4\n2,-3\n", "line 3: speed_mm_s = -3"),
        ("gap_mm,area_mm2,speed_mm_s\n1,1,4\n2,2,3\n", "one of the columns"),
        ("gap_mm,wire\n1,4\n2,3\n", "wire is not known"),
        ("gap_mm\n1\n2\n", "one at least"),
        ("gap_mm,speed_mm_s\n1,nan\n2,3\n", "line 2: speed_mm_s"),
    ],
)
def test_a_schedule_that_is_wrong_is_refused_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    table = tmp_path / "schedule.csv"
    table.write_text(text)
    with pytest.raises(ArctrackError, match=words):
        read_schedule(table)


@pytest.mark.parametrize(
    ("job", "words"),
    [
        (job_of(bridge_mm=5.0, again=AgainChoice(Path("s"), laser=False)), "bridge_mm"),
        (job_of(keep_seam=Path("k"), again=AgainChoice(Path("s"), laser=False)), "keep_seam"),
        (
            job_of(part=PartLimits(gap_mm=(0.0, 1.0)), again=AgainChoice(Path("s"), laser=False)),
            r"\[part\]",
        ),
        (
            job_of(AgainChoice(Path("s"), side_mm=20.0)),
            "range_y_mm",
        ),
        (job_of(AgainChoice(Path("s")), keep_seam=Path("s")), "keep_seam"),
    ],
)
def test_a_job_that_cannot_follow_again_is_refused_by_its_key(job: CellJob, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        job.to_job(SETUP, GateLimits())


def test_a_lap_is_seen_from_one_end_alone() -> None:
    lap = nominal_setup("lap", "mild_steel", width=320, height=240)
    job = job_of(again=AgainChoice(Path("s"), reverse=True))
    with pytest.raises(ValueError, match=r"\[again\] reverse"):
        job.to_job(lap, GateLimits())
    blind = replace(job, again=AgainChoice(Path("s"), reverse=True, laser=False))
    assert not blind.to_job(lap, GateLimits()).uses_laser
    assert blind.setup_for(lap).joint.seam_in_base_mm == lap.joint.seam_in_base_mm[::-1]
