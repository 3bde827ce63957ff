"""Many recordings in one view: a page that follows the work on them, and a table with a row a recording."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from urllib.parse import quote

from arctrack.errors import in_file, without_extra
from arctrack.output import make_folder, real, whole_file, write_whole
from arctrack.printable import printable
from arctrack.report.template import environment

FLEET_PAGE, FLEET_TABLE = "fleet.html", "fleet.parquet"

REFRESH_S = 5
"""Time between two states of the page while the work goes on."""

Number = float | int | str | None
"""A value of the table; None is not known."""


class FleetState(Enum):
    """State of the work on a recording."""

    DONE = "done"
    TAKEN_OVER = "taken over"
    FAILED = "failed"


@dataclass(frozen=True)
class FleetRow:
    """Row of a recording: its numbers by column, and what else there is to say (`said`).

    `page` is the file in `folder` that shows more, "" for none. On the page the recordings that failed come
    first, then those with the smallest `order`.
    """

    recording: Path
    folder: Path
    state: FleetState
    said: str = ""
    numbers: Mapping[str, Number] = field(default_factory=dict)
    page: str = ""
    order: float = math.nan


OnRow = Callable[[FleetRow], None]
"""Callback with what came of a recording."""


@contextmanager
def followed(folder: Path | None, work: str, total: int, columns: Mapping[str, str]) -> Iterator[OnRow]:
    """Follow some work on `total` recordings in a folder's page; its table comes at the end.

    `columns` are the table's numbers and Arrow's names for their types. What was done is in both files also
    where the work is interrupted. Without a folder nothing is written. Raises ArctrackError, before the work,
    where no Parquet file can be written, and where the folder cannot.
    """
    if folder is None:
        yield lambda row: None
        return
    try:
        import pyarrow  # noqa: F401
    except ModuleNotFoundError as error:
        raise without_extra("--fleet", error, "parquet") from None
    if folder.exists() and not folder.is_dir():
        raise in_file(folder, "is a file; --fleet takes a folder")
    make_folder(folder, (FLEET_PAGE, FLEET_TABLE))
    view = _FleetView(folder, work, total, columns)
    view.write_page(is_over=False)
    try:
        yield view.add
    finally:
        view.write_page(is_over=True)
        view.write_table()


class _FleetView:
    """The page and the table of a fleet, as far as its work has come."""

    def __init__(self, folder: Path, work: str, total: int, columns: Mapping[str, str]) -> None:
        self._folder, self._work, self._total, self._columns = folder, work, total, columns
        self._rows: list[FleetRow] = []
        self._began_s = self._written_s = time.monotonic()

    def add(self, row: FleetRow) -> None:
        self._rows.append(row)
        if time.monotonic() > self._written_s + REFRESH_S:
            self.write_page(is_over=False)

    def write_page(self, is_over: bool) -> None:
        self._written_s = time.monotonic()
        is_failed = [row.state is FleetState.FAILED for row in self._rows]
        places = sorted(range(len(self._rows)), key=lambda n: (not is_failed[n], _order(self._rows[n])))
        page = (
            environment()
            .get_template("fleet.html.j2")
            .render(
                work=self._work,
                headline=self._headline(sum(is_failed)),
                sentence="" if is_over else self._left(),
                refresh_s=None if is_over else REFRESH_S,
                mark="unknown" if any(is_failed) else "no_gap",
                columns=[name.replace("_", " ") for name in self._columns],
                rows=[self._cells(self._rows[n]) for n in places],
                table=FLEET_TABLE if is_over else "",
            )
        )
        write_whole(self._folder / FLEET_PAGE, page)

    def write_table(self) -> None:
        import pyarrow
        from pyarrow import parquet

        texts = {
            "recording": [real(row.recording).name for row in self._rows],
            "recording_path": [str(real(row.recording)) for row in self._rows],
            "results_path": [str(real(row.folder)) for row in self._rows],
            "state": [row.state.value for row in self._rows],
            "said": [row.said for row in self._rows],
        }
        arrays = [pyarrow.array(map(printable, cells), pyarrow.string()) for cells in texts.values()]
        for name, kind in self._columns.items():
            cells = [row.numbers.get(name) for row in self._rows]
            arrays.append(pyarrow.array(cells, pyarrow.type_for_alias(kind)))
        table = pyarrow.Table.from_arrays(arrays, names=[*texts, *self._columns])
        with whole_file(self._folder / FLEET_TABLE) as draft:
            parquet.write_table(table, draft)

    def _headline(self, failed: int) -> str:
        done = f"{len(self._rows)} of {self._total} recordings"
        taken_over = sum(row.state is FleetState.TAKEN_OVER for row in self._rows)
        notes = [f"{failed} failed"] * (failed > 0) + [f"{taken_over} taken over"] * (taken_over > 0)
        return f"{done}: {', '.join(notes)}" if notes else done

    def _left(self) -> str:
        """Return how long the rest will take, at the pace so far."""
        new = sum(row.state is not FleetState.TAKEN_OVER for row in self._rows)
        if not new:
            return "Under way."
        left_s = (time.monotonic() - self._began_s) / new * (self._total - len(self._rows))
        return f"Under way, about {max(1, round(left_s / 60.0))} min more."

    def _cells(self, row: FleetRow) -> dict[str, object]:
        link = f"{quote(str(real(row.folder)))}/{row.page}" if row.page else ""
        return {
            "name": printable(real(row.recording).name),
            "link": link,
            "state": row.state.value,
            "mark": "unknown" if row.state is FleetState.FAILED else "no_gap",
            "numbers": [_text(row.numbers.get(name)) for name in self._columns],
            "said": printable(row.said),
        }


def _order(row: FleetRow) -> tuple[float, str]:
    return (math.inf if math.isnan(row.order) else row.order), real(row.recording).name


def _text(value: Number) -> str:
    if value is None:
        return "–"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
