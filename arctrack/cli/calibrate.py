"""`arctrack calibrate`: parameters of the model from measurements."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibrate_all import calibrate_all
from arctrack.cli.calibrate_camera import camera
from arctrack.cli.calibrate_check import check
from arctrack.cli.calibrate_filter import filter_curve
from arctrack.cli.calibrate_gauge import gauge
from arctrack.cli.calibrate_hand_eye import hand_eye
from arctrack.cli.calibrate_laser import laser
from arctrack.cli.calibrate_lens import export_lens, import_lens
from arctrack.cli.calibrate_reflectance import reflectance
from arctrack.cli.calibrate_sensor import sensor
from arctrack.cli.calibrate_sheet import sheet
from arctrack.cli.calibration_output import Out, Report, calibrate_from_recording
from arctrack.cli.inputs import look_at_recording


def delay(
    recording: Annotated[Path, typer.Argument(help="A recording whose tool weaves or rises as it travels.")],
    out: Out = None,
    report: Report = None,
) -> None:
    """Find the delay between poses and frames, with its sigma: the seam stands still, whatever the tool does.

    With a wrong delay the tool's own weave shows in the seam. The likelihood of a smooth seam is largest at
    the right one. It goes into the effect pose_delay of the setup. Where the motion is too weak, the answer
    is 'unestimated': the page names the missing motion, no setup is written, and the exit code is 2.
    """
    look_at_recording(recording)
    from arctrack.calibrate.delay.stage import delay_stage

    calibrate_from_recording("delay", delay_stage, recording, out, report)


def arc(
    recording: Annotated[
        Path, typer.Argument(help="A recording with frames of the arc alone, at several poses.")
    ],
    out: Out = None,
    report: Report = None,
) -> None:
    """Find the arc's radius, place and brightness, and the metal's reflectance, from frames of the arc alone.

    It compares frames with the arc on and the laser off with the arc map. A value that they do not determine
    keeps its stated one, and the page names the frames that would determine it. The values go into [arc] and
    [material] of the setup, with their covariance.
    """
    look_at_recording(recording)
    from arctrack.calibrate.arc.stage import arc_stage

    calibrate_from_recording("arc", arc_stage, recording, out, report)


REFLECTANCE_EXAMPLE = "examples/goniometer_mild_steel.csv --gamma 0.45 --black 10 --out /tmp/steel"
COMMANDS: dict[str, tuple[Callable[..., None], str]] = {
    "camera": (
        camera,
        "/tmp/boards --board chessboard:9x6:4mm --setup examples/v_groove --out /tmp/camera.toml",
    ),
    "filter": (filter_curve, "examples/filter_690_10.csv --setup examples/v_groove --out /tmp/filtered.toml"),
    "hand-eye": (
        hand_eye,
        "/tmp/hand_eye --board chessboard:9x6:4mm --poses /tmp/hand_eye/poses.csv --rotation kuka "
        "--setup examples/v_groove --out /tmp/hand_eye.toml\n"
        "examples/v_groove --out /tmp/found.toml",
    ),
    "laser": (
        laser,
        "/tmp/pairs --board chessboard:8x6:2.5mm --setup examples/v_groove --out /tmp/laser.toml",
    ),
    "gauge": (
        gauge,
        "/tmp/gauge --gauge v:90deg:5mm --poses /tmp/gauge/poses.csv --setup examples/v_groove "
        "--out /tmp/gauge.toml\n"
        "/tmp/gauge/gauge_00.png --gauge v:90deg:5mm --setup examples/v_groove --check "
        "--report /tmp/gauge.html",
    ),
    "sheet": (
        sheet,
        "/tmp/plate --out /tmp/sheet.toml\n"
        "/tmp/plate_low /tmp/plate_high --setup examples/v_groove --out /tmp/sheet.toml",
    ),
    "sensor": (sensor, "/tmp/flats --setup examples/v_groove --out /tmp/sensor.toml"),
    "delay": (delay, "examples/v_groove --out /tmp/in_time.toml"),
    "all": (calibrate_all, "/tmp/afternoon --setup examples/v_groove --out /tmp/calibrated.toml"),
    "check": (check, "examples/v_groove/recording.toml examples/v_groove"),
    "arc": (arc, "/tmp/straight --out /tmp/arc.toml"),
    "reflectance": (reflectance, REFLECTANCE_EXAMPLE),
    "export": (export_lens, "examples/v_groove --format ros --out /tmp/camera.yaml"),
    "import": (import_lens, "/tmp/camera.yaml --setup examples/v_groove --out /tmp/imported.toml"),
}
"""The function of each command, and the arguments of its examples, a line each."""

calibrate = typer.Typer(
    name="calibrate", help="Find parameters of the model from measurements.", no_args_is_help=True
)
for name, (command, examples) in COMMANDS.items():
    lines = (f"Example: arctrack calibrate {name} {words}" for words in examples.splitlines())
    calibrate.command(name, epilog="\n\n".join(lines))(command)


@calibrate.callback(epilog=f"Example: arctrack calibrate reflectance {REFLECTANCE_EXAMPLE}")
def _calibrate() -> None:
    """Find parameters of the model from measurements."""
