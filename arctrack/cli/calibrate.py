"""`arctrack calibrate`: parameters of the model from measurements."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.calibrate_boards import camera, hand_eye, laser
from arctrack.cli.calibrate_gauge import gauge, sheet
from arctrack.cli.calibrate_lens import export_lens, filter_curve, import_lens
from arctrack.cli.calibrate_reflectance import reflectance
from arctrack.cli.calibration_output import (
    Out,
    Report,
    calibrate_from_recording,
    check_outputs,
    finish,
    run_calibration,
)
from arctrack.cli.inputs import look_at_recording, look_at_setup, read_setup, setup_path, write_calibrated
from arctrack.cli.interrupt import interruptible
from arctrack.errors import ArctrackError, no_such_path
from arctrack.recording.files import check_folder

if TYPE_CHECKING:
    from arctrack.calibrate.check.check_setup import SetupCheck
    from arctrack.calibrate.check.measure import Measure


def sensor(
    source: Annotated[
        Path, typer.Argument(help="Folder of flat and dark frames, or a recording of a still stripe.")
    ],
    setup: Annotated[
        Path | None,
        typer.Option(help="A recording.toml, or a recording, that it belongs to; default: the recording's."),
    ] = None,
    out: Out = None,
    report: Report = None,
    gamma: Annotated[float | None, typer.Option(help="Hold this gamma in place of fitting it.")] = None,
) -> None:
    """Find gain, read noise, black level, full well, gamma, DSNU and PRNU of a sensor, each with its sigma.

    The folder holds two or more frames of an even, steady light at five or more exposures, and two or more in
    the dark. Names say which is which: flat_2.5ms_1.png, dark_500us/0002.tif; or a table exposures.csv does,
    with file,exposure_ms,lit. What the frames cannot determine is refused, with the frames that are missing.

    Of a recording, twenty or more frames of the laser alone on a part at rest will do. They say gain, read
    noise, black level, and the speckle's contrast and grain, less sharply. Gamma and full well stay as
    stated.
    """
    from arctrack.recording.setup_writer import FILE_NAME

    if not source.is_dir():
        if source.exists():
            raise ArctrackError(f"{source}: is a file; give a folder of frames, or a recording")
        what = "there is no such folder; give a folder of frames, or a recording"
        raise no_such_path(source, what, Path.is_dir)
    is_recording = (source / FILE_NAME).exists()
    if setup is None and not is_recording:
        raise ArctrackError(f"{source}: holds flat and dark frames: give --setup, the setup of their sensor")
    if is_recording and gamma is not None:
        raise ArctrackError("--gamma: a still recording cannot tell it; state it in the setup")
    if gamma is not None and not 0.1 < gamma < 10.0:
        raise ArctrackError(f"--gamma {gamma:g}: a sensor's lies between 0.1 and 10")
    stated = read_setup(source if setup is None else setup)
    from arctrack.calibrate.sensor.flat_frames import find_flat_frames
    from arctrack.calibrate.sensor.stage import sensor_stage
    from arctrack.recording import read_recording

    run_calibration(
        "sensor",
        source,
        lambda steps, warn: sensor_stage(source, stated, steps, warn, gamma),
        setup=stated.path,
        out=out,
        report=report,
        recording=read_recording(source, stated.path, must_fit=False) if is_recording else None,
        images=() if is_recording else [file.path for file in find_flat_frames(source)[0]],
    )


def check(
    setup: Annotated[Path, typer.Argument(help="A recording.toml, or a recording whose setup it is.")],
    recording: Annotated[Path, typer.Argument(help="Folder that holds a recording.")],
    report: Report = None,
) -> None:
    """Check stage by stage that a setup explains a recording, and name what to calibrate anew if not.

    The stages are the sensor, camera with laser and hand-eye, the stripe, and the arc. It prints each
    quantity as measured and as expected, with the sigma of their difference, a verdict and a cure. It
    compares a stripe off its place with an error of each part of the setup. Where the poses do not separate
    these, it names all of them, and a recording that would. The exit code is 0 if the setup explains the
    recording, 1 if not, 2 for bad input.
    """
    look_at_recording(recording, setup)
    from arctrack.calibrate.check.check_setup import check_setup
    from arctrack.calibrate.check.page import render
    from arctrack.cli import console
    from arctrack.cli.exit_codes import WARNED
    from arctrack.output import write_whole
    from arctrack.recording import read_recording, require_images
    from arctrack.replay.replay import RESULTS_FOLDER

    read = read_recording(recording, setup_path(setup), must_fit=False)
    require_images(read.setup, read.setup_path, "arctrack check asks a profiler's recording")
    console.warn(read.warnings)
    page = report or recording / RESULTS_FOLDER / "calibrate_check.html"
    if report is None:
        page.parent.mkdir(parents=True, exist_ok=True)
    check_outputs(None, page, read.setup_path, read)
    with console.progress() as bar:
        checked = check_setup(read, console.track(bar, f"{read.name}: looking at frames", 10))
    _print(checked)
    write_whole(page, render(checked))
    console.say(f"report in {page}")
    console.say(f"{read.name}: {checked.headline}")
    if checked.bad_frames:
        console.warn([f"{checked.bad_frames[0].message}; {len(checked.bad_frames)} of the frames looked at"])
    if checked.not_explained:
        raise typer.Exit(WARNED)


def _print(checked: SetupCheck) -> None:
    from rich.table import Column, Table

    from arctrack.calibrate.check.measure import SetupVerdict
    from arctrack.cli import console

    numbers = (Column(name, justify="right") for name in ("measured", "expected", "1 σ"))
    table = Table("stage", "quantity", *numbers, "", "verdict", box=None, pad_edge=False)
    colours = {SetupVerdict.NOT_EXPLAINED: "red", SetupVerdict.UNTOLD: "yellow", SetupVerdict.OK: "green"}
    stage = None
    for measure in checked.measures:
        first = measure.stage.value if measure.stage is not stage else ""
        stage = measure.stage
        table.add_row(
            first,
            measure.name,
            *measure.shown,
            measure.unit,
            f"[{colours[measure.verdict]}]{measure.verdict.value}[/]",
        )
    screen = console.tables()
    screen.print(table)
    for sentence in (*checked.sentences, *cures(checked.measures)):
        screen.print(sentence, markup=False, soft_wrap=True)


def cures(measures: tuple[Measure, ...]) -> list[str]:
    """Return the cures of quantities that are not explained, a line each."""
    from arctrack.calibrate.check.measure import LightStage, SetupVerdict

    return [
        f"{measure.name}: {measure.cure}"
        for measure in measures
        if measure.verdict is SetupVerdict.NOT_EXPLAINED and measure.stage is not LightStage.PLACE
    ]


def calibrate_all(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder with raw files in sensor, camera, hand_eye, laser, delay, arc; calibration.toml "
            "says the board and the rest."
        ),
    ],
    setup: Annotated[
        Path, typer.Option(help="A recording.toml, or a recording, to start from; `arctrack new` writes one.")
    ],
    out: Out = None,
    report: Report = None,
) -> None:
    """Calibrate all that a folder holds files for, and certify the seam's absolute position.

    Each calibration builds on those before it: sensor, camera, hand-eye, laser, delay, arc. One that is
    refused keeps its stated values; the others are done nevertheless, and the exit code is 2. The certificate
    carries the whole covariance to the seam, in mm, and names the measurement that would improve it most.
    """
    look_at_setup(setup)
    check_folder(folder)
    from arctrack.calibrate.all.all import calibrate_folder
    from arctrack.calibrate.all.certificate_page import certificate_page
    from arctrack.calibrate.all.folder import read_raw_files
    from arctrack.cli import console

    stated = read_setup(setup)
    target = out or stated.path
    page_path = report or target.with_name("calibrate_all.html")
    raw = read_raw_files(folder)
    console.warn(raw.warnings)
    check_outputs(target, page_path, stated.path, images=raw.images)
    with interruptible("the calibration was", "nothing was written"), console.progress() as bar:
        result = calibrate_folder(raw, stated, console.steps(bar), console.warn)
    page = certificate_page(result.certificate, result.unmeasured, result.refused)
    finish(page, page_path, [stage.page for stage in result.stages.values()])
    if result.records:
        write_calibrated(target, stated.path, *result.records)
    if result.refused:
        refused = "; ".join(f"{name}: {why}" for name, why in result.refused.items())
        raise ArctrackError(f"{folder}: not all is calibrated: {refused}")


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
