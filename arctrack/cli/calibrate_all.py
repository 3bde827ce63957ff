"""`arctrack calibrate all`: from a folder of raw files to one setup, one report and one certificate."""

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import Out, Report, check_outputs, finish
from arctrack.cli.inputs import look_at_setup, read_setup, write_calibrated
from arctrack.cli.interrupt import interruptible
from arctrack.errors import ArctrackError
from arctrack.recording.files import check_folder


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
