"""`arctrack serve`: frames of a camera and poses off the bus in, offsets onto the bus, until it is ended."""

from __future__ import annotations

import math
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.cell import LIVE_MM
from arctrack.cli.exit_codes import NOTHING_TRACKED
from arctrack.cli.inputs import look_at_cell
from arctrack.cli.interrupt import interruptible, stoppable
from arctrack.end_signals import ENDING, SAVING
from arctrack.errors import ArctrackError
from arctrack.system import require_live

if TYPE_CHECKING:
    from arctrack.control.cell_file import CellFile
    from arctrack.live.serve.loop import LoopResult, OnTrack


def serve(
    cell: Annotated[Path | None, typer.Argument(help="The cell file, cell.toml.")] = None,
    simulated: Annotated[
        bool,
        typer.Option("--simulated", help="Start a simulated robot and its camera beside it; no cell file."),
    ] = False,
    job: Annotated[
        int | None, typer.Option(help="Which of the jobs a recording's seam is; a robot names its own.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(help="How long; without it until Ctrl-C or SIGTERM.", min=0)
    ] = None,
) -> None:
    """Track live: frames of the cell's camera and poses off its bus in, offsets onto the bus.

    It says ready once all is compiled, loaded and open, and at which address a browser shows the run. Ctrl-C,
    SIGTERM or a terminal that is closed ends it: the last offset is REFUSED, the laser goes off, it prints
    what the run came to. SIGUSR1 and a terminal that is closed save the black box. A recording as camera is
    played at its own pace.

    The exit code is 3 where no VALID offset went out, where no frame of a recording is valid, and where the
    torch of a simulated cell was not on the seam.
    """
    require_live("serve")
    if simulated == (cell is not None):
        raise ArctrackError("serve: give a cell file, or --simulated")
    if cell is not None:
        look_at_cell(cell)
    from arctrack.control.cell_file import read_cell_file

    if cell is None:
        is_tracked = _serve_simulated(job, seconds)
    else:
        read = read_cell_file(cell)
        result = serve_cell_file(read, job, seconds)
        is_tracked = bool(result.valid if read.camera.kind == "recording" else result.offsets.get("VALID"))
    if not is_tracked:
        raise typer.Exit(NOTHING_TRACKED)


def serve_cell_file(
    cell: CellFile,
    job: int | None = None,
    seconds: float | None = None,
    on_track: OnTrack | None = None,
    is_simulated: bool = False,
    **bus_options: int,
) -> LoopResult:
    """Run a cell live, say when it is ready and what it came to, and return that."""
    from arctrack.cli import console
    from arctrack.cli.lines import LineQueue
    from arctrack.live.serve.live_run import LiveRun, opened_run, run
    from arctrack.live.serve.notify import Notifier
    from arctrack.live.serve.process import schedule

    console.warn(cell.setup.warnings)
    notifier = Notifier()
    # None where the process was started without; -1 is no file.
    warnings = LineQueue(-1 if sys.__stderr__ is None else sys.__stderr__.fileno())
    with ExitStack() as opened:
        # Before the loop gets its priority and its processors, which a thread would inherit.
        opened.enter_context(warnings.started())
        opened.callback(notifier.close)
        with interruptible("serve was", "nothing was sent"), console.progress():
            live: LiveRun = opened.enter_context(
                opened_run(
                    cell,
                    lambda line: warnings.put(console.warning_line(line)),
                    job,
                    on_track,
                    is_simulated,
                    **bus_options,
                )
            )
            done, refused = schedule(cell.process)
        with stoppable(*SAVING) as came:
            journal = live.journal
            console.warn([*refused, *(() if journal is None else journal.warnings)])
            page = [] if journal is None or journal.page is None else [f"page: {journal.page}"]
            port = f", port {bus_options['port']}" if "port" in bus_options else ""
            ready = f"ready: {cell.camera.kind} {cell.camera.name}, bus {cell.bus}{port}"
            console.say(*done, *page, f"{ready}; Ctrl-C ends it")
            notifier.ready(ready)
            black_box = None if journal is None else journal.black_box
            ends_s = math.inf if seconds is None else time.monotonic() + seconds

            has_warned = False

            def goes_on() -> bool:
                nonlocal has_warned
                signals = came()
                if not has_warned and live.loop.warning is not None:
                    has_warned = True
                    warnings.put(console.warning_line(live.loop.warning))
                for number in signals & SAVING.keys():
                    if black_box is not None:
                        black_box.save(SAVING[number])
                return signals.isdisjoint(ENDING) and time.monotonic() < ends_s

            result = run(live.loop, goes_on, cell.policy.watchdog_s, notifier)
            notifier.stopping()
            # Time-out of the black box's answer after a run.
            saved = [] if black_box is None else black_box.answers(60.0)
    console.say(*saved, *_result_lines(result))
    return result


def _serve_simulated(job: int | None, seconds: float | None) -> bool:
    """Run a simulated cell with the live run, and print and return whether its torch was on the seam."""
    from arctrack.cli import console

    with interruptible("serve was", "nothing was sent"), ExitStack() as opened:
        with console.progress() as bar:
            from arctrack.compiling import compiled_by_two
            from arctrack.control.cell_file import read_cell_file
            from arctrack.live.serve import simulated
            from arctrack.live.simulated_cell import REAL_TIME_PX
            from arctrack.simulation.cell.cell import TORCH_MM
            from arctrack.simulation.cell.weld.closed_loop import LoopPlan
            from tracker.tracker import Tracker

            plan = LoopPlan(joint="lap", length_mm=LIVE_MM, rate_hz=10.0, size_px=REAL_TIME_PX)
            frames = f"simulated-{os.getpid()}"
            lock = simulated.Lock(plan)
            cell = simulated.write_simulated_cell(
                Path(opened.enter_context(tempfile.TemporaryDirectory())) / "cell",
                plan,
                simulated.INTERFACE,
                simulated.GROUP,
                frames,
                Path.cwd() / "black_box",
            )
            read = read_cell_file(cell)

            def warm_up() -> None:
                # Robot and camera compile as much.
                for each in read.jobs.values():
                    setup = each.setup_for(read.setup.setup)
                    with compiled_by_two(setup):
                        Tracker(setup, correction=each.correction).warm_up()
                bar.get_ready("simulated cell")

            robot = opened.enter_context(simulated.SimulatedCell(plan, frames, warm_up))
        console.say(f"bus messages: {robot.listening}")
        result = serve_cell_file(read, job, seconds, lock.on_track, True, **robot.bus_options)
        samples = robot.stop()
    error = simulated.torch_error(samples, lock.at_s, result.ended_s)
    if error is None:
        console.say("torch: never locked onto the seam")
        return False
    console.say(
        f"torch: off the seam by {error.rms_mm:.3f} mm RMS, {error.max_mm:.3f} mm at most, "
        f"over {error.watched_s:.1f} s from the lock on"
        + ("" if error.is_on_seam else f"; it may be off by {TORCH_MM:g} mm")
    )
    return error.is_on_seam


def _result_lines(result: LoopResult) -> list[str]:
    from arctrack.offset_count import OffsetCount

    offsets = ", ".join(f"{name} {count}" for name, count in result.offsets.items()) or "none"
    reasons = ", ".join(f"{name} {count}" for name, count in result.reasons.items()) or "none"
    dark = f", without the laser {result.dark}" if result.dark else ""
    busy = (
        [
            f"this machine was too busy: {result.delayed} offsets were late or refused for it; the tracker "
            f"waited for a processor {result.waited_s:.1f} s, and had one {result.ran_s:.1f} s; "
            "end what else runs here"
        ]
        if result.delayed
        else []
    )
    return [
        str(OffsetCount.of(result.offsets.get("VALID", 0), result.frames, result.reasons)),
        f"frames: {result.frames}, dropped {result.dropped}, tracks valid {result.valid}{dark}",
        f"offsets: {offsets}; not as measured: {reasons}",
        f"mid-exposure to send: {result.capture_to_send}",
        f"arrival to send: {result.arrival_to_send}",
        *busy,
    ]
