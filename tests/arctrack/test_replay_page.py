"""replay.html: what it holds, and how it behaves in a real browser."""

import json
import math
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import WIDTHS_PX, Page
from hypothesis import given
from hypothesis import strategies as st
from made import UNREADABLE, noise_frames, results_of, small_setup, write

from arctrack.recording import BadFrame, read_recording, read_truth
from arctrack.recording.results import REPLAY_PAGE
from arctrack.replay.explain_pages import words
from arctrack.replay.pages import pictures
from arctrack.replay.pages.drawing_spool import ReplayedFrame
from arctrack.replay.pages.page import frames_to_show, opening_frame
from arctrack.replay.pages.view import Viewer
from arctrack.replay.replay import Replay, replay_recording
from noise_model.transforms import transform
from robot_io import SeamOffset, Validity
from tracker import flags
from tracker.profile import lines_of, triangulate
from tracker.stripe.expected import expect_stripe
from tracker.tracker import Tracker


@pytest.fixture(scope="module")
def recording_path(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording whose name and one frame are trouble."""
    path = tmp_path_factory.mktemp("page") / "a<b> & 'c'</script>"
    shutil.copytree(simulated, path)
    frame = path / "frames" / f"{UNREADABLE:06d}.png"
    frame.write_bytes(frame.read_bytes()[:500])
    return path


@pytest.fixture(scope="module")
def replayed(recording_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Replay:
    return replay_recording(read_recording(recording_path), tmp_path_factory.mktemp("results"))


@pytest.fixture(scope="module")
def results(replayed: Replay) -> Path:
    return replayed.folder


@pytest.fixture
def page(browser: Page, results: Path) -> Iterator[Page]:
    """Yield the page at its first frame; it must not complain."""
    browser.complaints.clear()
    browser.resize(1280, 900)
    browser.open(results / REPLAY_PAGE, "#frame=0")
    yield browser
    assert browser.complaints == []


def frame_shown(page: Page) -> str:
    return str(page.value("document.querySelector('#number').value"))


def content_of(path: Path) -> dict[str, object]:
    text = path.read_text()
    start = text.index('id="replay">') + len('id="replay">')
    content: dict[str, object] = json.loads(text[start : text.index("</script>", start)])
    return content


def shown_number(text: str) -> float:
    """Return the first number of a text, NaN for a dash."""
    number = re.match(r"[+−]?\d+(\.\d+)?", text)
    return float(number[0].replace("−", "-")) if number else math.nan


def assert_shows(text: str, value: str, digits: int) -> None:
    """Hold a number that the page shows against its cell of results.csv."""
    if value == "":
        assert text.startswith(("–", "none")), text
    else:
        assert shown_number(text) == pytest.approx(float(value), abs=0.51 * 10.0**-digits)


@pytest.mark.slow
def test_it_needs_nothing_else(results: Path) -> None:
    text = (results / REPLAY_PAGE).read_text()
    assert (results / REPLAY_PAGE).stat().st_size < 2e6
    without_data = re.sub(r"data:image/[a-z+]+;base64,[A-Za-z0-9+/=]*", "", text)
    assert set(re.findall(r"\w+://[\w.]+", without_data)) <= {"http://www.w3.org"}
    assert not re.search(r"<(link|iframe|script[^>]*src|img[^>]*src=\"(?!data))", without_data)


def test_it_holds_the_numbers_of_the_results(results: Path) -> None:
    columns = content_of(results / REPLAY_PAGE)["columns"]
    assert isinstance(columns, dict)
    rows = results_of(results)
    for name in ("seam_y_mm", "sigma_z_mm", "offset_y_mm", "gap_mm", "confidence", "arc_level", "map_misfit"):
        for value, row in zip(columns[name], rows, strict=True):
            assert (value is None) == (row[name] == "")
            if value is not None:
                assert value == pytest.approx(float(row[name]), abs=1e-4)
    names = [flags.names(mask) for mask in columns["flags"]]
    assert ["|".join(each) for each in names] == [row["flags"] for row in rows]
    assert columns["laser"][UNREADABLE] is None


@given(
    st.lists(st.integers(0, 3), min_size=1, max_size=300),
    st.integers(4, 40),
)
def test_frames_to_show(frame_flags: list[int], most: int) -> None:
    shown = frames_to_show(frame_flags, most)
    assert shown == sorted(set(shown))
    assert len(shown) <= most
    if len(frame_flags) <= most:
        assert shown == list(range(len(frame_flags)))
    else:
        assert {0, len(frame_flags) - 1} <= set(shown)
        changed = [n for n in range(1, len(frame_flags)) if frame_flags[n] != frame_flags[n - 1]]
        if len(changed) <= most - most // 2:
            assert set(changed) <= set(shown)


def test_the_view_is_the_trackers_own(simulated: Path) -> None:
    """The points in the tool frame are the profile's, and the section runs through the seam point."""
    recording = read_recording(simulated)
    tracker = Tracker(recording.setup, correction=recording.correction)
    viewer = Viewer(tracker.geometry, read_truth(simulated))
    poses = recording.pose_buffer()
    nothing = SeamOffset(math.nan, math.nan, 0.0, 0.0, Validity.REFUSED)
    seen_valid = 0
    for frame in recording.frames():
        assert not isinstance(frame, BadFrame)
        pose = recording.pose_at(poses, frame.timestamp_s)
        track = tracker.step(frame, pose)
        view = viewer.view(frame, ReplayedFrame(pose, track, tracker.reading, nothing, math.nan))
        assert view.grey is not None
        assert view.grey.shape == frame.image_dn.shape
        if not track.valid:
            continue
        seen_valid += 1
        reading, stripe = tracker.reading, track.stripe
        assert reading is not None
        assert stripe is not None
        assert view.profile is not None
        expected = expect_stripe(tracker.geometry, reading.scene)
        assert expected is not None
        lines = lines_of(stripe, expected.bias_px)
        points = triangulate(tracker.geometry.stripe_source, reading.scene, lines).points
        points_joint = transform(reading.scene.T_joint_tool, view.profile.points_mm)
        np.testing.assert_allclose(points_joint[:, 1:], points[:2].T, atol=1e-6)
        y, z = view.profile.section_mm[:, 1:].T
        assert np.interp(track.seam_tool_mm[1], y, z) == pytest.approx(track.seam_tool_mm[2], abs=0.02)
        plane = tracker.geometry.setup.laser.plane
        assert np.abs(view.profile.section_mm @ plane[:3] + plane[3]).max() < 1e-6
        # The true seam and the seam found lie on each other in the image, to within a pixel or two.
        assert view.seam_px is not None
        assert view.truth_px is not None
        assert np.abs(view.seam_px - view.truth_px).max() < 3.0
        # Off the stripe the predicted light is the frame's.
        assert view.arc_grey is not None
        if frame.arc_on:
            rows = np.arange(frame.image_dn.shape[0])[:, None]
            off = np.abs(rows - np.nanmean(view.stripe_px[:, 1])) > 30
            apart = view.grey.astype(float) - view.arc_grey
            assert np.abs(np.median(apart[np.broadcast_to(off, apart.shape)])) < 6.0
    assert seen_valid > 5


def test_the_slider_shows_the_numbers_of_the_results(page: Page, results: Path) -> None:
    rows = results_of(results)
    assert page.value("document.querySelector('#slider').max") == str(len(rows) - 1)
    for n, row in enumerate(rows):
        page.value(
            f"(() => {{ const s = document.querySelector('#slider'); s.value = {n}; "
            "s.dispatchEvent(new Event('input', {bubbles: true})); })()"
        )
        assert page.value("document.querySelector('#number').value") == row["frame"]
        assert page.text("#state") == ("valid" if row["valid"] == "1" else "no seam to use")
        assert_shows(page.text("#time"), row["timestamp_s"], 3)
        assert_shows(page.text("#value_seam_y"), row["seam_y_mm"], 3)
        assert_shows(page.text("#value_seam_z"), row["seam_z_mm"], 3)
        assert_shows(page.text("#value_offset_y"), row["offset_y_mm"], 3)
        assert_shows(page.text("#value_confidence"), row["confidence"], 3)
        assert_shows(page.text("#value_arc_level"), row["arc_level"], 3)
        listed = page.value("[...document.querySelectorAll('#flags b')].map(e => e.textContent).join('|')")
        assert listed == row["flags"]
        if row["sigma_y_mm"]:
            sigma = page.text("#value_seam_y").split("±")[1]
            assert_shows(sigma.strip(), row["sigma_y_mm"], 3)
        assert page.value("document.querySelector('#frame_missing').hidden") == (n != UNREADABLE)
        drawn = page.value("document.querySelectorAll('#overlay path').length")
        assert (drawn > 0) == (n != UNREADABLE)
    cursors = page.value(
        "[...document.querySelectorAll('#charts svg > line')].map(e => e.getAttribute('x1'))"
    )
    assert len(cursors) > 6


def test_a_click_on_a_frame_opens_its_explanation(page: Page, replayed: Replay, recording_path: Path) -> None:
    results = replayed.folder
    assert page.value("document.querySelector('#explanation').hidden")
    for n in (UNREADABLE, 8):
        page.open(results / REPLAY_PAGE, f"#frame={n}")
        page.click("#picture")
        assert not page.value("document.querySelector('#explanation').hidden")
        said = page.text("#explanation")
        assert f"Why frame {n} came out so" in said
        track = replayed.tracks[n]
        assert track.flags
        assert all(flag.meaning in said for flag in flags.FLAGS if track.flags & flag.mask)
        for check in track.checks:
            answer = f"{check.question.words}: {words.value_text(check)}; demanded: {words.limit_text(check)}"
            assert (answer in said) == (not check.passed)
        table = page.value(
            "[...document.querySelectorAll('#explanation_checks tbody tr')].map(e => e.cells[3].textContent)"
        )
        assert table == [words.outcome_text(check) for check in words.by_severity(track.checks)]
        assert page.value("document.querySelector('#all_checks').hidden") == (n == UNREADABLE)
        asked = shlex.split(page.text("#command"))
        assert asked == ["arctrack", "explain", str(recording_path), str(n)]
        page.press("Escape")
        assert page.value("document.querySelector('#explanation').hidden")
    page.open(results / REPLAY_PAGE, "#frame=3&explain")
    assert "Why frame 3 came out so" in page.text("#explanation")


def test_it_goes_by_keys(page: Page) -> None:
    for key, frame in (
        ("ArrowRight", "1"),
        ("PageDown", "11"),
        ("ArrowLeft", "10"),
        ("End", "13"),
        ("Home", "0"),
    ):
        page.press(key)
        assert frame_shown(page) == frame
    page.press("Enter")
    assert not page.value("document.querySelector('#explanation').hidden")
    page.press("End")
    assert "Why frame 13" in page.text("#explanation")
    page.press("Home")
    page.press(" ")
    assert page.text("#play") == "stop"
    while frame_shown(page) != "13":
        page.value("new Promise(done => setTimeout(done, 50))")
    assert page.text("#play") == "play"
    assert page.value("location.hash") == "#frame=13&explain"


@pytest.mark.slow
@pytest.mark.parametrize("fragment", ["", f"#frame={UNREADABLE}&explain", "#frame=99"])
def test_it_can_be_read_at_every_width(page: Page, results: Path, fragment: str) -> None:
    page.open(results / REPLAY_PAGE, fragment)
    page.value("document.querySelectorAll('details').forEach(each => { each.open = true; })")
    page.assert_readable()
    for width in WIDTHS_PX:
        page.resize(width, 900)
        chart = page.value("document.querySelector('#chart_seam_y').getBoundingClientRect().width")
        assert 0.4 * width < chart <= width


def test_it_opens_at_the_first_valid_frame_with_the_arc_on(page: Page, results: Path, tmp_path: Path) -> None:
    rows = results_of(results)
    frame = next(row["frame"] for row in rows if row["valid"] == "1" and "arc_off" not in row["flags"])
    assert frame != "0"
    page.open(results / REPLAY_PAGE)
    assert frame_shown(page) == frame
    assert page.value("document.querySelector('#slider').value") == frame
    assert page.text("#state") == "valid"


@pytest.mark.parametrize(
    ("frame_flags", "position"),
    [
        ([flags.LASER_OFF.mask, flags.ARC_OFF.mask, flags.SEARCHED.mask, 0], 2),
        ([flags.LASER_OFF.mask, flags.STRIPE_LOST.mask, flags.ARC_OFF.mask], 2),
        ([flags.LASER_OFF.mask, flags.STRIPE_LOST.mask], 1),
        ([flags.LASER_OFF.mask], 0),
    ],
)
def test_opening_frame(frame_flags: list[int], position: int) -> None:
    assert opening_frame(frame_flags) == position
    long = [flags.LASER_OFF.mask, flags.ARC_OFF.mask] * 50 + frame_flags
    assert opening_frame(long) in frames_to_show(long, 4)


def test_a_frame_that_is_not_there_is_said(page: Page, results: Path) -> None:
    for asked, shown in (("99", "13"), ("-7", "0"), ("4.4", "4"), ("1e999", "0"), ("abc", "0"), ("", "0")):
        page.value("show(0)")
        for _ in range(3):
            page.press("ArrowRight")
        page.value(
            f"(() => {{ const n = byId('number'); n.value = {asked!r}; "
            "n.dispatchEvent(new Event('change', {bubbles: true})); })()"
        )
        is_number = asked not in ("abc", "", "1e999")
        assert frame_shown(page) == (shown if is_number else "3")
        assert (f"there is no frame {asked}; the nearest is" in page.text("#message")) == is_number
        assert page.text("#message") != ""
    page.press("ArrowRight")
    assert frame_shown(page) == "4"
    assert page.value("byId('message').textContent") == ""
    for fragment in ("#frame=99", "#frame=99&explain"):
        page.open(results / REPLAY_PAGE, fragment)
        assert frame_shown(page) == "13"
        assert page.text("#message") == "there is no frame 99; the nearest is frame 13"
    page.open(results / REPLAY_PAGE, "#frame=abc")
    assert page.text("#state") == "valid"
    assert "no frame's number" in page.text("#message")


def test_the_arrows_move_from_within_the_frames_number(page: Page) -> None:
    page.value("byId('number').focus()")
    for key, frame in (("ArrowUp", "1"), ("ArrowUp", "2"), ("ArrowDown", "1")):
        page.press(key)
        assert frame_shown(page) == frame


@pytest.mark.slow
def test_a_click_into_a_chart_moves_there(page: Page) -> None:
    page.click("#chart_seam_y")
    assert page.value("document.querySelector('#number').value") in ("6", "7")


@pytest.mark.slow
def test_a_long_replay_says_what_it_leaves_out(
    browser: Page, simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "frames_to_show", lambda masks: frames_to_show(masks, 4))
    replay_recording(read_recording(simulated), tmp_path)
    shown = content_of(tmp_path / REPLAY_PAGE)["shown"]
    assert isinstance(shown, dict)
    assert len(shown) == 4
    browser.complaints.clear()
    browser.open(tmp_path / REPLAY_PAGE)
    assert "Of 14 frames, 4 keep picture and profile here" in browser.text("header")
    out = next(n for n in range(14) if str(n) not in shown)
    browser.value(f"show({out})")
    assert "left out" in browser.text("#frame_missing")
    assert str(max(n for n in map(int, shown) if n < out)) in browser.text("#frame_missing")
    row = results_of(tmp_path)[out]
    assert_shows(browser.text("#value_arc_level"), row["arc_level"], 3)
    browser.click("#picture")
    assert f"Why frame {out}" in browser.text("#explanation")
    assert browser.value("document.querySelector('#all_checks').hidden")
    assert browser.complaints == []


@pytest.mark.slow
def test_a_replay_that_sees_nothing_has_its_page(browser: Page, tmp_path: Path) -> None:
    setup = small_setup(bits=12)
    done = replay_recording(read_recording(write(tmp_path / "r", setup, noise_frames(setup, 1))))
    browser.complaints.clear()
    browser.open(done.folder / REPLAY_PAGE)
    assert browser.text("h1").endswith(": 0 of 1 offsets sent; 0 of 0 frames with the laser on are valid")
    assert browser.complaints == []
