"""Explanations of the keys that a check's lines name."""

import re
from collections.abc import Iterable

from arctrack.recording.schema import keys_of
from arctrack.recording.setup_model import RecordingToml


def named_keys(texts: Iterable[str]) -> dict[str, str]:
    """Return what each key of a setup is that texts name as `[table] key, key`."""
    stated = {(key.table, key.name): key.explanation for key in keys_of(RecordingToml)}
    named = (
        (table, name)
        for text in texts
        for table, names in re.findall(r"\[([\w.]+)\] (\w+(?:(?:,| and|, and) \w+)*)", text)
        for name in re.split(r",? and |, ", names)
    )
    return {f"[{table}] {name}": stated[table, name] for table, name in named if (table, name) in stated}
