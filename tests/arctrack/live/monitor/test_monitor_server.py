"""The monitor page's server, in a process of its own beside a run: who may look, and what is answered."""

from __future__ import annotations

import asyncio
import json
import re
import socket
import struct
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import aiohttp
import cv2
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from shown_run import TITLE, TOKEN, answering_black_box, shown_run

from arctrack.live.monitor.access import Access, is_same_origin
from arctrack.live.monitor.feed import MAX_WAITING, MessageKind, Outbox
from arctrack.live.monitor.server import SAVES_APART_S
from arctrack.live.monitor.words import FAULTS, LASERS, NO_DISARM, REASONS, STATES, Indication, headline
from robot_io import Fault, GateReason, LaserState, TrackerState

BEARER = {"Authorization": f"Bearer {TOKEN}"}
PATIENCE_S = 60.0
ROOT = Path(__file__).parents[4]


@pytest.fixture(scope="module")
def shown() -> Iterator[SimpleNamespace]:
    """Yield a run with its page."""
    with shown_run("server", answering_black_box()) as (run, name, address):
        yield SimpleNamespace(run=run, name=name, address=address)


def asked(address: str, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes, dict[str, str]]:
    """Return status, body and headers of an answer."""
    request = urllib.request.Request(address + path, method=method, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return answer.status, answer.read(), dict(answer.headers)
    except urllib.error.HTTPError as error:
        return error.code, error.read(), dict(error.headers)


def awaited(address: str, path: str, is_so) -> tuple[int, bytes, dict[str, str]]:
    """Ask until an answer is so."""
    until_s = time.monotonic() + PATIENCE_S
    while True:
        answer = asked(address, path, **BEARER)
        if is_so(answer):
            return answer
        assert time.monotonic() < until_s, answer
        time.sleep(0.05)


@pytest.mark.slow
def test_only_who_brings_the_token_looks(shown: SimpleNamespace) -> None:
    for path in ("", "status.json", "metrics", "health", "frame.jpg", "ws", "static/page.js", "?token=wrong"):
        assert asked(shown.address, path)[0] == 401, path
    assert asked(shown.address, "", Authorization="Bearer wrong")[0] == 401
    status, page, headers = asked(shown.address, f"?token={TOKEN.replace(' ', '+')}")
    assert (status, b"arctrack monitor" in page) == (200, True)
    assert headers["Content-Security-Policy"].startswith("default-src 'self';")
    cookie, *attributes = headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Strict"} <= {*attributes}
    assert TOKEN not in cookie
    assert asked(shown.address, "static/page.js", Cookie=cookie)[0] == 200
    assert asked(shown.address, "", Cookie=cookie[:-1])[0] == 401


@pytest.mark.slow
def test_pages_of_others_are_refused(shown: SimpleNamespace) -> None:
    own = shown.address.removesuffix("/")
    for path, method, headers in (
        ("status.json", "GET", {"Host": "evil.example"}),
        ("ws", "GET", {"Origin": "http://evil.example"}),
        ("black_box", "POST", {"Origin": "http://evil.example"}),
        ("black_box", "POST", {"Origin": "null"}),
        ("black_box", "POST", {}),
    ):
        assert asked(shown.address, path, method, **BEARER, **headers)[0] == 403, (path, headers)
    status, body, _ = asked(shown.address, "black_box", "POST", **BEARER, Origin=own)
    assert (status, json.loads(body)) == (200, {"saved": "black_boxes/monitor page"})


@pytest.mark.slow
def test_health_metrics_and_the_frame_are_those_of_the_run(shown: SimpleNamespace) -> None:
    _, body, _ = awaited(shown.address, "health", lambda answer: answer[0] == 200)
    assert json.loads(body) == {"healthy": True, "reason": None}
    shown.run.changes = {"state": TrackerState.FAULT, "fault": Fault.GAP}
    _, body, _ = awaited(shown.address, "health", lambda answer: answer[0] == 503)
    assert json.loads(body)["reason"].startswith("FAULT, GAP: The part's gap")
    shown.run.changes = {"state": TrackerState.TRACKING, "fault": Fault.NONE}

    shown.run.report_gap(shown.name, "window film")
    _, body, _ = awaited(shown.address, "metrics", lambda answer: b"arctrack_gap 1.0" in answer[1])
    values = {
        (sample.name, *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(body.decode())
        for sample in family.samples
    }
    page = (ROOT / "docs" / "reference" / "monitor.md").read_text(encoding="utf-8")
    assert {name for name, *_ in values} == {*re.findall(r"`(arctrack_\w+)`", page)}
    assert values["arctrack_up",] == 1.0
    assert values["arctrack_frames_dropped_total",] == 3.0
    assert values["arctrack_offsets_total", "VALID"] > 11.0
    assert values["arctrack_indication", "TRACKING"] + values["arctrack_indication", "FAULT"] == 1.0
    assert 0.0 <= values["arctrack_usable_offset_age_seconds",] < 1.0
    assert values["arctrack_gate_reasons_total", "NOT_ARMED"] == 2.0
    assert values["arctrack_bus_faults_total", "repeated"] == 1.0
    assert values["arctrack_latency_seconds", "0.99", "mid_exposure"] == pytest.approx(0.0315)
    assert values["arctrack_sending_delay_seconds_bucket", "0.05", "mid_exposure"] == 11.0
    assert values["arctrack_sending_delay_seconds_bucket", "0.02", "mid_exposure"] == 0.0
    assert values["arctrack_sending_delay_seconds_sum", "mid_exposure"] == 0.3
    assert values["arctrack_arc_height_millimeters",] == 2.61
    assert 0.0 < values["arctrack_frame_age_seconds",] < 1.0
    assert values["arctrack_arc_level_ratio",] == pytest.approx(1.0, abs=0.2)

    _, body, _ = awaited(shown.address, "status.json", lambda answer: b'"TRACKING"' in answer[1])
    status = json.loads(body)
    assert status["indication"] == "TRACKING"
    assert (status["job"], status["gap"]["text"]) == ({"number": 7, "name": "side wall"}, "window film")
    jpeg = asked(shown.address, "frame.jpg", **BEARER)[1]
    assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (480, 640)


def deaf(address: str) -> socket.socket:
    """Return the socket of a browser that opens a WebSocket and never reads."""
    host = urlsplit(address).netloc
    browser = socket.socket()
    browser.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    browser.connect((urlsplit(address).hostname, urlsplit(address).port))
    browser.sendall(
        f"GET /ws HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Authorization: Bearer {TOKEN}\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
        "Sec-WebSocket-Version: 13\r\n\r\n".encode()
    )
    return browser


async def heard(address: str, enough) -> list:
    """Return the messages of a browser that listens, until they are enough."""
    messages: list = []
    async with (
        asyncio.timeout(PATIENCE_S),
        aiohttp.ClientSession(headers=BEARER) as session,
        session.ws_connect(f"{address}ws", origin=address.removesuffix("/")) as socket_,
    ):
        async for message in socket_:
            if isinstance(message.data, str):
                messages.append(json.loads(message.data))
            else:
                kind, length = struct.unpack_from("<BxxxI", message.data)
                content = json.loads(message.data[8 : 8 + length])
                messages.append(content | {"is_picture": kind == 1, "rest": message.data[8 + length :]})
            if enough(messages):
                return messages
    raise AssertionError(messages)


@pytest.mark.slow
def test_a_browser_hears_the_run_beside_one_that_never_reads(shown: SimpleNamespace) -> None:
    def are_all_told(messages: list) -> bool:
        kinds = [message["kind"] for message in messages]
        return len({*kinds}) == 5 and kinds.count("points") > 4

    with deaf(shown.address):
        messages = asyncio.run(heard(shown.address, are_all_told))
        times = [
            point[0] for message in messages if message["kind"] == "points" for point in message["points"]
        ]
        assert times == sorted({*times})
        assert messages[0]["kind"] == "hello"
        assert (messages[0]["title"], messages[0]["has_black_box"]) == (TITLE, True)
        pictures = [message for message in messages if message["kind"] == "picture"]
        positions = [message["position"] for message in pictures]
        assert positions == sorted({*positions})
        assert cv2.imdecode(np.frombuffer(pictures[-1]["rest"], np.uint8), 0).shape == (480, 640)
        heat = next(message for message in messages if message["kind"] == "heat")
        assert cv2.imdecode(np.frombuffer(heat["rest"], np.uint8), cv2.IMREAD_UNCHANGED).shape[2] == 4


@pytest.mark.slow
def test_clients_that_misbehave_hold_nothing_and_fill_no_log(capfd: pytest.CaptureFixture[str]) -> None:
    with shown_run("rough", answering_black_box()) as (_, _, address):
        place = (urlsplit(address).hostname, urlsplit(address).port)
        for nonsense in (
            b"\x16\x03\x01\x02\r\n\r\n",
            b"GET / HTTP/1.1\r\nHost: a\r\nContent-Length: x\r\n\r\n",
        ):
            with socket.create_connection(place, PATIENCE_S) as client:
                client.sendall(nonsense)
                assert client.recv(4096).startswith(b"HTTP/1.0 400 ")
        with (
            socket.create_connection(place, PATIENCE_S) as silent,
            socket.create_connection(place, PATIENCE_S) as slow,
        ):
            slow.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
            for client in (silent, slow):
                with suppress(ConnectionResetError):
                    assert client.recv(1) == b""

        headers = BEARER | {"Origin": address.removesuffix("/")}
        assert asked(address, "black_box", "POST", **headers)[0] == 200
        status, body, told = asked(address, "black_box", "POST", **headers)
        assert status == 429
        assert 0 < int(told["Retry-After"]) <= SAVES_APART_S
        assert "ask again in" in json.loads(body)["error"]
        assert asked(address, "status.json", **BEARER)[0] == 200
    assert capfd.readouterr().err == ""


def test_what_waits_for_a_browser_is_little_and_the_newest() -> None:
    outbox = Outbox()
    for n in range(3 * MAX_WAITING):
        outbox.put(MessageKind.POINTS, f"points {n}")
        outbox.put(MessageKind.PICTURE, f"picture {n}".encode())
    assert len(outbox) == MAX_WAITING
    assert outbox.dropped == 5 * MAX_WAITING
    waiting = [asyncio.run(outbox.take()) for _ in range(MAX_WAITING)]
    assert [message for message in waiting if isinstance(message, bytes)] == [b"picture 95"]
    assert waiting[-2] == "points 95"


def test_hosts_that_lead_here_are_known_and_no_others() -> None:
    access = Access("127.0.0.1", None)
    known = ("127.0.0.1:8765", "192.168.1.7:8765", "[::1]:8765", "localhost:9000", socket.gethostname())
    assert all(access.knows_host(host) for host in known)
    assert not any(access.knows_host(host) for host in ("", "evil.example:8765", "localhost.evil.example"))
    assert is_same_origin("http://cell:8765", "cell:8765")
    for origin in ("http://cell", "http://cell:8766", "null", "file://cell:8765", "http://evil@cell:8765"):
        assert not is_same_origin(origin, "cell:8765")


def test_each_state_fault_and_reason_has_words() -> None:
    assert [{*words} for words in (STATES, FAULTS, REASONS, LASERS)] == [
        {*enumeration} for enumeration in (TrackerState, Fault, GateReason, LaserState)
    ]
    assert headline(TrackerState.FAULT, Fault.GAP, GateReason.NONE) == FAULTS[Fault.GAP]
    assert (
        headline(TrackerState.TRACKING, Fault.NONE, GateReason.SOFT_START) == REASONS[GateReason.SOFT_START]
    )
    assert headline(TrackerState.TRACKING, Fault.NONE, GateReason.NONE) == STATES[TrackerState.TRACKING]
    nothing = (Fault.NONE, GateReason.NOT_ARMED, Indication.NO_OFFSETS)
    assert headline(TrackerState.DISARMED, *nothing) == NO_DISARM
