"""Make an afternoon's raw files of one sensor: python examples/make_raw_files.py FOLDER.

They are for `arctrack calibrate all`.
The sensor is that of examples/v_groove. Boards are drawn before its camera, alone, with the laser stripe, and
from a robot's hand; flat and dark frames are drawn of its pixels. `calibration.toml` says what they are.
`recording.toml` is the setup to start from: its values are those of a drawing and a data sheet, and wrong.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import make_boards
import make_flats
import make_hand_eye
import make_laser_boards
import tomlkit

EXAMPLE = Path(__file__).parent / "v_groove" / "recording.toml"

WRONG: dict[str, dict[str, object]] = {
    "camera": {"fx": 2162.0, "fy": 2162.0, "cx": 319.5, "cy": 239.5},
    "sensor": {"gain_e_per_dn": 72.0, "black_level_dn": 2.0, "read_noise_e": 30.0, "full_well_e": 18400.0},
    "laser": {"plane_in_tool": [1.0, 0.0, 0.0, -36.0], "origin_in_tool_mm": [36.0, 0.0, 140.0]},
}
"""What drawing and data sheets say."""

DRAWN_MM = (94.0, 1.0, 131.5)
"""Where the drawing has the camera in the tool."""

CALIBRATION = """\
# What the folders hold. The board of one table is that of this line unless the table has its own.
board = "chessboard:9x6:4mm"

[laser]
board = "chessboard:8x6:2.5mm"

[hand_eye]
rotation = "kuka"

[delay]
recording = "{delay}"
"""


def main(folder: Path) -> None:
    """Write the files."""
    folder.mkdir(parents=True, exist_ok=True)
    make_boards.main(folder / "camera", replace(make_laser_boards.CAMERA))
    make_laser_boards.main(folder / "laser")
    make_hand_eye.main(folder / "hand_eye")
    stated = tomlkit.parse(EXAMPLE.read_text(encoding="utf-8"))
    sensor = stated["sensor"].unwrap()
    make_flats.main(folder / "sensor", replace(make_flats.SENSOR, **sensor))
    for table, values in WRONG.items():
        for key, value in values.items():
            stated[table][key] = value
    stated["camera"]["pose_in_tool"]["translation_mm"] = list(DRAWN_MM)
    (folder / "recording.toml").write_text(tomlkit.dumps(stated), encoding="utf-8")
    (folder / "calibration.toml").write_text(
        CALIBRATION.format(delay=EXAMPLE.parent.resolve()), encoding="utf-8"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    main(parser.parse_args().folder)
