"""`arctrack explain`: one page for one frame of a recording."""

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.inputs import check_replaces_nothing, look_at_recording
from arctrack.cli.options import ArcMap


def explain(
    recording: Annotated[Path, typer.Argument(help="Folder that holds a recording.")],
    frame: Annotated[int, typer.Argument(help="Number of the frame, as in frames.csv.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Where the page goes; default: results/explain_NNNNNN.html in the recording."),
    ] = None,
    setup: Annotated[
        Path | None, typer.Option(help="A recording.toml to use instead of the recording's own.")
    ] = None,
    arc_map: ArcMap = True,
    section: Annotated[
        bool,
        typer.Option(
            "--section", help="Print the profile as [joint] section_mm of a free joint, and write no page."
        ),
    ] = False,
) -> None:
    """Explain one frame's seam, or why it has none: image, arc map, stripe, sigmas, profile, joint, history.

    The frames before it are replayed first: the tracker's state is that of the run.
    """
    look_at_recording(recording, setup)
    from arctrack.cli import console
    from arctrack.compiling import compiled_by_two
    from arctrack.output import make_folder, write_whole
    from arctrack.recording import read_recording
    from arctrack.replay import explain as engine
    from arctrack.replay.explain import taught_section
    from arctrack.replay.explain_pages import words
    from arctrack.replay.explain_pages.page import page
    from arctrack.replay.replay import RESULTS_FOLDER

    read = read_recording(recording, setup)
    console.warn(read.warnings)
    path = out or recording / RESULTS_FOLDER / f"explain_{frame:06d}.html"
    if not section:
        check_replaces_nothing(path, read)
    with console.progress() as bar, compiled_by_two(read.setup):
        on_frame = console.track(bar, read.name, engine.position_of(read, frame) + 1)
        explanation = engine.explain(read, frame, arc_map, on_frame)
    if section:
        typer.echo(taught_section(explanation))
        return
    make_folder(path.parent, ())
    write_whole(path, page(explanation))
    typer.echo(words.headline(explanation))
    typer.echo(words.offset_sentence(explanation))
    for check in words.by_severity(explanation.track.checks):
        if not check.passed:
            answer = f"{check.question.words}: {words.value_text(check)}"
            if check.question.demand != "yes":
                answer += f", demanded {words.limit_text(check)}"
            typer.echo(f"  {check.flag.name}: {check.flag.meaning} ({answer})")
    for sentence in (words.arc_sentence(explanation), f"page  {path}"):
        if sentence:
            console.say(sentence)
