"""A tracker's node on the bus whose camera, process, clock, queue or disk fails."""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from arctrack.simulation.cell.bus import BusFrame
from arctrack.simulation.cell.cell import Shown, TrackerNode
from arctrack.simulation.cell.robot_node import as_message
from robot_io import BusMessage, SeamOffset
from robot_io.link.reconnecting import LinkFault
from robot_io.link.steady_log import SteadyLog
from validation.fault_schedules.disk import Disk
from validation.fault_schedules.measuring_camera import MeasuringCamera


class CameraBehaviour(Enum):
    """Behaviour of the camera."""

    RIGHT = "right"
    STOPPED = "stopped"
    FROZEN = "frozen"
    GARBAGE = "garbage"
    DROPPING = "dropping"
    GHOST = "ghost"


@dataclass
class FaultyTracker(TrackerNode):
    """Tracker's node on the bus, on a clock that is `clock_s` ahead of the true time.

    While not `is_running`, messages wait in the bus' buffer; while `queue_full`, nothing goes out. `faults`
    counts what went wrong without ending the run, `said` is what it told its user. `captured` maps times on
    the tracker's clock to the frames' capture times, s. `on_sent` gets each offset that goes out.
    """

    camera: MeasuringCamera
    clock_s: float = 0.0
    behaviour: CameraBehaviour = CameraBehaviour.RIGHT
    is_running: bool = True
    queue_full: bool = False
    disk: Disk = field(default_factory=Disk)
    faults: Counter[LinkFault] = field(default_factory=Counter)
    said: list[str] = field(default_factory=list)
    ghost_mm: float = 2.0
    captured: dict[float, float] = field(default_factory=dict)
    on_sent: Callable[[SeamOffset], None] | None = None

    def __post_init__(self) -> None:
        self._shown: Shown = None
        self._has_shown = False
        self._waiting: deque[tuple[BusFrame, float]] = deque()
        self._log = SteadyLog(
            Path("bus.blf"), self.faults, self.disk.open, lambda: self.scheduler.now_s, self.said.append
        )
        super().__post_init__()

    def _begin_bus(self) -> None:
        super()._begin_bus()
        self._waiting.clear()

    @property
    def now_s(self) -> float:
        """The time on the tracker's clock, s."""
        return self.scheduler.now_s + self.clock_s

    def resume(self) -> None:
        """Let the process run on: first it reads what waits."""
        self.is_running = True
        while self._waiting:
            self._read(*self._waiting.popleft())

    def _hear(self, frame: BusFrame) -> None:
        if self.is_running:
            super()._hear(frame)
        else:
            self._waiting.append((frame, self.now_s))

    def _read(self, frame: BusFrame, came_s: float) -> None:
        self._log.write(as_message(frame, came_s))
        super()._read(frame, came_s)

    def _capture(self) -> None:
        behaviour = self.behaviour
        if behaviour is CameraBehaviour.STOPPED or (
            behaviour is CameraBehaviour.DROPPING and self.rng.random() < 0.1
        ):
            return
        self.robot.advance(self.scheduler.now_s)
        if behaviour is not CameraBehaviour.FROZEN or not self._has_shown:
            self.camera.aside_mm = self.ghost_mm if behaviour is CameraBehaviour.GHOST else 0.0
            self._shown, self._has_shown = self.camera.look(), True
        self._take(None if behaviour is CameraBehaviour.GARBAGE else self._shown)

    def _take(self, shown: Shown) -> None:
        self.captured[self.now_s] = self.scheduler.now_s
        super()._take(shown)

    def _track(self, shown: Shown, captured_s: float) -> None:
        if self.is_running:
            super()._track(shown, captured_s)

    def _poll(self) -> None:
        if self.is_running:
            super()._poll()

    def _put(self, message: BusMessage) -> bool:
        if self.queue_full:
            return False
        if isinstance(message, SeamOffset) and self.on_sent is not None:
            self.on_sent(message)
        return super()._put(message)

    def _send(self, arbitration_id: int, data: bytes) -> None:
        super()._send(arbitration_id, data)
        self._log.write(as_message(BusFrame(self.name, arbitration_id, data, self.now_s), self.now_s))
