"""A cell file to fill in, and the setup that it points to."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

from arctrack.control.cell_file.model import FORMAT
from arctrack.control.policy import ServicePolicy
from arctrack.nominal import nominal_setup
from arctrack.output import make_new_folder, write_whole
from arctrack.recording.new import RADIANCE_E, commented_setup
from robot_io import GateLimits

CELL_TOML, SETUP_TOML = "cell.toml", "setup.toml"
COLUMNS = 100

_HEAD = f"""\
# The choices for a cell. The facts of its sensor and its part are in the setup.
# What stands behind a # has the value that it shows. Take the # off to choose another.
format = "{FORMAT}"
setup = "{SETUP_TOML}"

[bus]
# python-can's interface and channel. virtual goes to nobody: try things out with it first.
interface = "virtual"                  # on a robot: "socketcan", "slcan", ...
channel = "arctrack"                   # "can0", "/dev/ttyACM0"
bit_rate_bit_s = 500000

[camera]
frame_rate_hz = 25.0                   # four messages go out with each frame: it makes the bus' load
# kind = "shared_memory"               # another process publishes frames; "recording": one is played
# name = "cell"                        # the frames' name, or the recording's folder
# Other kinds: "gige", "device", "video", "folder". docs/reference/cameras.md has their names and keys.

[gate]
"""

_JOBS = """\

[plausibility]
# What the robot can do at most: poses that do more are doubted. State your robot's own.
# speed_mm_s = 250.0
# acceleration_mm_s2 = 5000.0
# rotation_deg_s = 180.0

[process]
# How arctrack serve is scheduled. What the machine does not allow is said at the start.
# priority = 50                        # real-time priority, 1 to 99
# cpus = [1]                           # the processors that it may run on
# lock_memory = true                   # no memory is swapped out

[black_box]
# What a live run keeps: its latest frames go to disk on a fault, as a recording that replays the same.
# seconds = 30.0                       # 0: nothing is kept
# folder = "black_box"                 # from this file on

[monitor]
# The page of a live run. Other machines reach it where host says so; then a token must be stated.
# enabled = true
# host = "127.0.0.1"                   # "0.0.0.0": each address of this machine
# port = 8765                          # 0: a free one, which arctrack serve says
# token = "sixteen letters or more"

# A job for each number by which the robot names one, TrackerCommand.job_number.
[jobs.1]
name = "first job"
# offsets_in_search = false            # true: offsets go out while the robot commands SEARCH
# bridge_mm = 8.0                      # a tack, or another stretch without a joint, may reach so far

# The joint of this job, where it is not the setup's; its keys are those of [joint] of the setup.
# [jobs.1.joint]
# type = "half_v"
# bevel_angle_deg = 45.0
# depth_mm = 4.0
# root_gap_mm = 1.0
# seam_in_base_mm = [[0.0, 0.0, 0.0], [200.0, 0.0, 0.0]]
# surface_normal_in_base = [0.0, 0.0, 1.0]

# What is sent of the seam: the keys are those of [follow] of a setup.
[jobs.1.follow.y]
# bias_mm = 0.0                        # to the left of the travel
# limit_mm = 3.0                       # the largest correction; without it the gate's range
[jobs.1.follow.z]
# enable = false                       # the arc-voltage control has the height
# bias_mm = 0.0

# What the part must be like before the arc is lit: the least and the largest. Without a key nothing is asked.
[jobs.1.part]
# gap_mm = [0.0, 1.5]
# mismatch_mm = [-0.8, 0.8]
# depth_mm = [3.5, 4.5]
# angle_deg = [55.0, 65.0]
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
    cell, setup = folder / CELL_TOML, folder / SETUP_TOML
    write_whole(setup, setup_text)
    write_whole(cell, cell_text)
    return cell, setup


def commented_cell() -> str:
    """Return a cell file with a comment on each key."""
    lines = (*_limits(GateLimits), "", "[service]", *_limits(ServicePolicy))
    return _HEAD + "\n".join(lines) + "\n" + _JOBS


def _limits(record: type[GateLimits | ServicePolicy]) -> Iterator[str]:
    """Yield each limit of a record behind a #, with its role, its unit and its source."""
    for limit in fields(record):
        role, unit = limit.metadata["role"], limit.metadata["unit"]
        text = f"{role[:1].upper()}{role[1:]}{f', {unit}' if unit else ''}. {limit.metadata['source']}"
        yield from textwrap.wrap(text, COLUMNS, initial_indent="# ", subsequent_indent="# ")
        value = str(limit.default).lower() if isinstance(limit.default, bool) else limit.default
        yield f"# {limit.name} = {value}"
