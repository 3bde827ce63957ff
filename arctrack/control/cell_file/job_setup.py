"""A cell's setup as one of its jobs has it, as the text of a recording.toml."""

import tomlkit

from arctrack.control.cell_file.choices import CellFile
from arctrack.limits import LIMITS
from arctrack.recording.files import read_text
from arctrack.recording.setup_file import setup_text


def job_setup_text(cell: CellFile, number: int) -> str:
    """Return the setup file's text with the joint and the correction of a job; poses are the tool's own.

    What is not the job's stays as it was written: it reads back the same, bit for bit.
    """
    document = tomlkit.parse(setup_text(cell.setup.path))
    job = tomlkit.parse(read_text(cell.path, LIMITS.toml_bytes)).unwrap()["jobs"][str(number)]
    # A job that states no correction has none of the setup's either.
    document.pop("follow", None)
    for table in ("joint", "follow"):
        if table in job:
            document[table] = job[table]
    robot = document.get("robot")
    if robot is not None:
        robot.pop("controllertool_to_tool", None)
    return tomlkit.dumps(document)
