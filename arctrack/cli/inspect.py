"""`arctrack inspect`: what a recording holds, in words and one picture."""

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.inputs import check_replaces_nothing, look_at_recording
from arctrack.cli.json_output import AsJson, say_json
from arctrack.errors import ArctrackError, in_file

PICTURE = "inspect.png"


def inspect(
    recording: Annotated[Path, typer.Argument(help="Folder that holds a recording.")],
    out: Annotated[
        Path | None,
        typer.Option(help=f"Where the picture goes; default: results/{PICTURE} in the recording."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List a recording's content, and draw it: sensor, joint, conditions, poses, unknown keys.

    The picture shows one frame of each condition, with the stripe where the nominal setup expects it,
    and the robot's path.
    """
    look_at_recording(recording)
    from arctrack.check.survey import draw, survey
    from arctrack.cli import console
    from arctrack.cli.inspect_text import print_survey, survey_json
    from arctrack.output import make_folder, writing
    from arctrack.recording import read_recording
    from arctrack.replay.replay import RESULTS_FOLDER

    read = read_recording(recording)
    console.warn(read.warnings)
    picture = out or recording / RESULTS_FOLDER / PICTURE
    check_replaces_nothing(picture, read)
    with console.progress() as bar:
        result = survey(read, console.track(bar, read.name, len(read.rows)))
        figure = draw(read, result)
    if not as_json:
        print_survey(console.tables(), read, result)
    make_folder(picture.parent, ())
    try:
        with writing(picture):
            figure.savefig(picture, format=picture.suffix[1:] or "png")
    except ValueError as error:
        raise in_file(picture, f"cannot be written: {error}; give a .png or .pdf with --out") from None
    if as_json:
        say_json("inspect", {**survey_json(read, result), "picture": picture})
    else:
        console.say(f"picture  {picture}")
    if result.bad_frames:
        raise ArctrackError(
            f"{result.bad_frames[0].message}; "
            f"{len(result.bad_frames)} of {len(read.rows)} frames could not be used"
        )
