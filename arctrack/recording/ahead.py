"""Frames read and decoded ahead of who takes them, in a thread of their own."""

from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from queue import SimpleQueue
from threading import Thread
from typing import TypeVar

Item = TypeVar("Item")

ITEMS_AHEAD = 4
"""Largest number of prefetched frames: enough to even out a slow file, and few against a recording."""


@contextmanager
def read_ahead(items: Generator[Item, None, None]) -> Iterator[Iterator[Item]]:
    """Let a thread prefetch what a generator yields; yields an iterator over the same items.

    Decoders release Python's lock, so the thread works while the tracker does. Nobody else may use the
    generator. What it raises is raised after the last item that it gave. Its own thread closes it, and ends
    with the block, however that ends.
    """
    # A Ctrl-C may come inside what is written in Python, such as a Semaphore, and leave its lock taken. A
    # SimpleQueue is written in C.
    ready: SimpleQueue[Item | _End] = SimpleQueue()
    room: SimpleQueue[None] = SimpleQueue()
    over: SimpleQueue[None] = SimpleQueue()
    for _ in range(ITEMS_AHEAD):
        room.put(None)

    def take() -> None:
        with closing(items):
            try:
                room.get()
                while over.empty():
                    ready.put(next(items))
                    room.get()
            except StopIteration:
                ready.put(_End(None))
            except Exception as error:
                ready.put(_End(error))

    thread = Thread(target=take, name="frames ahead", daemon=True)
    try:
        thread.start()
        yield _taken(ready, room)
    finally:
        over.put(None)
        room.put(None)
        if thread.ident is not None:
            thread.join()


class _End:
    """Stands behind the last item, and says what ended them: None where they are all."""

    def __init__(self, error: Exception | None) -> None:
        self.error = error


def _taken(ready: SimpleQueue[Item | _End], room: SimpleQueue[None]) -> Iterator[Item]:
    while True:
        item = ready.get()
        if isinstance(item, _End):
            if item.error is not None:
                raise item.error
            return
        room.put(None)
        yield item
