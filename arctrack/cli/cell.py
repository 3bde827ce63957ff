"""`arctrack cell`: a robot, a tracker and a bus on one machine."""

from __future__ import annotations

import math
from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.simulate import JointName, MaterialName, PathOption
from arctrack.errors import ArctrackError
from arctrack.system import require_live

if TYPE_CHECKING:
    from arctrack.simulation.cell.weld.closed_loop import ClosedLoopResult, EventResult, LoopPlan
    from robot_io.clocks.lag import Lag


SERVED_BUS = "udp_multicast:239.74.163.2"
"""Bus of a live cell: other processes of the machine, or of its network, receive it."""


LIVE_MM = 10_000.0
"""Length of a live robot's path: a quarter of an hour."""


class EventName(StrEnum):
    """An event of a simulated run."""

    IGNITION = "ignition"
    ARC_TOLD_LATE = "arc_told_late"
    ARC_FAULT = "arc_fault"
    TACK = "tack"
    LONG_TACK = "long_tack"
    OUT_OF_VIEW = "out_of_view"
    SLIP = "slip"


cell = typer.Typer(name="cell", help="Run a simulated cell.", no_args_is_help=True)


@cell.callback(epilog="Example: arctrack cell run /tmp/cell-run --joint lap")
def _cell() -> None:
    """Run a simulated cell: robot, tracker and bus behind one clock."""


@cell.command(epilog="Example: arctrack cell run cell-run --joint corrugation --displaced-mm -3")
def run(
    out: Annotated[Path, typer.Argument(help="Folder for run.csv and run.png.")],
    joint: Annotated[JointName, typer.Option(help="The joint.")] = JointName.CORRUGATION,
    material: Annotated[MaterialName, typer.Option(help="The base metal.")] = MaterialName.MILD_STEEL,
    displaced_mm: Annotated[
        float, typer.Option(help="How far the true seam lies to the left of the nominal one.", min=-8, max=8)
    ] = 3.0,
    slope: Annotated[
        float, typer.Option(help="How the true seam leaves the nominal one, mm per mm.", min=-0.2, max=0.2)
    ] = 0.0,
    bend_mm: Annotated[float, typer.Option(help="A bend on top, over 120 mm.", min=0, max=5)] = 0.0,
    path: PathOption = None,
    length_mm: Annotated[float, typer.Option(help="How far the torch goes.", min=1, max=1000)] = 120.0,
    speed_mm_s: Annotated[float, typer.Option(help="Travel speed.", min=1, max=50)] = 10.0,
    weave_mm: Annotated[
        float, typer.Option(help="How far the tool weaves to either side.", min=0, max=5)
    ] = 1.5,
    fps: Annotated[float, typer.Option(help="Frames a second.", min=5, max=50)] = 25.0,
    seed: Annotated[int, typer.Option(help="Same seed, same run.", min=0)] = 1,
    event: Annotated[EventName | None, typer.Option(help="What happens on the way.")] = None,
    at_once: Annotated[
        bool, typer.Option("--at-once", help="Send the offset of where the torch is, as if it acted at once.")
    ] = False,
    profiles: Annotated[
        bool, typer.Option("--profiles", help="A laser profiler takes the camera's place.")
    ] = False,
    off_nominal: Annotated[
        bool, typer.Option("--off-nominal", help="True values are drawn from the setup's tolerance.")
    ] = False,
) -> None:
    """Weld in a simulated cell: a rendered camera, the tracker, the bus, and a robot that follows.

    Time is simulated: a run takes as long as its frames take to render. It prints the torch's distance from
    the seam, and the count of each kind of offset.
    """
    from arctrack.cli import console
    from arctrack.output import make_folder
    from arctrack.simulation.cell.weld.closed_loop import ClosedLoop, LoopPlan
    from arctrack.simulation.cell_run_files import RUN_CSV, RUN_PICTURE, draw_run, write_run

    if profiles and event is not None and event.value.endswith("tack"):
        raise ArctrackError(f"--event {event.value}: a tack is drawn on images alone; leave --profiles out")
    plan = LoopPlan(
        joint=joint.value,
        material=material.value,
        displaced_mm=displaced_mm,
        slope=slope,
        bend_mm=bend_mm,
        length_mm=length_mm,
        speed_mm_s=speed_mm_s,
        weave_mm=weave_mm,
        rate_hz=fps,
        seed=seed,
        looks_ahead=not at_once,
        event=None if event is None else event.value,
        exact=not off_nominal,
        path=path,
        profiles=profiles,
    )
    make_folder(out, (RUN_CSV, RUN_PICTURE))
    with console.progress() as bar:
        loop = ClosedLoop(plan)
        result = loop.run(console.track(bar, plan.joint, round(loop.duration_s * fps)))
        write_run(out / RUN_CSV, loop.frames)
        draw_run(out / RUN_PICTURE, loop, result)
    happened = loop.event_result()
    lines = _lines(plan, result) if happened is None else event_lines(happened)
    console.say(*lines, f"{out / RUN_CSV}, {out / RUN_PICTURE}")


@cell.command(
    epilog="Example: arctrack cell serve --bus udp_multicast:239.74.163.2 --frames cell --seconds 60"
)
def serve(
    bus: Annotated[str, typer.Option(help="python-can's interface and channel.")] = SERVED_BUS,
    frames: Annotated[str, typer.Option(help="Name under which frames are published.")] = "cell",
    joint: Annotated[JointName, typer.Option(help="The joint.")] = JointName.LAP,
    displaced_mm: Annotated[
        float, typer.Option(help="How far the true seam lies to the left of the nominal one.", min=-8, max=8)
    ] = 3.0,
    fps: Annotated[
        float,
        typer.Option(help="Frames a second; what cannot be rendered in time is left out.", min=1, max=50),
    ] = 10.0,
    seconds: Annotated[
        float | None, typer.Option(help="How long; without it until Ctrl-C or SIGTERM.", min=0)
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the images' noise.", min=0)] = 1,
    profiles: Annotated[
        bool, typer.Option("--profiles", help="A laser profiler takes the camera's place.")
    ] = False,
    write_cell: Annotated[
        Path | None,
        typer.Option(
            help="New folder for the cell file and the setup of this cell: arctrack serve takes it."
        ),
    ] = None,
) -> None:
    """Run a simulated robot on a real bus in real time, and its rendered camera into shared memory.

    Another process tracks, such as arctrack serve: it reads frames by their name, and poses off the bus. The
    robot commands nothing before a tracker's heartbeat.
    """
    require_live("cell serve")
    from arctrack.cli import console
    from arctrack.cli.interrupt import interruptible
    from arctrack.live.serve.simulated import write_simulated_cell
    from arctrack.live.simulated_cell import REAL_TIME_PX, serve_cell
    from arctrack.replay.replay import parse_bus
    from arctrack.simulation.cell.weld.closed_loop import LoopPlan

    interface, channel = parse_bus(bus)
    plan = LoopPlan(
        joint=joint.value,
        displaced_mm=displaced_mm,
        length_mm=LIVE_MM,
        rate_hz=fps,
        seed=seed,
        size_px=REAL_TIME_PX,
        profiles=profiles,
    )
    if write_cell is not None:
        console.say(f"{write_simulated_cell(write_cell, plan, interface, channel, frames)}")
    with interruptible("the cell was", "frames and robot are gone"), ExitStack() as waiting:
        waiting.enter_context(console.progress()).get_ready("robot and camera")

        def on_ready() -> None:
            waiting.close()
            console.say(f"robot on {bus}, frames as {frames!r}; Ctrl-C ends it")

        serve_cell(
            plan, interface, channel, frames, lambda robot: seconds is None or robot.now_s < seconds, on_ready
        )


def _lines(plan: LoopPlan, result: ClosedLoopResult) -> list[str]:
    reasons = ", ".join(f"{name} {count}" for name, count in sorted(result.reasons.items()))
    valid = f"{result.offsets}; not as measured: {reasons or 'none'}"
    if math.isinf(result.lock_s):
        return ["the torch never locked onto the seam", valid]
    return [
        f"locked after {result.lock_s:.2f} s; from then on the torch is off the seam by",
        f"  {result.rms_mm:.3f} mm RMS (across {result.rms_y_mm:.3f}, height {result.rms_z_mm:.3f}), "
        f"{result.max_mm:.3f} mm at most",
        valid,
        _lag_line(result.lag),
        f"weave: {result.weave_mm:.3f} mm to either side, {plan.weave_mm:g} mm programmed",
    ]


def event_lines(happened: EventResult) -> list[str]:
    """Return an event's outcome in words."""
    validities = ", ".join(f"{name} {count}" for name, count in sorted(happened.validities.items()))
    reasons = ", ".join(f"{name} {count}" for name, count in sorted(happened.reasons.items()))
    again = "never VALID again"
    if math.isfinite(happened.valid_again_s):
        again = f"VALID again {happened.valid_again_s:.2f} s after its end"
    return [
        f"{happened.name}, {happened.begin_s:.2f} to {happened.end_s:.2f} s",
        f"offsets meanwhile: {validities}; the tracker says {reasons or 'nothing'}; {again}",
        f"from its begin on the torch is off the seam by {happened.torch_off_mm:.3f} mm at most",
    ]


def _lag_line(lag: Lag) -> str:
    if lag.unestimated is not None:
        return f"lag from capture to motion: unestimated, {lag.unestimated.value}"
    return f"lag from capture to motion: {lag.lag_s:.3f} s, 1 sigma {lag.sigma_s:.3f} s"
