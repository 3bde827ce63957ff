"""A cell file to fill in, and the setup that it points to."""

from dataclasses import replace
from pathlib import Path

from arctrack.control.cell_file.model import KEYS_OF_KIND, CellToml
from arctrack.nominal import nominal_setup
from arctrack.output import make_new_folder, write_whole
from arctrack.recording.new import RADIANCE_E, comment, commented_setup, wrapped
from arctrack.recording.schema import tables_of

_HEAD = """\
# The choices for a cell. The facts of its sensor and its part are in the setup.
# What stands behind a # has the value that it shows. Take the # off to choose another.
"""

_JOINT_AND_FOLLOW = """
# The joint of this job, where it is not the setup's; its keys are those of [joint] of the setup.
# [jobs.1.joint]
# type = "half_v"
# bevel_angle_deg = 45.0
# depth_mm = 4.0
# root_gap_mm = 1.0
# seam_in_base_mm = [[0.0, 0.0, 0.0], [200.0, 0.0, 0.0]]
# surface_normal_in_base = [0.0, 0.0, 1.0]

# An earlier pass that this job follows again, displaced: docs/how_to/follow_again.md.
# [jobs.1.again]
# seam = "root.json"                   # keep_seam of the earlier pass's job
# side_mm = 2.5                        # to the left of the travel
# height_mm = 3.0                      # out of the part
# tilt_deg = 15.0                      # leans to the right of the travel
# laser = true                         # false keeps the laser off

# What is sent of the seam: the keys are those of [follow] of a setup.
[jobs.1.follow.y]
# bias_mm = 0.0                        # to the left of the travel
# limit_mm = 3.0                       # the largest correction; without it the gate's range
[jobs.1.follow.z]
# enable = false                       # the arc-voltage control has the height
# bias_mm = 0.0
"""


def write_new_cell(folder: Path, joint_type: str, material_name: str) -> tuple[Path, Path]:
    """Write a cell file and its setup into a new folder, and return both files.

    Raises ArctrackError if the folder holds anything, or if it cannot be written.
    """
    setup = nominal_setup(joint_type, material_name)
    unknown_arc = replace(setup, arc=replace(setup.arc, radiance_e=RADIANCE_E))
    return write_cell(folder, commented_cell(), commented_setup(unknown_arc))


def write_cell(folder: Path, cell_text: str, setup_text: str) -> tuple[Path, Path]:
    """Write the texts of a cell file and its setup as `write_new_cell` does.

    The cell file comes last, and whole: whoever waits for it may read it as soon as it is there.
    """
    make_new_folder(folder)
    cell, setup = folder / "cell.toml", folder / "setup.toml"
    write_whole(setup, setup_text)
    write_whole(cell, cell_text)
    return cell, setup


def commented_cell() -> str:
    """Return a cell file with a comment on each key, but for those of one kind of camera or robot alone."""
    keys_of_one = {("camera", name) for names in KEYS_OF_KIND.values() for name in names}
    keys_of_one.add(("bus", "running_word"))
    lines = _HEAD.splitlines()
    for place, table, keys in tables_of(CellToml):
        name = place.replace("N", "1")
        if name == "jobs.1.joint":
            lines += _JOINT_AND_FOLLOW.splitlines()
        if name.startswith(("jobs.1.joint", "jobs.1.again", "jobs.1.follow")):
            continue
        if name:
            lines += ["", *wrapped(table.__doc__ or ""), f"[{name}]"]
        for key in keys:
            if (key.table, key.name) in keys_of_one:
                continue
            mark = "" if key.field.is_required() else "# "
            lines += [*comment(key), f"{mark}{key.name} = {key.text('example') or key.default}"]
    return "\n".join(lines) + "\n"
