"""Journal of a live run, and the processes that read it: black box, watch and page."""

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from arctrack.control.cell_file import CellFile
from arctrack.control.cell_file.job_setup import job_setup_text
from arctrack.errors import ArctrackError, in_file
from arctrack.live.black_box.client import BlackBoxClient
from arctrack.live.black_box.recorder import END, JobSetup, RecorderOptions, run_recorder
from arctrack.live.journal.journal import Journal, slots_for
from arctrack.live.journal.message_pipe import PipeEnd, message_pipe
from arctrack.live.journal.ring import RingError, remove_dead_rings
from arctrack.live.monitor.options import McapOptions, MonitorOptions, options_of
from arctrack.live.serve.journal_writer import JournalWriter
from arctrack.live.serve.supervisor import SupervisedProcess, Supervisor
from arctrack.live.watch.process import WatchOptions, run_watch
from noise_model.setup import Setup

PAGE_NICENESS, BLACK_BOX_NICENESS, WATCH_NICENESS = 10, 10, 15
"""Niceness of each below the loop and the frames' publisher: what a person waits for goes first."""


@dataclass(frozen=True)
class JournalProcesses:
    """Writer and readers of a run's journal.

    `black_box` is None where there is none, `page` is the monitor's address, `warnings` name what is missing,
    one line each.
    """

    writer: JournalWriter
    black_box: BlackBoxClient | None
    page: str | None
    warnings: tuple[str, ...]


@contextmanager
def open_journal(
    cell: CellFile, setups: Mapping[int, Setup], supervisor: Supervisor, is_simulated: bool = False
) -> Iterator[JournalProcesses | None]:
    """Keep a run's journal, with the processes that a cell file requires; yields None without readers.

    `setups` are by job number; `supervisor` restarts processes that end. Raises ArctrackError if shared
    memory has no room.
    """
    kept_s = cell.black_box.seconds
    if kept_s == 0.0 and not cell.monitor.enabled and cell.mcap.folder is None:
        yield None
        return
    run, setup = f"{os.getpid()}", cell.setup.setup
    slots = slots_for(kept_s, cell.camera.frame_rate_hz)
    with ExitStack() as opened:
        try:
            remove_dead_rings()
            journal = Journal(run, setup.frame_shape, setup.sensor.dtype, slots)
        except RingError as error:
            raise in_file(cell.path, f"[black_box] seconds = {kept_s:g}: {error}; choose fewer") from None
        opened.callback(journal.close)
        watching = SupervisedProcess(
            "watch", run_watch, (WatchOptions(run, setups),), niceness=WATCH_NICENESS
        )
        started = [opened.enter_context(supervisor.running(watching))]
        jobs = {number: JobSetup(setup, job_setup_text(cell, number)) for number, setup in setups.items()}
        black_box, box_end = message_pipe()
        page_end, asked_end = message_pipe()
        if kept_s:
            # A simulated cell's faults are this machine's load; nobody wants their files.
            options = RecorderOptions(
                run,
                cell.path.parent / cell.black_box.folder,
                kept_s,
                cell.camera.frame_rate_hz,
                jobs,
                saves_faults=not is_simulated,
            )
            recording = SupervisedProcess(
                "black box",
                run_recorder,
                (options,),
                (box_end, asked_end),
                BLACK_BOX_NICENESS,
                lost={"error": "its process ended before all was saved; ask again"},
                # It writes what it holds.
                ends_s=60.0,
            )
            started.append(opened.enter_context(supervisor.running(recording, END)))
        if cell.mcap.folder is not None:
            mcap = McapOptions(run, cell.path.parent / cell.mcap.folder, jobs)
            bridge = SupervisedProcess("mcap", _run_mcap, (mcap,), niceness=WATCH_NICENESS, ends_s=10.0)
            started.append(opened.enter_context(supervisor.running(bridge, END)))
        page: str | None = None
        warnings: tuple[str, ...] = ()
        if cell.monitor.enabled:
            pipes = (page_end,) if kept_s else ()
            page, warnings = _page(opened, supervisor, options_of(cell, run, is_simulated), pipes, cell.path)
        for process in started:
            process.wait_ready()
        yield JournalProcesses(
            JournalWriter(journal, supervisor.states),
            BlackBoxClient(black_box) if kept_s else None,
            page,
            warnings,
        )


def _run_page(*given: Any) -> None:
    # What a page needs is loaded where it runs: the loop's process does without it.
    from arctrack.live.monitor.monitor_process import run_monitor

    run_monitor(*given)


def _run_mcap(*given: Any) -> None:
    from arctrack.live.monitor.mcap_process import run_mcap

    run_mcap(*given)


def _page(
    opened: ExitStack,
    supervisor: Supervisor,
    options: MonitorOptions,
    pipes: tuple[PipeEnd, ...],
    cell_path: Path,
) -> tuple[str | None, tuple[str, ...]]:
    """Start the page, and return where it is, and what is wrong: a run goes on without it."""
    process = SupervisedProcess("page", _run_page, (options,), pipes, PAGE_NICENESS)
    opened.enter_context(supervisor.running(process))
    try:
        address = str(process.wait_ready())
    except ArctrackError as error:
        return None, (f"{cell_path}: {error}; there is no page",)
    # Browsers look there: the next one is at the same port.
    process.arguments = (replace(options, port=urlsplit(address).port or options.port),)
    return address, ()
