"""`arctrack bead`: the bead of a finished weld, measured in a profiler's recording."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.inputs import look_at_recordings
from arctrack.cli.json_output import json_text


def bead(
    recording: Annotated[Path, typer.Argument(help="A profiler's recording of the finished weld.")],
    limit: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=LOW:HIGH", help="What is allowed of a measure, such as width_mm=4:8."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for seam.json and bead.html; default: bead/ in the recording.")
    ] = None,
) -> None:
    """Measure a weld's bead in profiles: toes, width, excess metal, undercut, legs and throat, with sigma.

    seam.json holds the result of the seam in the form of OPC 40450-1. The exit code is 0 if all profiles show
    a bead within the limits, 1 if not, 3 if none shows one.
    """
    look_at_recordings([recording], None)
    from arctrack.bead.seam_result import (
        VERDICTS,
        Evaluation,
        bead_page,
        measured_slices,
        read_limits,
        seam_result,
    )
    from arctrack.calibrate.page import render
    from arctrack.cli import console
    from arctrack.cli.exit_codes import NOTHING_TRACKED, WARNED
    from arctrack.output import make_folder, write_whole
    from arctrack.recording import read_recording

    limits = read_limits(limit or [])
    read = read_recording(recording)
    console.warn(read.warnings)
    folder = out or recording / "bead"
    make_folder(folder, ("seam.json", "bead.html"))
    began_s = time.perf_counter()
    with console.progress() as progress:
        slices, profiles = measured_slices(read, console.steps(progress)("measuring", "profiles"))
    result = seam_result(read, slices, limits, time.perf_counter() - began_s)
    write_whole(folder / "seam.json", json_text(result) + "\n")
    write_whole(folder / "bead.html", render(bead_page(result, slices, profiles, limits)))
    shown = sum(not part.bead.problem for part in slices)
    for value in result["ResultContent"]["OverallResultValues"]:
        console.say(
            f"{value['Name']:20} {value['MeasuredValue']:8.3f} ± {value['Sigma']:.3f}, "
            f"{value['Smallest']:.3f} to {value['Largest']:.3f}"
        )
    evaluation = Evaluation(result["ResultMetaData"]["ResultEvaluation"])
    console.say(f"{shown} of {len(slices)} profiles show the bead; {VERDICTS[evaluation][1]}; {folder}")
    if shown == 0:
        raise typer.Exit(NOTHING_TRACKED)
    if shown < len(slices) or evaluation not in (Evaluation.OK, Evaluation.UNDEFINED):
        raise typer.Exit(WARNED)
