"""The process that captures: a source's frames into shared memory, until its parent is gone."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection, wait

from arctrack.errors import ArctrackError
from arctrack.live.cameras.camera_line import read_line, remove_line
from arctrack.live.cameras.capture.source import Ask, FrameSource
from arctrack.live.cameras.shared_frames import SharedFramesWriter
from arctrack.live.journal.message_pipe import PipeEnd
from noise_model.setup import Setup

OVER = "over"
"""Message that a source has ended by itself."""

Open = Callable[[Ask], FrameSource]


def run_capture(open_source: Open, setup: Setup, name: str, parent: Connection, loop: PipeEnd) -> None:
    """Publish a source's frames under a name, from the loop's first message until the parent is gone.

    The parent is told once the source is open; the loop is sent 'over' once it has ended. A source that fails
    later is reopened, again and again; the parent is told why, and "" once it is open. The loop's message
    stays in its pipe: a process that takes over begins at once. ArctrackError if the source cannot be opened,
    or its frames not be published.
    """
    remove_line(name)
    try:
        source = open_source(partial(read_line, name))
        try:
            with SharedFramesWriter(name, *setup.frame_shape, setup.sensor.dtype) as frames:
                parent.send([])
                if wait([parent, loop.fileno()]) == [loop.fileno()]:
                    _publish(source, open_source, frames, name, parent, loop)
        finally:
            source.close()
    except (EOFError, ConnectionResetError, BrokenPipeError):
        return
    finally:
        remove_line(name)


def _publish(
    source: FrameSource,
    open_source: Open,
    frames: SharedFramesWriter,
    name: str,
    parent: Connection,
    loop: PipeEnd,
) -> None:
    first = latest = 0
    source.begin()
    while not parent.poll():
        if source.is_over:
            loop.send(OVER)
            parent.recv()
            return
        try:
            frame = source.read()
        except ArctrackError as error:
            source.close()
            parent.send(str(error))
            again = _opened_again(open_source, name, parent)
            if again is None:
                return
            source, first = again, latest + 1
            continue
        if frame is not None:
            latest = first + frame.index
            frames.publish(replace(frame, index=latest))


def _opened_again(open_source: Open, name: str, parent: Connection) -> FrameSource | None:
    """Return a failed source after reopening it; None once the parent is gone."""
    # Time after which a source that failed is reopened.
    while not parent.poll(1.0):
        try:
            source = open_source(partial(read_line, name))
        except ArctrackError as error:
            parent.send(str(error))
            continue
        source.begin()
        parent.send("")
        return source
    return None
