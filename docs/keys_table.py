"""Writes the pages of keys in docs/reference: `python docs/keys_table.py`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal, get_args, get_origin

from pydantic import BaseModel

from arctrack.calibrate.all.calibration_tables import CalibrationToml
from arctrack.control.cell_file.model import KEYS_OF_KIND, CellToml
from arctrack.recording.schema import MAX_NUMBER, Key, tables_of
from arctrack.recording.setup_model import ProfilerToml, RecordingToml
from noise_model.setup_keys import DIMENSIONS, OPTIONAL_DIMENSIONS

REFERENCE = Path(__file__).parent / "reference"
SETUP = f"""# The keys of a setup

What each key of `recording.toml` is, where its value comes from, and what it usually is. `arctrack new` says
it beside each key. A key is needed unless its line says what holds without it. A number is finite and at most
{MAX_NUMBER:g} in size: its square and its ratios stay finite. [Recordings](recording.md#recordingtoml) has
more on joints and on optional tables.
"""
CELL = """# The keys of a cell file

What each key of `cell.toml` is, and what holds without it. `arctrack cell new` says it beside each key.
[The cell file](cell_file.md) has an example. N stands for a job's number. `[jobs.N.joint]` has the keys of
[`[joint]`](setup_keys.md#joint), `[jobs.N.follow]` those of [`[follow]`](setup_keys.md#follow).
"""
CALIBRATION = """# The keys of calibration.toml

The file lies in the folder that `arctrack calibrate all` reads, and says what the raw files cannot say.
[Calibrating all of a sensor](../how_to/calibrate_all.md) has an example. A path goes from this file on.
"""


def pages() -> dict[str, str]:
    """Return the text of each page, by its name."""
    return {
        "setup_keys.md": "\n".join([SETUP, *_sections(RecordingToml), *_profiler()]),
        "cell_keys.md": "\n".join([CELL, *_sections(CellToml)]),
        "calibration_keys.md": "\n".join([CALIBRATION, *_sections(CalibrationToml)]),
    }


def _profiler() -> Iterator[str]:
    """Yield the lines of the tables that a profiler's file has of its own."""
    for place, table, keys in tables_of(ProfilerToml):
        if place.startswith("camera"):
            yield from [f"## [{place}] of a profiler", "", str(table.__doc__), ""]
            yield from (f"- `{key.name}`: {' '.join(_sentences(key))}" for key in keys)
            yield ""


def _sections(model: type[BaseModel]) -> Iterator[str]:
    """Yield the lines of a list for each table of a file; a table of the same keys refers to the first."""
    seen = dict[type[BaseModel], str]()
    for place, table, keys in tables_of(model):
        if place.startswith(("jobs.N.joint", "jobs.N.follow")):
            continue
        if place:
            is_needed = model.model_fields[place.split(".")[0]].is_required()
            yield from [f"## [{place}]", "", f"{table.__doc__}{'' if is_needed else ' Optional.'}", ""]
        if table in seen:
            yield f"The keys are those of [{seen[table]}]."
        else:
            yield from (f"- `{key.name}`: {' '.join(_sentences(key))}" for key in keys)
        seen[table] = place
        yield ""


def _sentences(key: Key) -> Iterator[str]:
    yield key.meaning
    dimensions = {name: (*needed, *OPTIONAL_DIMENSIONS.get(name, ())) for name, needed in DIMENSIONS.items()}
    types = [name for name, names in dimensions.items() if key.table == "joint" and key.name in names]
    kinds = [kind for kind, names in KEYS_OF_KIND.items() if key.table == "camera" and key.name in names]
    held = key.field.annotation
    literals = (part for part in (held, *get_args(held)) if get_origin(part) is Literal)
    choices = [f"`{choice}`" for literal in literals for choice in get_args(literal)]
    if choices:
        yield f"One of {', '.join(choices)}."
    if types or kinds:
        yield f"Of {', '.join(types or kinds)}."
    if key.default is not None:
        yield f"Unless stated `{key.default}`."
    elif not (types or kinds or key.field.is_required()):
        yield "Optional."
    if key.text("source"):
        yield f"From {key.text('source')}"
    if key.text("note"):
        yield key.text("note")
    if key.text("typical"):
        yield f"Usual: {key.text('typical')}."
    low, high, source = key.bounds
    if high != MAX_NUMBER and (low, high) != (None, None):
        first, last = (f"{end}" if isinstance(end, int) else f"{end:g}" for end in (low or 0, high or 0))
        ends = (
            f"{first} at least"
            if high is None
            else f"{last} at most"
            if low is None
            else f"{first} to {last}"
        )
        yield f"Accepted: {ends}{f' ({source})' if source else ''}."


if __name__ == "__main__":
    for name, text in pages().items():
        (REFERENCE / name).write_text(text, encoding="utf-8")
