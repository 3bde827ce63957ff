"""Processes that draw the frames of a replay: this one, or subprocesses while there are cores for them."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from arctrack.child_process import WorkerProcess, answered
from arctrack.errors import ArctrackError
from arctrack.recording import Recording, Truth
from arctrack.replay.pages.view import Drawn, FrameDrawer, ToDraw

FRAMES_WORTH_A_PROCESS = 170
"""Number of the page's frames that take as long to draw as a process takes to start: 1.5 s of one core."""


def process_count(cores: int, frames: int) -> int:
    """Return the number of processes that draw `frames` on `cores`.

    One core is for the writer of what they draw. No process takes longer to start than it then draws.
    """
    # Three draw as fast as one reads the frames, encodes the video and collects the page.
    return max(0, min(cores - 1, frames // FRAMES_WORTH_A_PROCESS, 3))


@dataclass(frozen=True)
class Drawing:
    """Drawing of a replay's frames: `drawer`, in the `processes` if there are any, otherwise in this one."""

    drawer: FrameDrawer
    processes: Sequence[WorkerProcess[ToDraw, Drawn]]

    def wait_ready(self) -> None:
        """Wait until the processes have loaded what they need: they are idle then until the first request."""
        for process in self.processes:
            process.wait_ready()

    def draw(self, to_draw: Iterable[ToDraw]) -> Iterator[tuple[ToDraw, Drawn]]:
        """Yield frames and what was drawn of them, in their order; ArctrackError if a process has ended."""
        return answered(self.drawer, self.processes, to_draw)


@contextmanager
def drawing_on(recording: Recording, truth: Truth | None, folder: Path, cores: int) -> Iterator[Drawing]:
    """Yield the drawing of a recording's frames on `cores`; its processes end with the block.

    The results `folder` is named where one ends by itself.
    """
    drawer = FrameDrawer(recording.setup, truth)
    ended = ArctrackError(
        f"{folder}: a process that drew pictures has ended, for want of memory perhaps; what was tracked and "
        "sent is there, --no-pictures draws nothing"
    )
    count = process_count(cores, len(recording.rows))
    with ExitStack() as opened:
        yield Drawing(drawer, [opened.enter_context(WorkerProcess(drawer, ended)) for _ in range(count)])
