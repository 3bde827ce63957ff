"""A cell's setup as one of its jobs has it, as the text of a recording.toml."""

from typing import Any

import tomlkit

from arctrack.control.cell_file.choices import CellFile
from arctrack.limits import LIMITS
from arctrack.recording.files import read_text
from arctrack.recording.setup_file import setup_text
from tracker.seam.correction import Correction


def job_setup_text(cell: CellFile, number: int) -> str:
    """Return the setup file's text with the joint and the correction of a job; poses are the tool's own.

    Of a pass that follows another one these are as it goes: displaced, and from its own end.

    What is not the job's stays as it was written: it reads back the same, bit for bit.
    """
    document = tomlkit.parse(setup_text(cell.setup.path))
    job = tomlkit.parse(read_text(cell.path, LIMITS.toml_bytes)).unwrap()["jobs"][str(number)]
    # A job that states no correction has none of the setup's either.
    document.pop("follow", None)
    for table in ("joint", "follow"):
        if table in job:
            document[table] = job[table]
    again = cell.jobs[number].again
    if again is not None:
        _go_again(document, cell.jobs[number].correction, again.reverse)
    robot = document.get("robot")
    if robot is not None:
        robot.pop("controllertool_to_tool", None)
    return tomlkit.dumps(document)


def _go_again(document: Any, correction: Correction, reverse: bool) -> None:
    """Write the displaced correction of a pass into a setup, and turn its seam line round."""
    follow = document.setdefault("follow", {})
    follow.setdefault("y", {})["bias_mm"] = correction.y.bias_mm
    follow.setdefault("z", {})["bias_mm"] = correction.z.bias_mm
    joint = document["joint"]
    for key in ("seam_in_base_mm", "surface_normals_in_base") if reverse else ():
        if key in joint:
            joint[key] = joint[key][::-1]
