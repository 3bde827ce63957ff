"""`arctrack calibrate delay`: how late the poses' clock is, from a moving recording."""

from pathlib import Path
from typing import Annotated

import typer

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
