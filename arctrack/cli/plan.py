"""`arctrack plan`: where to put camera and laser, and where along the path the noise will blind them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from arctrack.cli.inputs import look_at_setup, read_setup
from arctrack.cli.json_output import AsJson, say_json
from arctrack.errors import ArctrackError, in_file

if TYPE_CHECKING:
    from noise_model.compiled.arrays import Float64
    from noise_model.plan.plan import Plan, PlanOptions
    from noise_model.setup import Setup
    from sim_to_real.decision.setup_cost import SetupCost


Pair = tuple[float, float]


def plan(
    source: Annotated[Path, typer.Argument(help="A recording, or a folder or file with a recording.toml.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for tables and pictures; default: plan/ beside the recording.toml."),
    ] = None,
    recorded: Annotated[
        bool, typer.Option("--recorded", help="Follow the recording's own poses, not the nominal seam.")
    ] = False,
    tilt: Annotated[Pair, typer.Option(help="Tilts of the camera to try, deg: least and most.")] = (
        10.0,
        60.0,
    ),
    azimuth: Annotated[
        Pair | None,
        typer.Option(
            help="Azimuths to try, deg, 0 ahead of the stripe; default: all, one side if both look alike."
        ),
    ] = None,
    preview: Annotated[Pair, typer.Option(help="Torch to stripe, mm: least and most.")] = (20.0, 50.0),
    stand_off: Annotated[Pair, typer.Option(help="Camera to plate, mm: least and most.")] = (100.0, 250.0),
    filter_nm: Annotated[
        list[float] | None, typer.Option(help="A filter's width to try, nm; repeat it. Default: 5, 10, 20.")
    ] = None,
    exposure_ms: Annotated[
        float | None, typer.Option(help="The longest exposure to try; default: twice the setup's.")
    ] = None,
    lean: Annotated[
        float, typer.Option(help="How far the torch may lean where the sensor is blind, deg.")
    ] = 10.0,
    torch_radius: Annotated[
        float, typer.Option(help="The torch's radius, mm, that the camera must look past; 0 for none.")
    ] = 12.5,
    limit: Annotated[
        float | None,
        typer.Option(
            help="A larger 1 sigma of the seam, mm, is blind; default: half of \\[tolerance] seam_mm."
        ),
    ] = None,
    speckle: Annotated[
        float, typer.Option(help="Speckle contrast of the laser, 0 to 1; 0 leaves the speckle floor out.")
    ] = 1.0,
    as_json: AsJson = False,
) -> None:
    """Search sensor designs for the least expected error of the seam; list blind stretches of the path.

    The error is the Cramer-Rao bound under the predicted noise of stripe and arc, with the speckle floor.
    """
    look_at_setup(source)
    from arctrack.cli import console
    from arctrack.cli.plan_text import print_costs, print_plan
    from arctrack.plan.effect_costs import cost_content
    from noise_model.plan.noise import Surroundings
    from noise_model.plan.plan import PlanOptions

    if exposure_ms is not None and not 0.0 < exposure_ms < math.inf:
        raise ArctrackError(f"--exposure-ms {exposure_ms:g}: must be > 0 and finite")
    setup, run = _read(source, recorded)
    try:
        options = PlanOptions(
            tilt_deg=tilt,
            azimuth_deg=azimuth,
            preview_mm=preview,
            stand_off_mm=stand_off,
            filters_nm=tuple(filter_nm or PlanOptions.filters_nm),
            max_exposure_s=None if exposure_ms is None else 1e-3 * exposure_ms,
            lean_deg=lean,
            torch_radius_mm=torch_radius,
            limit_mm=limit,
            around=Surroundings(speckle_contrast=speckle),
        )
    except ValueError as error:
        raise ArctrackError(str(error)) from None
    made, costs = _plan(source, setup, options, run)
    if not as_json:
        print_plan(console.tables(), made)
        print_costs(console.tables(), costs)
    folder = out or (source if source.is_dir() else source.parent) / "plan"
    _write(made, costs, torch_radius, folder)
    if as_json:
        say_json("plan", {"source": source, **_content(made), "costs": cost_content(costs), "folder": folder})
    else:
        console.say(f"tables and pictures in {folder}")


def _content(made: Plan) -> dict[str, Any]:
    from arctrack.plan.plan_files import designs, stations

    return {
        "limit_mm": made.limit_mm,
        "designs": designs(made),
        "stations": stations(made),
        "rules": {
            name: {
                "light": rule.light.value,
                "light_ratio": rule.light_ratio,
                "seam": rule.seam.value,
                "seam_ratio": rule.seam_ratio,
                "kept_deg": rule.kept_deg,
                "broken_deg": rule.broken_deg,
                "best_deg": rule.best_deg,
            }
            for name, rule in (
                ("tilt", made.rules.tilt),
                ("head", made.rules.head),
                ("azimuth", made.rules.azimuth),
            )
        },
        "left_out": made.left_out,
    }


COUNTED = {
    "designs": "designs",
    "refinement": "designs",
    "map": "tilts",
    "path": "stations",
    "blind stretches": "stretches",
    "costs": "effects",
}
"""Units counted in each stage of a plan."""


class RecordedRun(NamedTuple):
    """Poses of a recording, the tool's pose by time, and the times, s, of its frames."""

    T_base_tool: list[Float64]
    pose_at: Callable[[float], Float64]
    times_s: list[float]


def _read(source: Path, recorded: bool) -> tuple[Setup, RecordedRun | None]:
    from arctrack.cli import console
    from arctrack.recording import pose_at, read_recording, require_images

    instead = "a profiler's place is its [camera.pose_in_tool]: arctrack simulate shows what it sees there"
    if recorded:
        read = read_recording(source)
        require_images(read.setup, read.setup_path, instead)
        console.warn(read.warnings)
        buffer, known_s = read.pose_buffer(), read.poses.timestamps_s

        def within(time_s: float) -> Float64:
            pose = pose_at(buffer, min(max(time_s, float(known_s[0])), float(known_s[-1])))
            assert pose is not None
            return pose.T_base_tool

        return read.setup, RecordedRun(
            list(read.poses.T_base_tool), within, [row.timestamp_s for row in read.rows]
        )
    stated = read_setup(source)
    require_images(stated.setup, stated.path, instead)
    return stated.setup, None


def _plan(
    source: Path, setup: Setup, options: PlanOptions, run: RecordedRun | None
) -> tuple[Plan, tuple[SetupCost, ...]]:
    from arctrack.cli import console
    from arctrack.plan.effect_costs import plan_costs
    from noise_model.plan.plan import make_plan

    with console.progress() as bar:
        tasks = {}

        def tell(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total, unit=COUNTED[stage])
            bar.update(tasks[stage], completed=done)

        try:
            made = make_plan(setup, options, None if run is None else run.T_base_tool, tell)
            timed = None if run is None else (run.pose_at, run.times_s)
            return made, plan_costs(made, timed, lambda done, total: tell("costs", done, total))
        except ValueError as error:
            raise in_file(source, str(error)) from None


def _write(made: Plan, costs: Sequence[SetupCost], torch_radius_mm: float, out: Path) -> None:
    from arctrack.plan.effect_costs import write_costs
    from arctrack.plan.plan_files import PATH_PICTURE, PLAN_PICTURE, draw_designs, draw_path, write_tables

    write_tables(made, out)
    write_costs(costs, out)
    pictures = {PLAN_PICTURE: draw_designs(made, torch_radius_mm), PATH_PICTURE: draw_path(made)}
    for name, figure in pictures.items():
        try:
            figure.savefig(out / name)
        except OSError as error:
            raise in_file(out / name, f"cannot be written: {error.strerror}") from None
