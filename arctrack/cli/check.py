"""`arctrack check`: does a recording fit its setup, said before a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from arctrack.cli.inputs import check_replaces_nothing, look_at_recording
from arctrack.cli.json_output import AsJson, say_json
from arctrack.errors import ArctrackError, in_file

if TYPE_CHECKING:
    from arctrack.check.check_recording import CheckResult

PICTURE = "check.png"


def check(
    recording: Annotated[Path, typer.Argument(help="Folder that holds a recording.")],
    out: Annotated[
        Path | None,
        typer.Option(help=f"Where the picture goes; default: results/{PICTURE} in the recording."),
    ] = None,
    setup: Annotated[
        Path | None, typer.Option(help="A recording.toml to use instead of the recording's own.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check by some frames that a recording fits its setup, and name the most likely mistake if not.

    It compares seam and stripe, width, peak, saturation and speckle, black level and noise, the arc's light,
    times and speeds with the stated values. It names a stripe where frames.csv says laser_on = 0, and a
    missing line where it says 1, and explains each key that a warning names. The picture shows the predicted
    stripe over two frames.
    The exit code is 0 without a warning, 1 with one or if few offsets would go out, 3 if none would, 2
    for bad input.
    """
    look_at_recording(recording, setup)
    from arctrack.check.check_picture import draw
    from arctrack.check.check_recording import check_recording
    from arctrack.check.findings import named_keys
    from arctrack.cli import console
    from arctrack.cli.exit_codes import NOTHING_TRACKED, WARNED
    from arctrack.recording import read_recording
    from arctrack.replay.replay import RESULTS_FOLDER

    read = read_recording(recording, setup, must_fit=False)
    picture = out or recording / RESULTS_FOLDER / PICTURE
    check_replaces_nothing(picture, read)
    with console.progress() as bar:
        on_frame = console.track(bar, f"{read.name}: looking at frames", 10)
        checked = check_recording(read, on_frame)
    if not as_json:
        screen = console.tables()
        for finding in checked.findings:
            if finding.text:
                screen.print(f"{finding.name:12} {finding.text}", markup=False, soft_wrap=True)
    warnings = [*read.warnings, *checked.warnings]
    console.warn(warnings)
    keys = named_keys([*warnings, checked.verdict.line, str(checked.hint)])
    try:
        picture.parent.mkdir(parents=True, exist_ok=True)
        draw(checked).savefig(picture, format=picture.suffix[1:] or "png")
    except OSError as error:
        raise in_file(picture, f"cannot be written: {error.strerror or error}") from None
    except ValueError as error:
        raise in_file(picture, f"cannot be written: {error}; give a .png or .pdf with --out") from None
    if as_json:
        say_json("check", {**_content(checked, warnings, picture), "keys": keys})
    else:
        explained = [f"{key}: {text}" for key, text in keys.items()]
        console.say(*explained, f"picture      {picture}", *_verdict_lines(checked))
    if checked.refusal is not None:
        raise checked.refusal
    if checked.bad_frames:
        bad = checked.bad_frames
        raise ArctrackError(f"{bad[0].message}; {len(bad)} of the frames looked at could not be used")
    if checked.verdict.nothing_tracked:
        raise typer.Exit(NOTHING_TRACKED)
    if warnings or checked.verdict.few_tracked:
        raise typer.Exit(WARNED)


def _verdict_lines(checked: CheckResult) -> list[str]:
    name = checked.recording.name
    if checked.refusal is None:
        return [f"{name}: {checked.verdict.line}"]
    return [] if checked.hint is None else [f"{name}: most likely {checked.hint}"]


def _content(checked: CheckResult, warnings: list[str], picture: Path) -> dict[str, Any]:
    verdict = checked.verdict
    return {
        "recording": checked.recording.path,
        "frames": verdict.frames,
        "looked_at": verdict.laser_on,
        "valid": verdict.valid,
        "flags": verdict.flags,
        "verdict": verdict.line,
        "refusal": None if checked.refusal is None else str(checked.refusal),
        "most_likely": None if checked.hint is None else str(checked.hint),
        "findings": [vars(finding) for finding in checked.findings],
        "warnings": warnings,
        "unusable_frames": [bad.message for bad in checked.bad_frames],
        "picture": picture,
    }
