"""A recording to fill in: a setup whose every number says what it is, its unit and where it comes from."""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

from arctrack.nominal import nominal_setup
from arctrack.output import make_new_folder, write_whole, writing
from arctrack.recording import format_setup
from arctrack.recording.files import FRAMES_CSV
from arctrack.recording.frames import FOLDER_NAME
from arctrack.recording.poses import CSV_NAME as POSES_CSV
from arctrack.recording.setup_file import FILE_NAME
from arctrack.recording.tables import FRAME_COLUMNS, POSE_COLUMNS
from noise_model.setup import Setup

COLUMNS = 100
RADIANCE_E = 2.0e8
"""`[arc] radiance_e` of the sensor of `arctrack.nominal`: it gives light of the right order on any joint."""


class NumberSource(Enum):
    """Where a number comes from."""

    DATA_SHEET = "the data sheet"
    CHOICE = "your choice"
    RULER = "a ruler or the drawing"
    CALIBRATION = "a calibration"
    PICTURE = "a picture"
    GUESS = "a guess"


@dataclass(frozen=True)
class Key:
    """A key of recording.toml: what it is, where it comes from, how to get it, and what it usually is.

    `optional` is the value that stands, commented out, for a key that need not be stated.
    """

    table: str
    name: str
    meaning: str
    source: NumberSource
    how: str
    typical: str
    optional: str = ""


KEYS = (
    Key(
        "camera",
        "width",
        "The image's width, px.",
        NumberSource.DATA_SHEET,
        "Of the frames that you record: a region of interest counts, not the whole sensor.",
        "320 to 2048",
    ),
    Key(
        "camera", "height", "The image's height, px.", NumberSource.DATA_SHEET, "As the width.", "240 to 2048"
    ),
    Key(
        "camera",
        "fx",
        "Focal length across the image, px.",
        NumberSource.CALIBRATION,
        "`arctrack calibrate camera`, with a chessboard. Check: focal_length_mm over the pixel's size in mm, "
        "some 10 % more when focused near by.",
        "1000 to 6000",
    ),
    Key(
        "camera",
        "fy",
        "Focal length down the image, px.",
        NumberSource.CALIBRATION,
        "As fx; equal to it for square pixels.",
        "1000 to 6000",
    ),
    Key(
        "camera",
        "cx",
        "Where the optical axis meets the image, px; the first pixel's centre is 0.",
        NumberSource.CALIBRATION,
        "`arctrack calibrate camera`. Check: near (width - 1) / 2.",
        "0.4 to 0.6 of the width",
    ),
    Key(
        "camera",
        "cy",
        "The same down the image, px.",
        NumberSource.CALIBRATION,
        "As cx.",
        "0.4 to 0.6 of the height",
    ),
    Key(
        "camera",
        "distortion",
        "The lens' distortion, OpenCV's k1 k2 p1 p2 k3.",
        NumberSource.CALIBRATION,
        "`arctrack calibrate camera` chooses how many it needs. All 0 for a lens that has none.",
        "k1 -0.3 to 0.3",
    ),
    Key(
        "camera",
        "focal_length_mm",
        "The lens' focal length, mm.",
        NumberSource.DATA_SHEET,
        "Engraved on the lens. Only planning uses it.",
        "8 to 50",
    ),
    Key(
        "camera",
        "f_number",
        "The aperture.",
        NumberSource.CHOICE,
        "As set on the lens. Only planning uses it.",
        "4 to 16",
    ),
    Key(
        "camera",
        "psf_sigma_px",
        "Blur of lens and pixel together: 1 sigma of a Gaussian, px.",
        NumberSource.PICTURE,
        "Of a sharp edge in focus: the distance over which it rises from 16 % to 84 % is 2 sigma.",
        "0.5 to 1.5",
    ),
    Key(
        "camera",
        "exposure_s",
        "The usual exposure, s. Seconds: 5 ms are 0.005.",
        NumberSource.CHOICE,
        "As set on the camera. frames.csv states that of each frame.",
        "0.0001 to 0.02",
    ),
    Key(
        "camera",
        "pixel_format",
        "The pixels' format; it must be a monochrome one.",
        NumberSource.DATA_SHEET,
        "As set on the camera.",
        "mono8, mono12",
    ),
    Key(
        "camera.pose_in_tool",
        "translation_mm",
        "Where the camera's centre stands in the tool frame: x, y, z, mm.",
        NumberSource.CALIBRATION,
        "`arctrack calibrate hand-eye` from images of a board, or the drawing; the arc's light refines it. "
        "The tool frame: origin at the electrode's working point, x along the travel, y to its left, z away "
        "from the part.",
        "50 to 250 from the tool's origin",
    ),
    Key(
        "camera.pose_in_tool",
        "quaternion_xyzw",
        "How the camera is turned in the tool frame: unit quaternion, x y z w, w last.",
        NumberSource.CALIBRATION,
        "As the translation. The camera's axes are OpenCV's: x to the right in the image, y down, z forward.",
        "length 1",
    ),
    Key("sensor", "bits", "Bits of a pixel as recorded.", NumberSource.DATA_SHEET, "8 for mono8.", "8 to 12"),
    Key(
        "sensor",
        "gain_e_per_dn",
        "Electrons for one grey level.",
        NumberSource.DATA_SHEET,
        "EMVA 1288 calls its inverse the system gain K. Check: full_well_e over the highest grey level. "
        "`arctrack calibrate sensor` measures it.",
        "5 to 150 at 8 bits",
    ),
    Key(
        "sensor",
        "black_level_dn",
        "The mean grey level without light.",
        NumberSource.PICTURE,
        "The mean of a frame with the lens covered; `arctrack calibrate sensor` measures it. It must be "
        "above 0, or noise is cut off.",
        "1 to 20 at 8 bits",
    ),
    Key(
        "sensor",
        "read_noise_e",
        "Noise without light: 1 sigma, electrons.",
        NumberSource.DATA_SHEET,
        "EMVA 1288's temporal dark noise. `arctrack calibrate sensor` measures it.",
        "2 to 60",
    ),
    Key(
        "sensor",
        "full_well_e",
        "Electrons at which a pixel is full.",
        NumberSource.DATA_SHEET,
        "EMVA 1288's saturation capacity; gain_e_per_dn times the highest grey level where that is less. "
        "`arctrack calibrate sensor` measures it on flat frames.",
        "5000 to 100000",
    ),
    Key(
        "sensor",
        "gamma",
        "The response's exponent: 1 where twice the light is twice the grey level.",
        NumberSource.CHOICE,
        "Switch the camera's gamma off, and state 1. `arctrack calibrate sensor` measures it on flat frames.",
        "1, or 0.45 with gamma on",
    ),
    Key(
        "filter",
        "center_nm",
        "The passband's centre, nm.",
        NumberSource.DATA_SHEET,
        "At normal incidence.",
        "635 to 850",
    ),
    Key(
        "filter",
        "fwhm_nm",
        "The passband's full width at half height, nm.",
        NumberSource.DATA_SHEET,
        "",
        "2 to 30",
    ),
    Key(
        "filter",
        "effective_index",
        "By how much the passband moves under an angle: the effective index.",
        NumberSource.DATA_SHEET,
        "The maker's n_eff. `arctrack calibrate filter` takes a measured curve.",
        "1.4 to 2.2",
    ),
    Key("laser", "wavelength_nm", "The laser's wavelength, nm.", NumberSource.DATA_SHEET, "", "635 to 850"),
    Key(
        "laser",
        "plane_in_tool",
        "The sheet of light in the tool frame: n_x, n_y, n_z, d of n·p + d = 0, n of length 1, d in mm.",
        NumberSource.CALIBRATION,
        "`arctrack calibrate laser`, from images of a board without and with the stripe; "
        "`arctrack calibrate gauge`, from the stripe on a block of known size. "
        "An upright sheet 35 mm ahead of the torch is [1, 0, 0, -35].",
        "30 to 60 ahead",
    ),
    Key(
        "laser",
        "origin_in_tool_mm",
        "Where the sheet fans out from: x, y, z in the tool frame, mm.",
        NumberSource.RULER,
        "The laser's exit window, to a few mm. It must lie in the sheet.",
        "80 to 300 above the part",
    ),
    Key(
        "laser",
        "stripe_sigma_mm",
        "The sheet's half thickness where it meets the part: 1 sigma, mm.",
        NumberSource.CALIBRATION,
        "`arctrack calibrate laser`. Check: the stripe's full width at half height over 2.35; a width in px "
        "times the distance over fx is mm.",
        "0.05 to 0.6",
    ),
    Key(
        "laser",
        "peak_e",
        "The stripe's peak on a flat plate at the tool's height, electrons.",
        NumberSource.PICTURE,
        "Arc off: the stripe's highest grey level less the black level, times gain_e_per_dn.",
        "0.2 to 0.8 of full_well_e",
    ),
    Key(
        "laser",
        "fan_half_angle_deg",
        "Where the fan of light ends to either side of its axis, deg. Optional: without it the stripe is "
        "longer than the image shows.",
        NumberSource.DATA_SHEET,
        "Half the fan angle; `arctrack calibrate laser` measures it. "
        "Check: half the stripe's length over the laser's height is its tangent.",
        "5 to 45",
        optional="30.0",
    ),
    Key(
        "arc",
        "radius_mm",
        "Radius of the arc's bright half sphere, mm.",
        NumberSource.PICTURE,
        "Of the arc through a dark filter, with the electrode's diameter as the scale. "
        "`arctrack calibrate arc` finds it from frames of the arc alone.",
        "1.5 to 5",
    ),
    Key(
        "arc",
        "center_in_tool_mm",
        "The half sphere's centre: x, y, z in the tool frame, mm.",
        NumberSource.RULER,
        "The origin, where the arc burns on the part's surface. On a lap it stands on the upper sheet. "
        "`arctrack calibrate arc` finds it.",
        "within 3 of the origin",
    ),
    Key(
        "arc",
        "radiance_e",
        "How bright the arc is to this camera, electrons.",
        NumberSource.GUESS,
        "Leave it, replay a recording, and multiply it by the median of `arc_level` in results.csv; or "
        "`arctrack calibrate arc`.",
        "1e6 to 1e10",
    ),
    Key(
        "arc",
        "current_a",
        "The welding current at which radiance_e holds, A.",
        NumberSource.CHOICE,
        "As set on the power source. frames.csv states that of each frame.",
        "50 to 300",
    ),
    Key(
        "arc",
        "current_exponent",
        "The light goes with the current to this power.",
        NumberSource.GUESS,
        "Of the arc's light at two currents: the ratio's logarithm over that of the currents.",
        "1 to 2",
    ),
    Key(
        "arc", "shape", "The arc's shape; hemisphere is the only one.", NumberSource.CHOICE, "", "hemisphere"
    ),
    Key(
        "arc",
        "on_surface",
        "Whether the arc's foot stays on the part when the torch is raised.",
        NumberSource.CHOICE,
        "true for a torch that burns on the part.",
        "true",
    ),
    Key("material", "name", "The base metal's name.", NumberSource.CHOICE, "For your own use.", "mild_steel"),
    Key(
        "material",
        "kappa_diff",
        "Diffuse part of the metal's reflectance.",
        NumberSource.CALIBRATION,
        "Mild steel 0.021, Zn-coated 0.495; another metal by `arctrack calibrate reflectance`, from "
        "goniometer readings, or by `arctrack calibrate arc`.",
        "0.02 to 0.6",
    ),
    Key(
        "material",
        "kappa_spec",
        "Specular part of the metal's reflectance.",
        NumberSource.CALIBRATION,
        "Mild steel 0.326, Zn-coated 0.153. As kappa_diff.",
        "0.1 to 0.5",
    ),
    Key(
        "material",
        "c2",
        "How narrow the specular lobe is: the larger, the more like a mirror.",
        NumberSource.CALIBRATION,
        "Mild steel 112, Zn-coated 8.3. As kappa_diff.",
        "5 to 200",
    ),
    Key(
        "tolerance",
        "arc_level_rel",
        "How well radiance_e is known: 1 sigma, relative.",
        NumberSource.GUESS,
        "0.1 after a first replay.",
        "0.05 to 0.3",
    ),
    Key(
        "tolerance",
        "laser_level_rel",
        "How well peak_e is known: 1 sigma, relative.",
        NumberSource.GUESS,
        "",
        "0.02 to 0.2",
    ),
    Key(
        "tolerance",
        "hand_eye_deg",
        "How well the camera's rotation is known: 1 sigma about each axis, deg.",
        NumberSource.CALIBRATION,
        "The residual of the hand-eye calibration. It limits the confidence that a track can have.",
        "0.02 to 0.5",
    ),
    Key(
        "tolerance",
        "hand_eye_mm",
        "How well the camera's place is known: 1 sigma along each axis, mm.",
        NumberSource.CALIBRATION,
        "As hand_eye_deg.",
        "0.02 to 0.5",
    ),
    Key(
        "tolerance",
        "black_level_dn",
        "How well the black level is known: 1 sigma, grey levels.",
        NumberSource.PICTURE,
        "Its drift between a cold and a warm camera.",
        "0.1 to 1",
    ),
    Key(
        "tolerance",
        "read_noise_rel",
        "How well the read noise is known: 1 sigma, relative.",
        NumberSource.GUESS,
        "",
        "0.02 to 0.2",
    ),
    Key(
        "tolerance",
        "seam_mm",
        "What error of the seam the weld can bear, mm. The confidence of a track is asked for it.",
        NumberSource.CHOICE,
        "The welding procedure states it.",
        "0.1 to 1",
    ),
    Key(
        "joint",
        "type",
        "The joint: v_groove, half_v, u_groove, lap, corrugation, butt, fillet, edge or flat.",
        NumberSource.CHOICE,
        "Each type has dimensions of its own.",
        "v_groove",
    ),
    Key(
        "joint",
        "seam_in_base_mm",
        "The programmed seam in the base frame, from the start of the travel to its end: points x, y, z, mm.",
        NumberSource.RULER,
        "Two points are enough for a straight seam: those that the robot was taught.",
        "20 to 5000 long",
    ),
    Key(
        "joint",
        "surface_normal_in_base",
        "The direction away from the part, in the base frame; length 1.",
        NumberSource.RULER,
        "[0, 0, 1] for a plate that lies flat in a base whose z is up.",
        "length 1",
    ),
    Key(
        "joint",
        "included_angle_deg",
        "The angle between the two faces, deg.",
        NumberSource.RULER,
        "",
        "30 to 120",
    ),
    Key("joint", "bevel_angle_deg", "A bevel's angle from upright, deg.", NumberSource.RULER, "", "10 to 60"),
    Key("joint", "depth_mm", "The groove's depth, mm.", NumberSource.RULER, "", "1 to 30"),
    Key("joint", "root_gap_mm", "The gap at the root, mm.", NumberSource.RULER, "", "0 to 4"),
    Key("joint", "root_radius_mm", "The root's rounding, mm.", NumberSource.RULER, "", "1 to 10"),
    Key(
        "joint",
        "thickness_mm",
        "A sheet's thickness, mm; of a lap the upper one's.",
        NumberSource.RULER,
        "",
        "0.8 to 10",
    ),
    Key("joint", "gap_mm", "The gap between the plates, mm.", NumberSource.RULER, "", "0 to 3"),
    Key("joint", "pitch_mm", "From one crest to the next, mm.", NumberSource.RULER, "", "20 to 200"),
    Key("joint", "height_mm", "The crests' height, mm.", NumberSource.RULER, "", "2 to 50"),
    Key("joint", "width_mm", "A crest's width at its foot, mm.", NumberSource.RULER, "", "10 to the pitch"),
)
"""Every key of a setup, in the file's order; those of the tolerance and those marked are optional."""

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
    described = {(key.table, key.name): key for key in KEYS}
    lines = _HEAD.splitlines()
    table, stated = "", set[str]()
    for line in format_setup(setup).splitlines():
        name, equals, _ = line.partition(" = ")
        if not line and table:
            lines += _left_out(table, stated)
        elif line.startswith("["):
            table, stated = line.strip("[]"), set()
        elif equals and table:
            lines += _comment(described[table, name])
            stated.add(name)
        lines.append(line)
    return "\n".join([*lines, *_FOOT.splitlines()]) + "\n"


def _left_out(table: str, stated: Collection[str]) -> Iterator[str]:
    """Return a table's optional keys that are not stated, commented out."""
    for key in KEYS:
        if key.optional and key.table == table and key.name not in stated:
            yield from _comment(key)
            yield f"# {key.name} = {key.optional}"


def _comment(key: Key) -> Iterator[str]:
    for text in (f"{key.meaning} Usual: {key.typical}.", f"From {key.source.value}. {key.how}"):
        yield from textwrap.wrap(text, COLUMNS, initial_indent="# ", subsequent_indent="# ")
