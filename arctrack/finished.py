"""Record of a finished run: the digest of what it was made of, and the sizes of what it wrote."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict

from arctrack.limits import LIMITS
from arctrack.output import real, write_whole
from arctrack.recording import Recording
from arctrack.recording.files import FRAMES_CSV, TRUTH_CSV, read_text
from arctrack.recording.frames import png_path
from arctrack.recording.live_steps import STATE_JSON, STEPS_CSV
from arctrack.recording.poses import CSV_NAME, LOG_NAMES
from arctrack.recording.results import FINISHED_JSON
from arctrack.recording.run_offsets import LIVE_FOLDER, LIVE_RESULTS
from arctrack.version import __version__

LIVE_TABLE = f"{LIVE_FOLDER}/{LIVE_RESULTS}"

TABLES = (FRAMES_CSV, TRUTH_CSV, CSV_NAME, *LOG_NAMES, STEPS_CSV, STATE_JSON, LIVE_TABLE)
"""The files of a recording that are compared by content."""


class FinishedRecord(BaseModel):
    """Content of finished.json: the digest of the inputs, the sizes in bytes of the output files."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["arctrack-finished/1"] = "arctrack-finished/1"
    made_of: str
    files: dict[str, int]

    def write(self, folder: Path) -> None:
        """Write finished.json, whole or not at all; ArctrackError if it cannot be written."""
        write_whole(folder / FINISHED_JSON, json.dumps(self.model_dump(), indent=2) + "\n")

    @classmethod
    def read(cls, folder: Path, made_of: str, needed: Iterable[str], names: Iterable[str]) -> Self | None:
        """Return what an earlier run finished in a folder; None unless it is whole, and was made of the same.

        `needed` are files without which it is not whole, `names` all that such a run may write.
        """
        try:
            finished = cls.model_validate(json.loads(read_text(folder / FINISHED_JSON, LIMITS.toml_bytes)))
        except (OSError, ValueError):
            return None
        whole = set(needed) <= finished.files.keys() and finished.files == sizes(folder, names)
        return finished if whole and finished.made_of == made_of else None


def sizes(folder: Path, names: Iterable[str]) -> Mapping[str, int]:
    """Return the size in bytes of each of these files that a folder holds."""
    paths = ((name, folder / name) for name in names if name != FINISHED_JSON)
    return {name: path.stat().st_size for name, path in paths if path.is_file()}


def digest_of(recording: Recording, options: str, others: Iterable[Path] = ()) -> str:
    """Return the digest of what is made of a recording: it, its setup, options, other files, arctrack itself.

    Tables and setups count by content, frames by name, size and time of change: a fleet's are too many to
    read twice.
    """
    digest = hashlib.sha256()
    contents = _contents([recording.setup_path, *others, *(recording.path / name for name in TABLES)])
    for part in (__version__, source_digest(), recording.name, options, *contents, *_frames(recording)):
        digest.update(hashlib.sha256(part.encode(errors="surrogateescape")).digest())
    return digest.hexdigest()


def _contents(paths: Iterable[Path]) -> Iterator[str]:
    for path in paths:
        yield hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "none"


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
    root = real(Path(__file__)).parent.parent
    # Numbers depend on these packages.
    for package in ("arctrack", "noise_model", "robot_io", "sim_to_real", "tracker"):
        for path in sorted((root / package).rglob("*.py")):
            digest.update(
                f"{path.relative_to(root)} {hashlib.sha256(path.read_bytes()).hexdigest()}".encode()
            )
    return digest.hexdigest()
