"""Prints docs/reference/setup_keys.md: `python docs/keys_table.py > docs/reference/setup_keys.md`."""

from collections.abc import Iterator
from itertools import groupby

from pydantic import BaseModel

from arctrack.recording.schema import MAX_NUMBER, Key, keys_of
from arctrack.recording.setup_model import RecordingToml
from noise_model.setup_keys import DIMENSIONS

SETUP = f"""# The keys of a setup

What each key of `recording.toml` is, where its value comes from, and what it usually is. `arctrack new` says
it beside each key. A key is needed unless its line says what holds without it. A number is finite and at most
{MAX_NUMBER:g} in size: its square and its ratios stay finite. [Recordings](recording.md#recordingtoml) has
more on joints and on optional tables.
"""


def setup_keys() -> str:
    """Return the page of recording.toml."""
    return f"{SETUP}\n" + "\n".join(_sections(RecordingToml))


def _sections(model: type[BaseModel]) -> Iterator[str]:
    """Yield the lines of a list for each table of a file."""
    before: list[str] = []
    for table, keys in groupby(keys_of(model), key=lambda key: key.table):
        top = model.model_fields[table.split(".")[0]]
        yield f"## [{table}]{'' if top.is_required() else ', optional'}"
        yield ""
        lines = [f"- `{key.name}`: {' '.join(_sentences(key))}" for key in keys]
        yield from ["As the table before."] if lines == before else lines
        before = lines
        yield ""


def _sentences(key: Key) -> Iterator[str]:
    yield key.meaning
    types = [name for name, needed in DIMENSIONS.items() if key.table == "joint" and key.name in needed]
    if types:
        yield f"Of {', '.join(types)}."
    elif key.default is not None:
        yield f"Unless stated `{key.default}`."
    elif not key.field.is_required():
        yield "Optional."
    if key.said("source"):
        yield f"From {key.said('source')}"
    if key.said("note"):
        yield key.said("note")
    if key.said("typical"):
        yield f"Usual: {key.said('typical')}."
    if key.accepted:
        yield f"Accepted: {key.accepted}."


if __name__ == "__main__":
    print(setup_keys(), end="")
