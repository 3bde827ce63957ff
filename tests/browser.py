"""A real browser for the tests: Chromium without a window, told what to do over a pair of pipes.

Chromium's own protocol for tools: JSON, each message ended by a zero byte, on its file descriptors 3 and 4.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""The browser's program, None where there is none."""

ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--remote-debugging-pipe",
]

RENUMBER = """
import fcntl, os, sys
pipes = [fcntl.fcntl(int(number), fcntl.F_DUPFD, 10) for number in sys.argv[1:3]]
os.dup2(pipes[0], 3)
os.dup2(pipes[1], 4)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""Gives the pipes the numbers that the browser expects them under, and becomes the browser."""

PATIENCE_S = 60.0

WIDTHS_PX = (1366, 390)
"""A notebook's window, and a telephone's."""

MISPLACED = """(() => {
  const found = [], seen = [];
  if (document.documentElement.scrollWidth > innerWidth) found.push("the page is wider than its window");
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node; (node = walk.nextNode());) {
    if (!node.data.trim() || !node.parentElement.checkVisibility()) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    const drawing = node.parentElement.closest("svg")?.getBoundingClientRect();
    for (const box of range.getClientRects()) {
      if (box.width < 1 || box.height < 1) continue;
      if (drawing && (box.left < drawing.left - 2 || box.right > drawing.right + 2))
        found.push(`cut off: ${node.data}`);
      for (const [other, text] of seen) {
        const across = Math.min(box.right, other.right) - Math.max(box.left, other.left);
        const down = Math.min(box.bottom, other.bottom) - Math.max(box.top, other.top);
        if (across > 2 && down > 0.3 * box.height) found.push(`${text.trim()} | ${node.data.trim()}`);
      }
      seen.push([box, node.data]);
    }
  }
  return found;
})()"""
"""What is wrong with the place of a page's texts: too wide a page, texts cut off or over one another."""


class Page:
    """A page in the browser; `complaints` are its errors and all that it wrote to the console."""

    def __init__(self, profile: Path, width: int = 1280, height: int = 900) -> None:
        assert CHROMIUM is not None
        to_browser, self._to = os.pipe()
        self._from, from_browser = os.pipe()
        command = [sys.executable, "-c", RENUMBER, str(to_browser), str(from_browser), CHROMIUM, *ARGUMENTS]
        self._process = subprocess.Popen(
            [*command, f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"],
            pass_fds=(to_browser, from_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        self._buffer = b""
        self._count = 0
        self._session: str | None = None
        self._events: list[str] = []
        self.complaints: list[str] = []
        try:
            self._attach(width, height)
        except BaseException:
            self._process.kill()
            self._process.wait()
            raise

    def _attach(self, width: int, height: int) -> None:
        """Take hold of the browser's empty page."""
        targets = self.ask("Target.getTargets")["targetInfos"]
        target = next(each["targetId"] for each in targets if each["type"] == "page")
        self._session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.ask(f"{domain}.enable")
        self.resize(width, height)

    def resize(self, width: int, height: int) -> None:
        """Give the page a width and height, px."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.ask("Emulation.setDeviceMetricsOverride", **size)

    def open(self, path: Path, fragment: str = "") -> None:
        """Open a file and wait until it has loaded."""
        # From an empty page, for a new fragment alone loads nothing.
        for url in ("about:blank", path.resolve().as_uri() + fragment):
            self._events.clear()
            self.ask("Page.navigate", url=url)
            while "Page.loadEventFired" not in self._events:
                self._read()

    def value(self, expression: str) -> Any:
        """Return what a JavaScript expression is on the page."""
        answer = self.ask("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def assert_readable(self) -> None:
        """Hold that no text lies over another, and none beyond the window, at each of the usual widths."""
        for width in WIDTHS_PX:
            self.resize(width, 900)
            misplaced = self.value(MISPLACED)
            assert misplaced == [], (width, misplaced)

    def text(self, selector: str) -> str:
        """Return the text that an element shows."""
        return str(self.value(f"document.querySelector({json.dumps(selector)}).innerText"))

    def click(self, selector: str) -> None:
        """Click the middle of an element with the mouse."""
        box = self.value(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)}); "
            "e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect(); "
            "return [b.left + b.width / 2, b.top + b.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.ask("Input.dispatchMouseEvent", type=kind, x=box[0], y=box[1], button="left", clickCount=1)

    def press(self, key: str) -> None:
        """Press a key, by its name in JavaScript."""
        text = {"Enter": "\r", " ": " "}.get(key)
        for kind in ("keyDown", "keyUp"):
            self.ask("Input.dispatchKeyEvent", type=kind, key=key, **({"text": text} if text else {}))

    def screenshot(self, path: Path, whole: bool = False) -> None:
        """Write what the page looks like as a PNG; `whole`, what one would scroll to as well."""
        shot = self.ask("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(shot["data"]))

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == self._count:
                assert "error" not in answer, (method, answer["error"])
                result: dict[str, Any] = answer["result"]
                return result

    def _read(self) -> dict[str, Any]:
        """Return the next message, an answer or an event."""
        until = time.monotonic() + PATIENCE_S
        while b"\0" not in self._buffer:
            assert select.select([self._from], [], [], max(0.0, until - time.monotonic()))[0], "no answer"
            got = os.read(self._from, 1 << 20)
            assert got, "the browser has gone"
            self._buffer += got
        line, self._buffer = self._buffer.split(b"\0", 1)
        message: dict[str, Any] = json.loads(line)
        method = message.get("method", "")
        self._events.append(method)
        if method in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
            self.complaints.append(json.dumps(message["params"]))
        return message

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(BrokenPipeError, AssertionError):
            self._session = None
            self.ask("Browser.close")
        self._process.wait(PATIENCE_S)
        os.close(self._to)
        os.close(self._from)
