"""The monitor page in a real browser: what it shows, and that it never shows old numbers as live."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from browser import CHROMIUM, Page
from shown_run import TITLE, TOKEN, answering_black_box, shown_run

from arctrack.live.monitor.words import NOTHING_SENT, REASONS
from robot_io import Fault, GateReason, SeamOffset, Source, TrackerState, Validity

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
]

AMBER, GREEN = "rgb(255, 181, 46)", "rgb(53, 212, 143)"
SIZES = ((1920, 1080), (1280, 800), (1024, 768))
PATIENCE_S = 60.0
COLOURS = """(id => {
  const canvas = document.getElementById(id), copy = new OffscreenCanvas(canvas.width, canvas.height);
  const c = copy.getContext('2d', {willReadFrequently: true});
  c.drawImage(canvas, 0, 0);
  return new Set(new Uint32Array(c.getImageData(0, 0, canvas.width, canvas.height).data.buffer)).size;
})"""


def wait_for(page: Page, expression: str) -> None:
    """Wait until a JavaScript expression is true."""
    until_s = time.monotonic() + PATIENCE_S
    while not page.value(expression):
        assert time.monotonic() < until_s, (expression, page.text("body"), page.complaints)
        time.sleep(0.05)


def test_the_page_shows_the_run_and_greys_when_that_ends(tmp_path: Path) -> None:
    with (
        shown_run("page", answering_black_box()) as (run, name, address),
        Page(tmp_path / "chromium", *SIZES[-1]) as page,
    ):
        page.ask("Page.navigate", url=f"{address}?token={TOKEN.replace(' ', '%20')}")
        wait_for(page, "document.readyState === 'complete' && document.body.dataset.state === 'TRACKING'")
        assert (page.text("#word"), page.text("#reason")) == ("TRACKING", "Offsets follow the seam.")
        assert page.value("location.search") == ""
        assert page.text("#title") == TITLE
        assert page.text("#latency") == "31.5"
        assert page.text("#job") == "7 · side wall"
        wait_for(page, "/^[+−]?\\d\\.\\d\\d$/.test(document.getElementById('offset-y').innerText)")
        for canvas in ("image", "profile", "chart-y", "chart-z", "chart-latency"):
            wait_for(page, f"{COLOURS}('{canvas}') > 4")
        _check_keyboard(page)
        for size in SIZES:
            page.resize(*size)
            assert (
                page.value("[document.documentElement.scrollWidth, innerWidth].join()")
                == f"{size[0]},{size[0]}"
            )
            assert page.value("document.documentElement.scrollHeight <= innerHeight")

        refused = SeamOffset(0.0, 0.0, 0.0, 0.0, Validity.REFUSED)
        for reason, words in (
            (GateReason.CORRECTION_OFF, REASONS[GateReason.CORRECTION_OFF]),
            (GateReason.NONE, NOTHING_SENT),
        ):
            offsets = {"VALID": 11, "REFUSED": run.count}
            run.changes = {"offset": refused, "offsets": offsets, "reason": reason}
            wait_for(page, "document.body.dataset.state === 'NO_OFFSETS'")
            assert page.text("#word") == "NO OFFSETS"
            wait_for(page, f"document.getElementById('reason').innerText === {json.dumps(words)}")
            assert page.value("getComputedStyle(document.getElementById('state')).backgroundColor") == AMBER
            assert page.value("document.title") == f"NO OFFSETS · arctrack: {TITLE}"
        run.changes = {}
        wait_for(page, "document.body.dataset.state === 'TRACKING'")
        assert page.value("getComputedStyle(document.getElementById('state')).backgroundColor") == GREEN

        run.report_gap(name, "It looks like a film on the window.")
        wait_for(page, "!document.getElementById('gap').hidden")
        assert "It looks like a film on the window." in page.text("#gap")
        run.changes = {"state": TrackerState.FAULT, "fault": Fault.GAP, "source": Source.REPLAY}
        wait_for(page, "document.body.dataset.state === 'FAULT'")
        assert page.text("#source") == "REPLAY"
        assert page.text("#reason").startswith("The part's gap is out of its range.")
        run.changes = {"state": TrackerState.SEARCHING, "reason": GateReason.SEARCH_ONLY}

        page.value("document.querySelector('footer .save').focus()")
        page.press("Enter")
        wait_for(page, "document.getElementById('saved').innerText === 'Saved: black_boxes/monitor page'")

        run.close()
        wait_for(page, "document.body.dataset.state === 'NO_SIGNAL'")
        assert page.value("document.body.classList.contains('stale')")
        assert page.text("#lost").startswith("The tracker has ended. What is shown is ")
        assert page.complaints == []


def _check_keyboard(page: Page) -> None:
    """Switch layers by keys alone."""
    pressed = "document.querySelector('[data-layer={}]').getAttribute('aria-pressed')"
    assert page.value(pressed.format("heat")) == "true"
    page.press("4")
    assert page.value(pressed.format("heat")) == "false"
    page.value("document.querySelector('[data-layer=stripe]').focus()")
    page.press("Enter")
    assert page.value(pressed.format("stripe")) == "false"
    assert page.value(f"({COLOURS})('image') > 4")
