"""`arctrack simulate`: a recording from the forward model."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.inputs import look_at_setup, read_setup
from arctrack.cli.interrupt import interruptible
from arctrack.errors import ArctrackError
from arctrack.output import check_new_folder

if TYPE_CHECKING:
    from noise_model.setup import Setup


class JointName(StrEnum):
    """The joints that a nominal setup is at hand for."""

    V_GROOVE = "v_groove"
    LAP = "lap"
    CORRUGATION = "corrugation"
    BUTT = "butt"
    FILLET = "fillet"
    HALF_V = "half_v"
    U_GROOVE = "u_groove"
    EDGE = "edge"
    OUTSIDE_CORNER = "outside_corner"


class MaterialName(StrEnum):
    """The materials of the paper's Table 1 that do not mirror."""

    MILD_STEEL = "mild_steel"
    ZN_COATED = "zn_coated"


PathOption = Annotated[
    str | None,
    typer.Option(help="circle:RADIUS or corner:RADIUS, mm: a seam that turns to the left, the tool with it."),
]


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder for the recording; must not exist yet.")],
    setup: Annotated[
        Path | None, typer.Option(help="A recording.toml, or a recording, whose nominal setup to use.")
    ] = None,
    joint: Annotated[JointName, typer.Option(help="Without --setup: the joint.")] = JointName.V_GROOVE,
    material: Annotated[
        MaterialName, typer.Option(help="Without --setup: the base metal.")
    ] = MaterialName.MILD_STEEL,
    width: Annotated[int, typer.Option(help="Without --setup: image width, px.", min=32)] = 640,
    height: Annotated[int, typer.Option(help="Without --setup: image height, px.", min=24)] = 480,
    frames: Annotated[
        int, typer.Option(help="How many frames; without --production 12 at least.", min=1)
    ] = 24,
    fps: Annotated[float, typer.Option(help="Frames a second, 0.01 to 1000.")] = 10.0,
    speed_mm_s: Annotated[float, typer.Option(help="Travel speed, 0 to 1000.")] = 8.0,
    seam_wander_mm: Annotated[
        float, typer.Option(help="How far the true seam leaves its nominal line, at most 100.")
    ] = 0.5,
    weave_mm: Annotated[
        float, typer.Option(help="How far the tool weaves to either side, at most 100.")
    ] = 1.5,
    tilt_deg: Annotated[float, typer.Option(help="How far the tool tilts, at most 45.")] = 4.0,
    path: PathOption = None,
    seed: Annotated[int, typer.Option(help="Same seed, same recording.", min=0)] = 0,
    production: Annotated[
        bool,
        typer.Option(
            "--production", help="Laser, and the arc if there is one, on in every frame; else all conditions."
        ),
    ] = False,
    exact: Annotated[
        bool, typer.Option("--exact", help="True values are the nominal ones, else drawn from the tolerance.")
    ] = False,
    video: Annotated[bool, typer.Option("--video", help="Write frames.mkv (FFV1) instead of PNGs.")] = False,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            help="ID.PARAMETER=VALUE: an effect that acts and is not in the setup that is written; repeat."
        ),
    ] = None,
) -> None:
    """Make a recording, with its truth, from arctrack's own forward model: stripe, arc, sensor noise."""
    check_new_folder(out)
    if setup is not None:
        look_at_setup(setup)
    from arctrack.cli import console
    from arctrack.recording.files import UNFINISHED_SUFFIX
    from arctrack.simulation import simulate as engine

    plan = engine.SimulationPlan(
        frames=frames,
        rate_hz=fps,
        travel_speed_mm_s=speed_mm_s,
        seed=seed,
        seam_wander_mm=seam_wander_mm,
        weave_mm=weave_mm,
        tilt_deg=tilt_deg,
        production=production,
        exact=exact,
        video=video,
        path=path,
    )
    stated = None if setup is None else read_setup(setup)
    hidden = _effects(effect or [])
    unfinished = f"what was written stays in {out}{UNFINISHED_SUFFIX}"
    with interruptible(f"{out.name}: simulation", unfinished), console.progress() as bar:
        nominal = _nominal(joint, material, width, height) if stated is None else stated.setup
        engine.simulate_recording(out, nominal, plan, console.track(bar, out.name, frames), hidden, stated)
    console.say(f"{out}: {frames} frames of a {nominal.joint.type} in {nominal.material.name}")


def _nominal(joint: JointName, material: MaterialName, width: int, height: int) -> Setup:
    from arctrack.nominal import nominal_setup
    from arctrack.simulation.simulate import balance

    return balance(nominal_setup(joint.value, material.value, width=width, height=height))


def _effects(texts: list[str]) -> dict[str, dict[str, float]]:
    from noise_model.effects import checked

    stated: dict[str, dict[str, float]] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        effect_id, dot, parameter = name.partition(".")
        try:
            number = float(value)
        except ValueError:
            equals = ""
        if not (equals and dot):
            raise ArctrackError(f"--effect {text}: give ID.PARAMETER=VALUE, such as gamma.gamma=0.8")
        stated.setdefault(effect_id, {})[parameter] = number
    try:
        return checked(stated)
    except ValueError as error:
        raise ArctrackError(f"--effect: {error}") from error
