"""A recording to fill in: a setup whose every number says what it is, its unit and where it comes from."""

import textwrap
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

from arctrack.nominal import nominal_setup
from arctrack.output import make_new_folder, write_whole, writing
from arctrack.recording import format_setup
from arctrack.recording.files import FRAMES_CSV
from arctrack.recording.frames import FOLDER_NAME
from arctrack.recording.poses import CSV_NAME as POSES_CSV
from arctrack.recording.schema import Key, keys_of
from arctrack.recording.setup_model import ProfilerToml, RecordingToml
from arctrack.recording.setup_writer import FILE_NAME
from arctrack.recording.tables import FRAME_COLUMNS, POSE_COLUMNS
from noise_model.setup import Setup

RADIANCE_E = 2.0e8
"""`[arc] radiance_e` of the sensor of `arctrack.nominal`: it gives light of the right order on any joint."""


_HEAD = """\
# The nominal setup of a sensor: what is known of it before the first frame.
# Each value below is that of a sensor that works; replace it by your own.
# "Usual" says what a number is for most sensors, "from" where yours comes from.
# Lengths are in mm, angles in degrees, times in seconds, charges in electrons.
# A sensor that sees no arc needs no [arc]; whose filter or metal nobody knows, no [filter] and no [material].
"""

_FOOT = """
# A robot whose tool frame has z into the part: take the # off the next three lines.
# [robot.controllertool_to_tool]
# translation_mm = [0.0, 0.0, 0.0]
# quaternion_xyzw = [1.0, 0.0, 0.0, 0.0]

# What is sent of the seam (gain, limits, a lost seam) is stated in [follow], which is optional.
# Effects that are known to act are stated in [effects.NAME], optional too.
"""


def write_new(folder: Path, joint_type: str, material_name: str) -> tuple[Path, ...]:
    """Write a recording to fill in, and return its files: the setup, and two tables of headers alone.

    Raises ArctrackError if the folder holds anything, or if it cannot be written.
    """
    make_new_folder(folder)
    setup = nominal_setup(joint_type, material_name)
    texts = {
        FILE_NAME: commented_setup(replace(setup, arc=replace(setup.arc, radiance_e=RADIANCE_E))),
        FRAMES_CSV: ",".join(FRAME_COLUMNS) + "\n",
        POSES_CSV: ",".join(POSE_COLUMNS) + "\n",
    }
    with writing(folder):
        (folder / FOLDER_NAME).mkdir()
    for name, text in texts.items():
        write_whole(folder / name, text)
    return tuple(folder / name for name in texts)


def commented_setup(setup: Setup) -> str:
    """Return a recording.toml that reads back as the setup, with a comment above each key."""
    keys = tuple(keys_of(RecordingToml if setup.profiler is None else ProfilerToml))
    described = {(key.table, key.name): key for key in keys}
    lines = _HEAD.splitlines()
    table, stated = "", set[str]()
    for line in format_setup(setup).splitlines():
        name, equals, _ = line.partition(" = ")
        if not line and table:
            lines += _left_out(keys, table, stated)
        elif line.startswith("["):
            table, stated = line.strip("[]"), set()
        elif equals and table:
            lines += comment(described[table, name])
            stated.add(name)
        lines.append(line)
    return "\n".join([*lines, *_FOOT.splitlines()]) + "\n"


def _left_out(keys: Collection[Key], table: str, stated: Collection[str]) -> Iterator[str]:
    """Yield the keys of a table that are not stated and have an example, behind a #."""
    for key in keys:
        if key.table == table and key.name not in stated and key.text("example"):
            yield from comment(key)
            yield f"# {key.name} = {key.text('example')}"


def comment(key: Key) -> Iterator[str]:
    """Yield the lines of comment above a key."""
    typical, source = key.text("typical"), key.text("source")
    meaning = f"{key.meaning} Usual: {typical}." if typical else key.meaning
    if source:
        yield from wrapped(meaning)
        yield from wrapped(f"From {source}")
    else:
        yield from wrapped(f"{meaning} {key.text('note')}")


def wrapped(text: str) -> list[str]:
    """Return a text as lines of comment."""
    return textwrap.wrap(text, 100, initial_indent="# ", subsequent_indent="# ")
