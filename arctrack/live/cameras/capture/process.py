"""The process that captures: a source's frames into shared memory, until its parent is gone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection, wait

from arctrack.errors import ArctrackError
from arctrack.live.cameras.camera_line import read_line, remove_line
from arctrack.live.cameras.capture.source import Ask, FrameSource
from arctrack.live.cameras.shared_frames import SharedFramesError, SharedFramesWriter
from arctrack.live.journal.message_pipe import PipeEnd
from noise_model.setup import Setup

OPENED_AGAIN_S = 1.0
"""Time after which a source that failed is reopened."""

OVER = "over"
"""Message that a source has ended by itself."""

Open = Callable[[Ask], FrameSource]


def run_capture(open_source: Open, setup: Setup, name: str, told: Connection, loop: PipeEnd) -> None:
    """Publish a source's frames under a name, from the first message of the loop until `told` is closed.

    Once the source is open, `told` is sent that it is ready, or 'error: ' and the reason; the loop is sent
    'over' once the source has ended. A source that fails later is reopened, again and again. The loop's
    message stays in its pipe: a process that takes over begins at once.
    """
    remove_line(name)
    try:
        source = open_source(partial(read_line, name))
        try:
            camera = setup.camera
            with SharedFramesWriter(name, camera.height, camera.width, setup.sensor.dtype) as frames:
                told.send([])
                if wait([told, loop.fileno()]) == [loop.fileno()]:
                    _publish(source, open_source, frames, name, told, loop)
        finally:
            source.close()
    except (ArctrackError, SharedFramesError) as error:
        told.send(f"error: {error}")
    except (EOFError, ConnectionResetError, BrokenPipeError):
        return
    finally:
        remove_line(name)


def _publish(
    source: FrameSource,
    open_source: Open,
    frames: SharedFramesWriter,
    name: str,
    told: Connection,
    loop: PipeEnd,
) -> None:
    """Publish until the parent is gone."""
    first = latest = 0
    source.begin()
    while not told.poll():
        if source.is_over:
            loop.send(OVER)
            told.recv()
            return
        try:
            frame = source.read()
        except ArctrackError:
            source.close()
            again = _opened_again(open_source, name, told)
            if again is None:
                return
            source, first = again, latest + 1
            continue
        if frame is not None:
            latest = first + frame.index
            frames.publish(replace(frame, index=latest))


def _opened_again(open_source: Open, name: str, told: Connection) -> FrameSource | None:
    """Return a failed source after reopening it; None once the parent is gone."""
    while not told.poll(OPENED_AGAIN_S):
        try:
            source = open_source(partial(read_line, name))
        except ArctrackError:
            continue
        source.begin()
        return source
    return None
