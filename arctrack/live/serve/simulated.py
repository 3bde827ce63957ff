"""Simulated cell of a live run: its cell file, its process, and its torch's distance from the seam."""

import math
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import tomlkit

from arctrack.child_process import ChildProcess
from arctrack.control.cell_file.new import commented_cell, write_cell
from arctrack.errors import ArctrackError
from arctrack.live.simulated_cell import joined_bus, serve_cell
from arctrack.recording.new import commented_setup
from arctrack.simulation.cell.cell import TORCH_MM
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.weld.closed_loop import SETTLED_TIME_CONSTANTS, LoopPlan, setup_of, world_of
from robot_io import BusMessage, GateReason, SeamOffset, TrackerStatus, Validity
from tracker import flags
from tracker.state import Track

INTERFACE, GROUP = "udp_multicast", "239.74.163.2"
Samples = list[tuple[float, float]]
"""Distances of the torch from the seam, mm, by the machine's monotonic time, s; NaN while it locks on again.
"""


@dataclass(frozen=True)
class TorchError:
    """Distances of the torch from the seam from the lock on, mm, and the time observed, s."""

    rms_mm: float
    max_mm: float
    watched_s: float

    @property
    def is_on_seam(self) -> bool:
        """True if the torch never was farther off than a run with faults may leave it."""
        return self.max_mm <= TORCH_MM


@dataclass
class Lock:
    """Time from which a run's torch follows the seam (see `ClosedLoop.lock_s`).

    `at_s` is on the machine's monotonic clock, infinite before.
    """

    plan: LoopPlan
    at_s: float = math.inf

    def __post_init__(self) -> None:
        world = world_of(self.plan, setup_of(self.plan))
        self._follows_s = world.latency_s + SETTLED_TIME_CONSTANTS * world.time_constant_s

    def on_track(self, track: Track, messages: list[BusMessage]) -> None:
        """Take a track, and what was sent of it."""
        is_valid = any(isinstance(m, SeamOffset) and m.validity is Validity.VALID for m in messages)
        is_free = any(isinstance(m, TrackerStatus) and m.gate_reason is GateReason.NONE for m in messages)
        is_measured = not track.flags & flags.OFFSET_EXTRAPOLATED.mask
        if math.isinf(self.at_s) and is_valid and is_free and is_measured:
            self.at_s = track.timestamp_s + self._follows_s


class SimulatedCell(ChildProcess):
    """Simulated robot and camera, as a child process.

    `frames` is the name of the camera's frames; `meanwhile` runs while they start. `bus_options` are
    python-can's for a bus that nobody else hears.
    """

    def __init__(self, plan: LoopPlan, frames: str, meanwhile: Callable[[], None] = lambda: None) -> None:
        self.bus_options = {"port": _free_port(), "hop_limit": 0}
        # At once: the process takes a while to start.
        joined_bus(INTERFACE, GROUP, **self.bus_options).shutdown()
        super().__init__(
            _run, (plan, frames, self.bus_options), ended=ArctrackError("the simulated cell ended by itself")
        )
        try:
            meanwhile()
            self.receive()
        except BaseException:
            self.close()
            raise

    @property
    def listening(self) -> str:
        """The command that prints what is on its bus."""
        return f"python -m can.logger -i {INTERFACE} -c {GROUP} --bus-kwargs port={self.bus_options['port']}"

    def stop(self) -> Samples:
        """Stop it, and return how far its torch was off the seam."""
        self.send(True)
        return list(self.receive())

    def close(self) -> None:
        """Let it end: it does once nobody listens."""
        # Time that robot and camera may take to end.
        self.end(10.0)


def write_simulated_cell(
    folder: Path, plan: LoopPlan, interface: str, channel: str, frames: str, black_box: Path | None = None
) -> Path:
    """Write the cell file of a simulated cell and its setup into a new folder, and return the cell file.

    The default of `black_box` is a folder next to the file. Raises ArctrackError if the folder holds
    anything, or cannot be written.
    """
    document = tomlkit.parse(commented_cell())
    document["bus"].update({"interface": interface, "channel": channel})
    document["camera"].update({"frame_rate_hz": plan.rate_hz, "kind": "shared_memory", "name": frames})
    if black_box is not None:
        document["black_box"]["folder"] = str(black_box)
    return write_cell(folder, tomlkit.dumps(document), commented_setup(setup_of(plan)))[0]


def torch_error(samples: Samples, from_s: float, to_s: float) -> TorchError | None:
    """Return how far the torch was off the seam from one time to another, s; None if nothing was seen."""
    off_mm = np.array([off for time_s, off in samples if from_s <= time_s <= to_s and not math.isnan(off)])
    if len(off_mm) == 0:
        return None
    return TorchError(float(np.sqrt((off_mm**2).mean())), float(off_mm.max()), to_s - from_s)


def _run(plan: LoopPlan, frames: str, bus_options: dict[str, int], parent: Connection) -> None:
    """Run robot and camera until the parent says so, or is gone."""
    samples: Samples = []

    def goes_on(robot: Robot) -> bool:
        off_mm = robot.offset_mm - np.array(robot.world.seam_mm(robot.station_mm))
        # The first part's lock takes 50 mm.
        is_locking = robot.parts > 0 and robot.station_mm < 80.0
        samples.append((time.monotonic(), math.nan if is_locking else math.hypot(*off_mm)))
        return not parent.poll()

    try:
        serve_cell(plan, INTERFACE, GROUP, frames, goes_on, lambda: parent.send([]), **bus_options)
        parent.send(samples)
    except BrokenPipeError:
        return


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        return int(free.getsockname()[1])
