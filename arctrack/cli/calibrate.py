"""`arctrack calibrate`: parameters of the model from measurements."""

from collections.abc import Callable

import typer

from arctrack.cli.calibrate_all import calibrate_all
from arctrack.cli.calibrate_arc import arc
from arctrack.cli.calibrate_camera import camera
from arctrack.cli.calibrate_check import check
from arctrack.cli.calibrate_delay import delay
from arctrack.cli.calibrate_export import export_lens
from arctrack.cli.calibrate_filter import filter_curve
from arctrack.cli.calibrate_gauge import gauge
from arctrack.cli.calibrate_hand_eye import hand_eye
from arctrack.cli.calibrate_import import import_lens
from arctrack.cli.calibrate_laser import laser
from arctrack.cli.calibrate_reflectance import reflectance
from arctrack.cli.calibrate_sensor import sensor
from arctrack.cli.calibrate_sheet import sheet

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
