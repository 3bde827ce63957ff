"""Parquet file of many replays' frames: the rows of their results.csv, each with its recording's name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from arctrack.errors import in_file, without_extra
from arctrack.output import real, whole_file
from arctrack.printable import printable
from arctrack.recording.files import blamed_on
from arctrack.recording.results import COLUMNS, RESULTS_CSV

if TYPE_CHECKING:
    from pyarrow import Table

TEXTS = (
    "flags",
    "pose_doubt",
    "validity",
    "gate_reason",
    "run_validity",
    "run_gate_reason",
    "run_pose_doubt",
    "weld_refusal",
    "arc_height_unknown",
)
NO_FLOATS = {"frame": "int64", "valid": "bool", **dict.fromkeys(TEXTS, "string")}
"""The columns of results.csv that are not float64, and Arrow's names for their types."""


class ReplayedRecording(NamedTuple):
    """A recording's folder, and the folder of its results."""

    recording: Path
    results: Path


def check_parquet(path: Path) -> None:
    """Raise ArctrackError, with the cure, where no Parquet file can be written: before the work for it."""
    try:
        from pyarrow import parquet  # noqa: F401
    except ModuleNotFoundError as error:
        raise without_extra("--parquet", error, "parquet") from None
    if path.is_dir():
        raise in_file(path, "is a folder; --parquet takes a file")
    if not path.parent.is_dir():
        raise in_file(path, "cannot be written: there is no such folder")


def write_parquet(path: Path, replays: Iterable[ReplayedRecording]) -> int:
    """Write the frames of all replays as one table, whole or not at all, and return the number of rows.

    Each replay is a row group, in this order; what is empty in results.csv is null. A file that is there is
    replaced. Raises ArctrackError if a results.csv cannot be read, or the file cannot be written.
    """
    import pyarrow
    from pyarrow import parquet

    texts = [(name, pyarrow.string()) for name in ("recording", "recording_path")]
    schema = pyarrow.schema([*texts, *_types().items()])
    rows = 0
    with whole_file(path) as draft, parquet.ParquetWriter(draft, schema) as file:
        for replay in replays:
            read = _read(replay.results / RESULTS_CSV)
            recording = real(replay.recording)
            named = [[printable(text)] * read.num_rows for text in (recording.name, str(recording))]
            file.write_table(pyarrow.Table.from_arrays([*named, *read.columns], schema=schema))
            rows += read.num_rows
    return rows


def _read(path: Path) -> Table:
    """Read a results.csv; ArctrackError if it cannot be read."""
    from pyarrow import csv

    options = csv.ConvertOptions(column_types=_types(), strings_can_be_null=True)
    with blamed_on(path):
        return csv.read_csv(path, convert_options=options)


def _types() -> dict[str, object]:
    import pyarrow

    return {name: pyarrow.type_for_alias(NO_FLOATS.get(name, "float64")) for name in COLUMNS}
