"""What explains a frame: bit for bit what the replay did, each number by itself, a page for every frame."""

import functools
import html
import math
import re
import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from browser import Page
from made import replace_line
from test_diagnosis_page import read
from typer.testing import CliRunner

import arctrack
from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.nominal import nominal_setup
from arctrack.recording import Recording, read_recording
from arctrack.replay.explain import Explanation, explain
from arctrack.replay.explain_lines import NO_FIT, NO_PATH, ODD_WIDTH, READ, TOO_WEAK, refusals, sigma_parts
from arctrack.replay.explain_pages import words
from arctrack.replay.explain_pages.page import marks, page, path, telling_lines
from arctrack.replay.explain_pages.plots import FLOOR, PARTS, sigma_picture
from arctrack.replay.replay import ReplayOptions, replay_recording
from arctrack.simulation.simulate import SimulationPlan, simulate_recording
from noise_model.arc.map import CELL
from noise_model.setup import Setup
from tracker import flags
from tracker.checks import Check
from tracker.geometry import SensorGeometry
from tracker.state import N_ROWS, Stripe
from tracker.stripe.band import Band
from tracker.stripe.detection import Evidence
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.fit_band import UsualLine
from tracker.stripe.line_fit.first_guess import PixelVariance
from tracker.stripe.line_fit.lines import LineFits, Scans, fit_lines, fit_room
from tracker.stripe.read import StripeReading
from tracker.stripe.scatter import NO_SCATTER

EXAMPLE = Path(arctrack.__file__).parents[1] / "examples" / "v_groove"
RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})

N_SCAN, DEPTH, WIDTH = 24, 121, 6.0


@pytest.fixture(scope="module")
def recording(simulated: Path) -> Recording:
    return read_recording(simulated)


@pytest.fixture(scope="module")
def explained(recording: Recording) -> list[Explanation]:
    return [explain(recording, row.index) for row in recording.rows]


def assert_same(one: object, other: object, without: tuple[str, ...] = ()) -> None:
    """Every number bit for bit."""
    names = one._fields if isinstance(one, Stripe) else [f.name for f in fields(one)]  # type: ignore[arg-type]
    for name in names:
        if name not in without:
            values = [getattr(explained, name) for explained in (one, other)]
            # Pairs among the numbers of a shape.
            flat = [np.hstack(value) if isinstance(value, tuple) else value for value in values]
            np.testing.assert_array_equal(*flat, err_msg=name)


def moved(recording: Recording, from_s: float, offset_mm: tuple[float, float, float]) -> Recording:
    """Return a recording whose poses lie from a time on: what they say of the tool is off."""
    poses = recording.poses
    T_base_tool = poses.T_base_tool.copy()
    T_base_tool[poses.timestamps_s >= from_s, :3, 3] += offset_mm
    return replace(recording, poses=replace(poses, T_base_tool=T_base_tool))


@pytest.mark.slow
@pytest.mark.parametrize("use_arc_map", [True, False])
def test_what_is_explained_is_what_the_replay_did(
    recording: Recording, tmp_path: Path, use_arc_map: bool
) -> None:
    done = replay_recording(recording, tmp_path, ReplayOptions(use_arc_map=use_arc_map, pictures=False))
    seams = 0
    for track in done.tracks:
        found = explain(recording, track.frame, use_arc_map)
        assert_same(found.track, track, ("stripe", "checks"))
        assert repr(found.track.checks) == repr(track.checks)
        if found.track.stripe is None:
            assert found.look is None or found.look.stripe is None
            continue
        assert found.look is not None
        assert found.look.stripe is not None
        assert_same(found.look.stripe.reading.stripe, found.track.stripe)
        seams += found.look.seam is not None
    assert seams >= 3


@pytest.mark.slow
def test_a_closed_joint_is_shown_where_the_step_has_it(tmp_path: Path) -> None:
    """No gap shows in the stripe: what the profile alone shows is another joint, or none."""
    setup = nominal_setup("butt", "zn_coated", width=320, height=240)
    closed = replace(
        setup,
        arc=replace(setup.arc, radiance_e=8e6),
        joint=replace(setup.joint, dimensions={"gap_mm": 0.1, "thickness_mm": 3.0}),
    )
    plan = SimulationPlan(frames=1, production=True, exact=True, tilt_deg=0.0)
    found = explain(read_recording(simulate_recording(tmp_path / "r", closed, plan)), 0)
    assert found.track.flags & flags.SEAM_BY_LINE.mask
    assert found.look is not None
    assert found.look.seam is not None
    assert found.look.joint is found.look.reading.joint
    assert "profile" in [frame for frame, *_ in words.places(found)]
    assert "fitted section" in page(found)


@pytest.mark.slow
def test_the_sigma_is_the_sum_of_its_parts(explained: list[Explanation]) -> None:
    seen = 0
    for found in explained:
        if found.look is None or found.look.stripe is None:
            continue
        stripe, parts = found.look.stripe.reading.stripe, found.look.stripe.parts
        # A line that fits badly, by a streak across it, has a mean below nought in places: less exact there.
        fits_well = ~(found.look.stripe.reading.fits[:, 4] > 10.0)
        off = np.abs(np.sqrt(parts.variance_px2) / stripe.sigma_px - 1.0)
        np.testing.assert_array_less(off[fits_well & np.isfinite(stripe.sigma_px)], 0.01)
        np.testing.assert_array_less(off[~fits_well], 0.05)
        of_lines = np.isfinite(stripe.position_px)
        np.testing.assert_array_equal(found.look.stripe.refusals.why == READ, of_lines)
        seen += int(of_lines.sum())
    assert seen > 500


@pytest.mark.slow
def test_the_page_shows_the_sigma_that_the_frame_was_read_with(explained: list[Explanation]) -> None:
    """Its parts are computed anew, and may add up to nothing where a line fits badly."""
    found = next(found for found in explained if found.look is not None and found.look.stripe is not None)
    assert found.look is not None
    assert found.look.stripe is not None
    parts = found.look.stripe.parts
    odd = replace(found.look.stripe, parts=replace(parts, misfit=parts.misfit - 2.0 * parts.variance_px2))
    sentence = words.arc_sentence(found)
    assert "σ is" in sentence
    assert words.arc_sentence(replace(found, look=replace(found.look, stripe=odd))) == sentence
    assert sigma_picture(found, odd).startswith("data:image/svg")


def made(
    amplitude_e: float,
    background_e: float,
    dark_variance_e2: float,
    width: float = WIDTH,
    start_px: float = 59.0,
) -> tuple[StripeReading, ExpectedStripe]:
    """Return the reading of a noiseless Gaussian over an even background that is known for sure."""
    lines, alone = np.tile([[60.0], [WIDTH], [0.0]], N_SCAN), np.ones(N_SCAN, np.int64)
    expected = ExpectedStripe(*lines, *np.ones((2, N_SCAN), bool), alone, widest_px=WIDTH)
    at = np.arange(DEPTH)
    bell = np.exp(-0.5 * ((at - 60.0) / width) ** 2)
    background = np.full((N_SCAN, DEPTH), background_e, np.float32)
    charge = (background + amplitude_e * bell).astype(np.float32)
    lows, start = np.zeros(-(-N_SCAN // CELL), np.int64), np.full(N_SCAN, start_px)
    nothing = (np.zeros_like(charge) for _ in range(2))
    band = Band(charge, background, *nothing, np.zeros(charge.shape, np.bool_), lows)
    start[0] = np.nan
    lines = LineFits.empty(N_SCAN)
    noise = PixelVariance(1.0, dark_variance_e2, 0.0, 0.0)
    scans = Scans(charge, background, band.censored, start, expected.sigma_px, np.ones(N_SCAN), lows)
    fit_lines(scans, noise, fit_room(N_SCAN), lines)
    fits = lines.fits
    fits[np.abs(np.log(fits[:, 3] / expected.sigma_px)) > NO_SCATTER.width_limit_ln] = np.nan
    stripe = Stripe(fits[:, 0], fits[:, 1], fits[:, 2], lines.saturated, True, fits[:, 1])
    offsets, score = np.arange(-8, 9, 2), np.zeros((N_SCAN, 9), np.float32)
    reading = StripeReading(
        stripe,
        band,
        np.rint(expected.position_px),
        offsets,
        1,
        score,
        start,
        lines.tried,
        fits,
        noise,
        0.0,
        math.inf,
        NO_SCATTER,
        NO_SCATTER,
        UsualLine(0.0, 0.0, math.nan),
        Evidence(0, False, 1.0, math.inf),
        np.ones((N_ROWS, N_SCAN)),
    )
    return reading, expected


def test_without_an_arc_the_variance_is_that_of_counted_electrons() -> None:
    # Each electron of a Gaussian tells its centre to its width: w^2 / N.
    reading, expected = made(50_000.0, 0.0, 1e-3)
    parts = sigma_parts(reading, expected)
    electrons = 50_000.0 * WIDTH * math.sqrt(2.0 * math.pi)
    assert np.isnan(parts.stripe[0])
    np.testing.assert_allclose(parts.stripe[1:], WIDTH**2 / electrons, rtol=0.01)
    np.testing.assert_allclose(parts.variance_px2[1:], parts.stripe[1:], rtol=0.01)
    np.testing.assert_allclose(parts.arc_share[1:], 0.0, atol=1e-3)


def test_under_a_bright_arc_the_variance_is_that_of_the_arc() -> None:
    # White noise of variance B: B over the integral of the derivative's square, A^2 sqrt(pi) / (2 w).
    amplitude, arc, dark = 3_000.0, 200_000.0, 400.0
    reading, expected = made(amplitude, arc, dark)
    parts = sigma_parts(reading, expected)
    per_variance = 2.0 * WIDTH / (amplitude**2 * math.sqrt(math.pi))
    np.testing.assert_allclose(parts.arc[1:], arc * per_variance, rtol=0.03)
    np.testing.assert_allclose(parts.dark[1:], dark * per_variance, rtol=0.03)
    # What is left without it: the stripe's own electrons and the dark, each pixel weighted by both.
    t = (np.arange(DEPTH) - 60.0) / WIDTH
    bell = np.exp(-0.5 * t**2)
    inside = np.abs(t) <= 4.0
    information = np.sum((amplitude * bell * t / WIDTH)[inside] ** 2 / (amplitude * bell + dark)[inside])
    share = 1.0 - 1.0 / information / parts.variance_px2[1:]
    np.testing.assert_allclose(parts.arc_share[1:], share, rtol=0.01)


@pytest.mark.parametrize(
    ("amplitude_e", "width", "why"),
    [(5_000.0, WIDTH, READ), (5_000.0, 1.7 * WIDTH, ODD_WIDTH), (1e-3, WIDTH, TOO_WEAK)],
)
def test_why_a_line_holds_no_stripe(amplitude_e: float, width: float, why: str) -> None:
    reading, expected = made(amplitude_e, 1_000.0, 400.0, width)
    found = refusals(reading, expected)
    assert found.why[0] == NO_PATH
    assert set(found.why[1:]) == {why}
    if why == ODD_WIDTH:
        assert (found.width_ratio[1:] > 1.42).all()


def test_a_line_whose_path_runs_along_the_bands_rim_has_no_fit() -> None:
    found = refusals(*made(5_000.0, 1_000.0, 400.0, start_px=0.0))
    assert set(found.why[1:]) == {NO_FIT}
    assert np.isnan(found.height_e).all()


def assert_predicted(found: Explanation) -> None:
    """The predicted image is what the band was read over; beside the stripe little else is left."""
    assert found.look is not None
    assert found.look.stripe is not None
    assert found.look.arc is not None
    assert found.look.expected is not None
    reading, images = found.look.stripe.reading, (found.look.arc.mean_e, found.look.arc.whitened)
    mean_e, whitened = (image.T if found.geometry.along_rows else image for image in images)
    n_scan, depth = reading.band.background.shape
    lines = np.arange(n_scan)[:, None]
    beside = mean_e[lines, reading.band.lows[lines // CELL] + np.arange(depth)]
    off = np.abs(beside - reading.band.background)
    assert np.nanquantile(off / np.maximum(0.01 * beside, 20.0), 0.98) < 1.5
    clear = np.abs(np.arange(mean_e.shape[1]) - found.look.expected.position_px[:, None]) > 30.0
    assert np.nanmedian(np.abs(whitened[clear])) < 1.5


@pytest.mark.slow
def test_the_predicted_image_is_the_bands_background(explained: list[Explanation]) -> None:
    lit = [found for found in explained if found.track.stripe is not None and found.frame.arc_on]
    assert len(lit) >= 3
    for found in lit:
        assert_predicted(found)


@pytest.mark.slow
def test_an_upright_stripe_is_explained(seen_setup: Setup, tmp_path: Path) -> None:
    camera, roll = seen_setup.camera, np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    upright = replace(
        camera,
        width=camera.height,
        height=camera.width,
        cx=camera.cy,
        cy=camera.cx,
        T_tool_camera=camera.T_tool_camera @ roll,
    )
    plan = SimulationPlan(frames=2, production=True)
    made_there = simulate_recording(tmp_path / "r", replace(seen_setup, camera=upright), plan)
    found = explain(read_recording(made_there), 1)
    assert not found.geometry.along_rows
    assert_predicted(found)
    assert_told(found)
    assert "a: row " in page_of(found)


def failed(found: Explanation, flag: flags.Flag) -> Check:
    (check,) = [check for check in found.track.checks if check.flag is flag and not check.passed]
    return check


@functools.cache
def page_of(found: Explanation) -> str:
    """Return a frame's page: several tests read the same."""
    return page(found)


def assert_told(found: Explanation) -> str:
    """Each flag is told by a check; the page has no hole. Return the page's text."""
    told = {check.flag.name for check in found.track.checks if not check.passed}
    assert told == set(found.track.flag_names)
    html = page_of(found)
    reader = read(html)
    assert all(reference.startswith("data:image/") for reference in reader.references)
    assert "<script" not in html
    assert "nan" not in re.findall(r"[a-z]+", reader.text)
    for flag in words.raised(found.track.flags):
        assert flag.meaning in reader.text
    return reader.text


@pytest.mark.slow
def test_a_frame_of_every_kind_has_a_page(explained: list[Explanation]) -> None:
    kinds = {(one.frame.laser_on, one.frame.arc_on, one.track.flags): one for one in explained}
    assert len(kinds) >= 4
    for found in kinds.values():
        text = assert_told(found)
        assert ("Candidates" in text) == (found.track.stripe is not None)
        assert words.headline(found) in text
    assert any(found.track.valid for found in explained)
    assert any(not found.frame.laser_on for found in explained)


@pytest.mark.slow
def test_a_page_can_be_read_at_every_width(
    explained: list[Explanation], browser: Page, tmp_path: Path
) -> None:
    valid = next(found for found in explained if found.track.valid)
    for found in (valid, explained[0]):
        (tmp_path / "page.html").write_text(page_of(found))
        browser.open(tmp_path / "page.html")
        browser.assert_readable()


@pytest.mark.slow
def test_what_failed_comes_first(explained: list[Explanation]) -> None:
    found = next(one for one in explained if {"refused", "noted", "passed"} <= outcomes(one))
    shown = re.findall(r'<td class="(refused|noted|passed)">', page_of(found))
    assert len(shown) == len(found.track.checks)
    assert shown == sorted(shown, key=["refused", "noted", "passed"].index)
    raised = [flag.invalidates for flag in words.raised(found.track.flags)]
    assert raised == sorted(raised, reverse=True)


def outcomes(found: Explanation) -> set[str]:
    return {check.outcome for check in found.track.checks}


@pytest.mark.slow
def test_the_parts_of_the_variance_are_all_of_it(explained: list[Explanation]) -> None:
    found = next(one for one in explained if one.track.valid and one.frame.arc_on)
    (table,) = re.findall(r"<caption>Share of the variance.*?</table>", html.unescape(page_of(found)), re.S)
    shares = dict(re.findall(r'<tr><td>(.*?)</td><td class="n">(-?\d+) %</td>', table))
    assert list(shares)[-1] == FLOOR[0]
    assert len(shares) == len(PARTS) + 1
    assert int(shares[FLOOR[0]]) > 0
    assert sum(map(int, shares.values())) == 100
    off = re.search(r"to within ([\d.]+) % in every scan line", page_of(found))
    assert off is not None
    assert 0.0 < float(off[1]) < 1.0


def test_an_axis_that_is_not_followed_has_no_offset(explained: list[Explanation]) -> None:
    found = next(one for one in explained if math.isfinite(one.track.offset_y_mm))
    nothing = {"offset_y_mm": math.nan, "offset_sigma_y_mm": math.nan}
    one, other = (
        words.offset_sentence(replace(found, track=replace(found.track, **axis)))
        for axis in (nothing, {name.replace("y", "z"): value for name, value in nothing.items()})
    )
    assert "lies z" in one
    assert "lies y" in other
    assert "nan" not in one + other
    neither = replace(found.track, offset_y_mm=math.nan, offset_z_mm=math.nan)
    assert "no offset" in words.offset_sentence(replace(found, track=neither))


def test_a_frame_without_a_pose(recording: Recording) -> None:
    poses = recording.poses
    early = poses.timestamps_s < recording.rows[5].timestamp_s - 0.2
    cut = replace(poses, timestamps_s=poses.timestamps_s[early], T_base_tool=poses.T_base_tool[early])
    found = explain(replace(recording, poses=cut), recording.rows[-1].index)
    assert found.look is None
    assert "no pose is near enough in time" in assert_told(found)
    assert failed(found, flags.POSE_REFUSED).outcome == "refused"


def test_a_frame_from_which_the_joint_is_not_seen(recording: Recording) -> None:
    row = recording.rows[6]
    for offset_mm, flag in (
        ((0.0, 0.0, 500.0), flags.SEAM_OUT_OF_VIEW),
        ((0.0, 0.0, -500.0), flags.BELOW_SURFACE),
    ):
        found = explain(moved(recording, row.timestamp_s - 0.06, offset_mm), row.index)
        assert_told(found)
        assert failed(found, flag).outcome == "refused"


def test_a_frame_whose_line_runs_backwards(recording: Recording) -> None:
    joint = recording.setup.joint
    backwards = replace(joint, seam_in_base_mm=joint.seam_in_base_mm[::-1])
    found = explain(replace(recording, setup=replace(recording.setup, joint=backwards)), 6)
    assert not found.track.valid
    assert_told(found)
    assert failed(found, flags.SEAM_REVERSED).outcome == "refused"


@pytest.mark.slow
def test_a_jump_is_told_with_its_limit(recording: Recording) -> None:
    lit = [row for row in recording.rows if row.laser_on]
    row = lit[-1]
    found = explain(moved(recording, row.timestamp_s - 0.06, (0.0, 0.7, 0.0)), row.index)
    check = failed(found, flags.SEAM_JUMP)
    text = assert_told(found)
    assert found.look is not None
    seam = found.look.seam
    assert seam is not None
    off = seam.displacement_mm - seam.expected_mm
    assert np.max(np.abs(off) - seam.limit_mm) > 0.0
    assert (check.value, check.limit) == (abs(off[0]), seam.limit_mm[0])
    assert f"{abs(off[0]):.2f} mm" in text
    assert "shows a seam that is not used" in text


@pytest.mark.slow
def test_a_frame_that_was_read_without_the_arc_map_is_explained_as_it_was_read(tmp_path: Path) -> None:
    setup = nominal_setup("fillet", "zn_coated", width=320, height=240)
    setup = replace(setup, arc=replace(setup.arc, radiance_e=8.0e6))
    of_one = read_recording(
        simulate_recording(tmp_path / "f", setup, SimulationPlan(frames=1, production=True))
    )
    center_mm = tuple(np.add(setup.arc.center_in_tool_mm, (0.0, 15.0, 0.0)))
    stated = replace(of_one.setup, arc=replace(of_one.setup.arc, center_in_tool_mm=center_mm))
    found = explain(replace(of_one, setup=stated), of_one.rows[0].index)
    assert found.track.valid
    assert "read over an even background" in assert_told(found)
    assert not failed(found, flags.ARC_LEVEL_UNKNOWN).flag.invalidates
    assert found.look is not None
    assert found.look.stripe is not None
    assert found.track.stripe is not None
    np.testing.assert_array_equal(
        found.look.stripe.reading.stripe.position_px, found.track.stripe.position_px
    )


@pytest.mark.slow
def test_a_lost_stripe_is_told_by_its_share(simulated: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(simulated, tmp_path / "r"))
    lines = (path / "frames.csv").read_text().splitlines()
    header, dark = lines[0].split(","), next(n for n, line in enumerate(lines) if ",0,0," in line)
    row = dict(zip(header, lines[dark].split(","), strict=True)) | {"laser_on": "1"}
    replace_line(path / "frames.csv", dark + 1, ",".join(row[name] for name in header))
    found = explain(read_recording(path), int(row["frame"]))
    check = failed(found, flags.STRIPE_LOST)
    text = assert_told(found)
    assert found.look is not None
    assert found.look.stripe is not None
    read_lines = int((found.look.stripe.refusals.why == READ).sum())
    assert check.value == read_lines / 160
    assert (words.limit_text(check), check.outcome) == ("at least 20 %", "refused")
    assert sum(count for _, _, count in words.refused_lines(found)) == 160 - read_lines
    assert "nothing further was asked" in text


def test_a_misfit_that_was_asked_is_told_as_it_was_judged(explained: list[Explanation]) -> None:
    """What was not asked of a frame is no row that passed."""
    judged = 0
    for found in explained:
        checks = {check.question.id: check for check in found.track.checks}
        assert ("map_misfit" in checks) == (checks["arc_level"].passed if "arc_level" in checks else False)
        if "map_misfit" in checks:
            misfit = checks["map_misfit"]
            assert misfit.value == found.track.map_misfit
            assert misfit.passed == ("map_misfit" not in found.track.flag_names)
            judged += 1
    assert 0 < judged < len(explained)


@pytest.mark.slow
def test_the_seam_is_told_in_each_frame_by_name(explained: list[Explanation]) -> None:
    found = next(e for e in explained if e.track.valid and math.isfinite(e.track.offset_y_mm))
    rows = words.places(found)
    assert [row[0] for row in rows] == ["tool frame", "profile", "path, at the stripe", "path, at the torch"]
    text = read(page(found)).text
    for row in rows:
        assert all(cell in text for cell in row)


def test_the_telling_lines_are_best_median_worst_and_one_without(explained: list[Explanation]) -> None:
    for found in explained:
        if found.look is None or found.look.stripe is None:
            continue
        stripe = found.look.stripe
        sigma = stripe.reading.stripe.sigma_px
        chosen = {name: s for name, s in telling_lines(stripe)}
        assert sigma[chosen["best σ"]] == np.nanmin(sigma)
        assert sigma[chosen["worst σ"]] == np.nanmax(sigma)
        without = [s for name, s in chosen.items() if name.startswith("no stripe")]
        assert len(without) == int((stripe.refusals.why != READ).any())
        assert all(math.isnan(sigma[s]) for s in without)


def test_an_overlay_is_broken_where_nothing_is_known(explained: list[Explanation]) -> None:
    geometry: SensorGeometry = explained[0].geometry
    position = np.full(geometry.n_scan, np.nan)
    position[2:4], position[6], position[8] = 10.0, 12.25, -3.0
    assert path(geometry, position) == "M2.5 10.5L3.5 10.5M6.5 12.8"
    upright = replace(geometry, along_rows=False)
    assert path(upright, position) == "M10.5 2.5L10.5 3.5M12.8 6.5"


@pytest.mark.slow
def test_marks_stand_apart(explained: list[Explanation]) -> None:
    found = next(e for e in explained if e.track.valid)
    camera = found.geometry.setup.camera
    for scans in ([80, 81, 82, 83], [0, 1, 158, 159]):
        at = np.array(marks(found, scans))
        apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))[np.triu_indices(4, 1)]
        assert (apart > 0.05 * camera.height).all()
        assert ((at > 0.0) & (at < [camera.width, camera.height])).all()


@pytest.mark.slow
def test_the_same_frame_makes_the_same_page(recording: Recording, explained: list[Explanation]) -> None:
    found = [found for found in explained if found.track.valid][-1]
    assert page_of(found) == page(explain(recording, found.frame.index))


@pytest.mark.slow
def test_the_example_is_explained_by_the_command(tmp_path: Path) -> None:
    out = tmp_path / "frame.html"
    result = RUNNER.invoke(app, ["explain", str(EXAMPLE), "2", "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "Frame 2: the seam is at y " in result.output
    assert "arc_off: the arc is off, or none of its light was found in the frame (the arc is on: no)" in (
        result.output
    )
    html = out.read_text(encoding="utf-8")
    assert len(html) < 1.5e6
    reader = read(html)
    for text in (
        "v_groove",
        "What was asked of the frame",
        "the arc is on",
        "Telling scan lines",
    ):
        assert text in reader.text


def test_the_page_lies_beside_the_recording(simulated: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(simulated, tmp_path / "r"))
    setup = shutil.copy(path / "recording.toml", tmp_path / "other.toml")
    result = RUNNER.invoke(app, ["explain", str(path), "3", "--no-arc-map", "--setup", str(setup)])
    assert result.exit_code == 0, result.output
    html = (path / "results" / "explain_000003.html").read_text(encoding="utf-8")
    assert "read without the arc map" in read(html).text
    assert f"arctrack replay {path} --setup {setup} --no-arc-map" in html


def test_a_frame_that_is_not_there(simulated: Path, tmp_path: Path) -> None:
    result = RUNNER.invoke(app, ["explain", str(simulated), "14"])
    assert isinstance(result.exception, ArctrackError)
    there = "its frames run from 0 to 13, and 13 is the nearest"
    assert str(result.exception) == f"{simulated}: has no frame 14; {there}"
    path = Path(shutil.copytree(simulated, tmp_path / "r"))
    (path / "frames" / "000004.png").write_bytes(b"no picture")
    recording = read_recording(path)
    with pytest.raises(ArctrackError, match=r"000004\.png: .*choose another frame"):
        explain(recording, 4)
    # The frames after it are replayed as a replay does: over it.
    assert explain(recording, 6).before.frames == 5
