"""Record of a recording's completed replay, so that another run need not repeat it."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

import arctrack
from arctrack.check.hint import Hint
from arctrack.check.seam_place import UNKNOWN_PLACE, SeamPlace
from arctrack.check.verdict import RunVerdict
from arctrack.limits import LIMITS
from arctrack.offset_count import OffsetCount
from arctrack.output import real, write_whole
from arctrack.recording import Recording
from arctrack.recording.files import FRAMES_CSV, TRUTH_CSV, read_text
from arctrack.recording.frames import png_path
from arctrack.recording.live_steps import STATE_JSON, STEPS_CSV
from arctrack.recording.poses import CSV_NAME, LOG_NAMES
from arctrack.recording.results import FILES, FINISHED_JSON, RESULTS_CSV, SUMMARY_JSON, Summary
from arctrack.recording.run_offsets import LIVE_FOLDER, LIVE_RESULTS
from arctrack.replay.replay import ReplayOptions
from arctrack.version import __version__

LIVE_TABLE = f"{LIVE_FOLDER}/{LIVE_RESULTS}"

TABLES = (FRAMES_CSV, TRUTH_CSV, CSV_NAME, *LOG_NAMES, STEPS_CSV, STATE_JSON, LIVE_TABLE)
"""The files of a recording that are compared by content."""


class FinishedVerdict(BaseModel):
    """A `RunVerdict`, its hint as what is wrong, the cure and the probability."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    frames: int
    laser_on: int
    valid: int
    flags: dict[str, int]
    hint: tuple[str, str, float] | None
    offsets: OffsetCount
    reasons: dict[str, int]
    seam_mm: tuple[float, float] | None

    @classmethod
    def of(cls, verdict: RunVerdict) -> FinishedVerdict:
        """Return a verdict's record."""
        hint = verdict.hint
        return cls(
            frames=verdict.frames,
            laser_on=verdict.laser_on,
            valid=verdict.valid,
            flags=dict(verdict.flags),
            hint=None if hint is None else (hint.what, hint.cure, hint.probability),
            offsets=verdict.offsets,
            reasons=dict(verdict.reasons),
            seam_mm=None if math.isnan(verdict.seam.y_mm) else (verdict.seam.y_mm, verdict.seam.z_mm),
        )

    def verdict(self) -> RunVerdict:
        """Return the verdict."""
        hint = None if self.hint is None else Hint(*self.hint)
        counts = self.frames, self.laser_on, self.valid, self.flags
        seam = UNKNOWN_PLACE if self.seam_mm is None else SeamPlace(*self.seam_mm)
        return RunVerdict(*counts, hint, self.offsets, self.reasons, seam)


class ReplayRecord(BaseModel):
    """Content of finished.json: the digest of the inputs, the sizes in bytes of the output files.

    The rest is what `ReplayResult` says of the replay.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["arctrack-finished/1"] = "arctrack-finished/1"
    made_of: str
    files: dict[str, int]
    summaries: tuple[Summary, ...]
    verdict: FinishedVerdict
    replay_warnings: tuple[str, ...]
    complaint: str | None

    def write(self, folder: Path) -> None:
        """Write finished.json, whole or not at all; ArctrackError if it cannot be written."""
        write_whole(folder / FINISHED_JSON, json.dumps(self.model_dump(), indent=2) + "\n")


def read_finished(folder: Path, made_of: str) -> ReplayRecord | None:
    """Return the result of a folder's finished replay; None unless it is whole, and was made of the same."""
    try:
        finished = ReplayRecord.model_validate(
            json.loads(read_text(folder / FINISHED_JSON, LIMITS.toml_bytes))
        )
    except (OSError, ValueError):
        return None
    whole = {RESULTS_CSV, SUMMARY_JSON} <= finished.files.keys() and finished.files == sizes(folder)
    return finished if whole and finished.made_of == made_of else None


def sizes(folder: Path) -> Mapping[str, int]:
    """Return the size of each file in a folder that a replay wrote, in bytes."""
    paths = ((name, folder / name) for name in FILES if name != FINISHED_JSON)
    return {name: path.stat().st_size for name, path in paths if path.is_file()}


def made_of(recording: Recording, options: ReplayOptions) -> str:
    """Return the digest of what a replay is made of: recording, setup, options, cell file, arctrack itself.

    Tables and setups count by content, frames by name, size and time of change: a fleet's are too many to
    read twice.
    """
    digest = hashlib.sha256()
    cell = options.cell
    for part in (
        __version__,
        source_digest(),
        recording.name,
        repr(replace(options, cell=None)),
        *_contents(recording, () if cell is None else (cell.path,)),
        *_frames(recording),
    ):
        digest.update(hashlib.sha256(part.encode(errors="surrogateescape")).digest())
    return digest.hexdigest()


def _contents(recording: Recording, others: tuple[Path, ...]) -> Iterator[str]:
    for path in (recording.setup_path, *others, *(recording.path / name for name in TABLES)):
        is_there = path.is_file()
        yield hashlib.sha256(path.read_bytes()).hexdigest() if is_there else "none"


def _frames(recording: Recording) -> Iterator[str]:
    source = recording.frame_source
    paths = [png_path(source, row.index) for row in recording.rows] if source.is_dir() else [source]
    for path in paths:
        status = path.stat() if path.exists() else None
        yield f"{path.name} none" if status is None else f"{path.name} {status.st_size} {status.st_mtime_ns}"


@cache
def source_digest() -> str:
    """Return the digest of arctrack's own sources: a version of its own for each change of them."""
    digest = hashlib.sha256()
    root = real(Path(arctrack.__file__)).parent.parent
    # A replay's numbers depend on these packages.
    for package in ("arctrack", "noise_model", "robot_io", "tracker"):
        for path in sorted((root / package).rglob("*.py")):
            digest.update(
                f"{path.relative_to(root)} {hashlib.sha256(path.read_bytes()).hexdigest()}".encode()
            )
    return digest.hexdigest()
