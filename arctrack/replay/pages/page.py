"""replay.html: a whole replay on one self-contained page, with a slider over its frames."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from arctrack.output import write_whole
from arctrack.printable import printable, quoted
from arctrack.recording import Recording, Truth
from arctrack.recording.results import count_flags
from arctrack.recording.run_offsets import OffsetOutcome, RunComparison
from arctrack.recording.score import score
from arctrack.recording.setup_writer import FILE_NAME
from arctrack.replay.explain_pages import words
from arctrack.replay.pages.drawing_spool import ReplayedFrame
from arctrack.replay.pages.numbers import numbers, on_bus
from arctrack.replay.pages.view import truth_by_frame
from arctrack.report.template import environment
from noise_model.compiled.arrays import Float64
from tracker import flags
from tracker.checks import Check
from tracker.state import Frame, Track

MAX_SHOWN = 240
"""Largest number of frames with picture, profile and all checks on the page."""


def opening_frame(frame_flags: Sequence[int]) -> int:
    """Return the position of the first frame whose seam is valid with the arc on.

    Where there is none, that of the first valid one, else of the first with the laser on, else 0.
    """
    for without in (flags.INVALIDATING | flags.ARC_OFF.mask, flags.INVALIDATING, flags.LASER_OFF.mask):
        for position, mask in enumerate(frame_flags):
            if not mask & without:
                return position
    return 0


def frames_to_show(frame_flags: Sequence[int], most: int = MAX_SHOWN) -> list[int]:
    """Return the positions of the frames to keep pictures of: all, or `most` of a longer recording.

    Half of those are evenly spaced. The others are the one that the page opens at and those where the flags
    are not those of the frame before, evenly chosen among them if they are too many.
    """
    count = len(frame_flags)
    if count <= most:
        return list(range(count))
    even = np.linspace(0, count - 1, most // 2).round().astype(np.int64)
    even = np.union1d(even, opening_frame(frame_flags))
    changed = 1 + np.flatnonzero(np.diff(np.asarray(frame_flags, dtype=np.int64)))
    changed = np.setdiff1d(changed, even)
    room = most - len(even)
    if len(changed) > room:
        changed = changed[np.linspace(0, len(changed) - 1, room).round().astype(np.int64)]
    return sorted({*even.tolist(), *changed.tolist()})


class ReplayPage:
    """Content of the page, collected frame by frame."""

    def __init__(self, recording: Recording, truth: Truth | None, use_arc_map: bool) -> None:
        self._recording, self._truth, self._use_arc_map = recording, truth, use_arc_map
        self._truth_mm = truth_by_frame(truth)
        self._tracks: list[Track] = []
        self._columns: dict[str, list[Any]] = {}
        self._texts: dict[str, int] = {}
        self._checks: list[list[list[int]]] = []
        self._shown: dict[int, dict[str, Any]] = {}
        self._comparison = RunComparison()

    def add(self, frame: Frame | None, seen: ReplayedFrame, shown: dict[str, Any] | None) -> None:
        """Take the next frame, None if it could not be read, and its `view_json`, None if it is not shown."""
        track = seen.track
        if shown is not None:
            self._shown[len(self._tracks)] = shown
        # Of a frame that is not shown the checks that passed would be much for little.
        checks = [check for check in words.by_severity(track.checks) if shown is not None or not check.passed]
        self._checks.append([[self._text(text) for text in _check_texts(check)] for check in checks])
        true_mm = self._truth_mm.get(track.frame)
        for name, value in _columns(frame, seen, true_mm).items():
            self._columns.setdefault(name, []).append(value)
        if seen.run is not None:
            self._comparison.add(seen.run, seen.outcome)
        self._tracks.append(replace(track, stripe=None, checks=()))

    def save(self, path: Path, counts: str) -> None:
        """Write the page, headed by the run's counts in words; ArctrackError if it cannot be written."""
        write_whole(path, self._html(counts))

    def _html(self, counts: str) -> str:
        tracks, setup = self._tracks, self._recording.setup
        camera, shows_light = setup.camera, setup.profiler is None
        scored = None if self._truth is None else score(tracks, self._truth, setup.tolerance.seam_mm)
        content = {
            "name": self._recording.name,
            "camera": {
                "width": camera.width,
                "height": camera.height,
                "shows_light": shows_light,
            },
            "flags": [
                {
                    "mask": flag.mask,
                    "name": flag.name,
                    "meaning": flag.meaning,
                    "invalidates": flag.invalidates,
                }
                for flag in flags.FLAGS
            ],
            "columns": self._columns,
            "texts": list(self._texts),
            "checks": self._checks,
            "shown": self._shown,
            "explain": self._explain_command(),
            "opens": opening_frame(self._columns["flags"]),
        }
        return (
            environment()
            .get_template("replay.html.j2")
            .render(
                recording=self._recording,
                material=printable(setup.material.name),
                joint=setup.joint.type.replace("_", " "),
                use_arc_map=self._use_arc_map,
                count=len(tracks),
                counts=counts,
                span_s=tracks[-1].timestamp_s - tracks[0].timestamp_s,
                flag_counts=count_flags(tracks),
                score=scored,
                comparison=self._comparison if self._comparison.frames else None,
                shows_light=shows_light,
                width=camera.width,
                height=camera.height,
                has_truth=bool(self._truth_mm),
                shown=len(self._shown),
                # A "<" in a name would end the script element.
                content=json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
            )
        )

    def _text(self, text: str) -> int:
        """Return the number under which the page keeps a text: most are said of many frames."""
        return self._texts.setdefault(text, len(self._texts))

    def _explain_command(self) -> str:
        """Return the command that writes a frame's own page, but for the frame's number at its end."""
        recording = self._recording
        command = "arctrack explain"
        if recording.setup_path != recording.path / FILE_NAME:
            command += f" --setup {quoted(recording.setup_path)}"
        if not self._use_arc_map:
            command += " --no-arc-map"
        return f"{command} {quoted(recording.path)}"


def _check_texts(check: Check) -> tuple[str, str, str, str]:
    """Return a check's question, answer, demand, and its meaning."""
    return (check.question.words, words.value_text(check), words.limit_text(check), words.outcome_text(check))


def _run_text(run: OffsetOutcome) -> str:
    """Return what the live run sent: y and z, mm, and what its gate did."""
    axes = ((run.offset_y_mm, "y"), (run.offset_z_mm, "z"))
    known = [f"{axis} {value:+.3f} mm" for value, axis in axes if math.isfinite(value)]
    return ", ".join([*known, run.gate, *([run.pose_doubt] if run.pose_doubt else [])])


def _columns(frame: Frame | None, seen: ReplayedFrame, true_mm: Float64 | None) -> dict[str, Any]:
    """Return a frame's cell of each of the page's columns; what is not known is None."""
    values = numbers(frame, seen, true_mm)
    return {
        "frame": seen.track.frame,
        "flags": seen.track.flags,
        "valid": int(seen.track.valid),
        "bus": on_bus(seen),
        "gate": seen.outcome.gate,
        "run": None if seen.run is None else _run_text(seen.run),
        "laser": None if frame is None else int(frame.laser_on),
        "arc": None if frame is None else int(frame.arc_on),
        **{name: round(value, 5) if math.isfinite(value) else None for name, value in values.items()},
    }
