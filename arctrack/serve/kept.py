"""What a live run keeps of itself, and the processes that read it: black box, watch and page."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection

from arctrack.black_box.ask import BlackBoxAsker
from arctrack.black_box.recorder import END, RecorderOptions, run_recorder
from arctrack.black_box.save import JobSetup
from arctrack.cell_file import CellFile
from arctrack.cell_file.job_setup import job_setup_text
from arctrack.errors import ArctrackError, in_file
from arctrack.journal.journal import Journal, slots_for
from arctrack.journal.ring import RingError, remove_dead_rings
from arctrack.monitor.options import options_of
from arctrack.monitor.run import run_monitor
from arctrack.serve.beside import Beside, ended
from arctrack.serve.keeper import Keeper
from arctrack.watch.process import WatchOptions, run_watch
from noise_model.setup import Setup

PAGE_NICENESS, BLACK_BOX_NICENESS, WATCH_NICENESS = 10, 10, 15
"""By how much each yields to the loop and to whoever publishes frames: what a person waits for goes first."""


@dataclass(frozen=True)
class Kept:
    """What writes a run's journal, and what reads it.

    Attributes
    ----------
    keeper : Keeper
        Writes it.
    black_box : BlackBoxAsker or None
        Asks the black box, where there is one.
    page : str or None
        Where the page is.
    warnings : tuple of str
        What is missing, one line each.
    """

    keeper: Keeper
    black_box: BlackBoxAsker | None
    page: str | None
    warnings: tuple[str, ...]


@contextmanager
def kept(cell: CellFile, setups: Mapping[int, Setup], is_simulated: bool = False) -> Iterator[Kept | None]:
    """Keep a run's journal, with the processes beside it that a cell file asks for.

    Parameters
    ----------
    cell : CellFile
        The cell.
    setups : mapping of int to Setup
        The setup of each job that may be tracked.
    is_simulated : bool
        Whether robot and camera are simulated.

    Yields
    ------
    Kept or None
        What was started; None where nobody would read a journal.

    Raises
    ------
    ArctrackError
        If there is no room for the journal.
    """
    kept_s = cell.black_box.seconds
    if kept_s == 0.0 and not cell.monitor.enabled:
        yield None
        return
    run, setup = f"{os.getpid()}", cell.setup.setup
    remove_dead_rings()
    slots = slots_for(kept_s, cell.camera.frame_rate_hz)
    with ExitStack() as opened:
        try:
            journal = Journal(run, (setup.camera.height, setup.camera.width), setup.sensor.dtype, slots)
        except RingError as error:
            raise in_file(cell.path, f"[black_box] seconds = {kept_s:g}: {error}; choose fewer") from None
        opened.callback(journal.close)
        watching = Beside("watch", run_watch, (WatchOptions(run, setups),), niceness=WATCH_NICENESS)
        watch = opened.enter_context(ended(watching))
        page_end, box_end = multiprocessing.Pipe() if cell.monitor.enabled and kept_s else (None, None)
        recorder = None
        if kept_s:
            asked = () if box_end is None else (box_end,)
            # A simulated cell's faults are this machine's load; nobody wants their files.
            options = _recorder_options(cell, run, setups, saves_faults=not is_simulated)
            recording = Beside("black box", run_recorder, (options,), asked, BLACK_BOX_NICENESS)
            recorder = opened.enter_context(ended(recording, END))
        page: str | None = None
        warnings: tuple[str, ...] = ()
        if cell.monitor.enabled:
            page, warnings = _page(opened, cell, run, is_simulated, page_end)
        for beside in (watch, recorder):
            if beside is not None:
                beside.wait_ready()
        yield Kept(
            Keeper(journal), None if recorder is None else BlackBoxAsker(recorder.told), page, warnings
        )


def _recorder_options(
    cell: CellFile, run: str, setups: Mapping[int, Setup], saves_faults: bool
) -> RecorderOptions:
    jobs = {number: JobSetup(setup, job_setup_text(cell, number)) for number, setup in setups.items()}
    folder = cell.path.parent / cell.black_box.folder
    return RecorderOptions(run, folder, cell.black_box.seconds, cell.camera.frame_rate_hz, jobs, saves_faults)


def _page(
    opened: ExitStack, cell: CellFile, run: str, is_simulated: bool, black_box: Connection | None
) -> tuple[str | None, tuple[str, ...]]:
    """Start the page, and return where it is, and what is wrong: a run goes on without it."""
    others = () if black_box is None else (black_box,)
    options = options_of(cell, run, is_simulated)
    beside = opened.enter_context(ended(Beside("page", run_monitor, (options,), others, PAGE_NICENESS)))
    try:
        return str(beside.wait_ready()), ()
    except ArctrackError as error:
        return None, (f"{cell.path}: {error}; there is no page",)
