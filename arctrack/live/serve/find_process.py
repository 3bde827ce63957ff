"""The joint of a FIND in a subprocess: it takes as long as some ten to a hundred frames' steps."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np

from arctrack.control.find_responder import FRAMES
from arctrack.live.cameras.shared_frames import FIELDS, pack_fields, unpack_frame
from arctrack.live.journal.message_pipe import PipeClient, PipeEnd, message_pipe
from arctrack.live.journal.ring import RingReader, RingWriter
from arctrack.live.serve.supervisor import SupervisedProcess
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from tracker import flags
from tracker.find import Finder, FoundJoint, find_joint
from tracker.geometry import SensorGeometry
from tracker.seam.correction import UNSTATED
from tracker.state import Frame, Pose
from tracker.warm_up import warm_up

LOST: tuple[int, None] = (-1, None)
"""Answer of a process that ended: to no question that was asked, so it is asked again."""


@dataclass(frozen=True)
class FindQuestion:
    """Question for the joint of a job in frames, by their places in the ring and their poses (4, 4)."""

    ticket: int
    job_number: int
    shown: tuple[tuple[int, Float64], ...]


def frames_name(run: str) -> str:
    """Return the name of the ring that holds the frames of a run's FIND."""
    return f"find-{run}"


def frames_ring(run: str, setup: Setup) -> RingWriter:
    """Return a ring for the frames of a run's FIND; RingError if shared memory has no room."""
    image_bytes = int(np.prod(setup.frame_shape)) * np.dtype(setup.sensor.dtype).itemsize
    return RingWriter(frames_name(run), FRAMES, FIELDS.size + image_bytes)


class FindClient:
    """The loop's end of the process: a `JointFinder` that never waits. `ring` is `frames_ring` of the run."""

    def __init__(self, run: str, ring: RingWriter) -> None:
        self._run, self._ring = run, ring
        self._end, self._its_end = message_pipe()
        self._pipe = PipeClient(self._end)
        self._ticket = 0
        self._shown: list[tuple[int, Float64]] = []

    def started(self, setups: Mapping[int, Setup]) -> SupervisedProcess:
        """Start the process for setups by job number; it imports what it needs until `let_warm_up`."""
        arguments = self._run, setups, True
        # Nobody waits for it: the loop comes first.
        self._process = SupervisedProcess("find", find_joints, arguments, (self._its_end,), 5, lost=LOST)
        return self._process

    def let_warm_up(self) -> None:
        """Let the process load what is compiled by now; one that is started again has nobody to wait for."""
        self._end.send(None)
        self._process.arguments = *self._process.arguments[:-1], False

    def begin(self) -> None:
        """Forget all frames."""
        self._ticket += 1
        self._shown = []

    def keep(self, frame: Frame, T_base_tool: Float64) -> None:
        """Take a frame and its pose (4, 4)."""
        self._shown.append((self._ring.count, T_base_tool))
        self._ring.write(pack_fields(frame), np.ascontiguousarray(frame.image_dn))

    def found(self, job_number: int) -> FoundJoint | None:
        """Return what a job's frames since `begin` show; None while that is not known."""
        answer: tuple[int, FoundJoint | None] | None = self._pipe.answer()
        if answer is not None and answer[0] == self._ticket:
            return answer[1]
        # An earlier question is answered first, and that answer is dropped.
        self._pipe.ask(FindQuestion(self._ticket, job_number, tuple(self._shown)))
        return None


def find_joints(
    run: str, setups: Mapping[int, Setup], waits: bool, parent: Connection, asked: PipeEnd
) -> None:
    """Report readiness, and answer each question with the joint, until the parent is gone.

    `setups` are by job number. A process that `waits` warms up once it is let: two need not compile the same.
    """
    finders = {number: Finder(SensorGeometry.of(setup)) for number, setup in setups.items()}
    # The parent may be gone before it is ready.
    try:
        if waits and wait([parent, asked.fileno()]) != [asked.fileno()]:
            return
        for finder in finders.values():
            warm_up(finder.geometry, UNSTATED)
        with RingReader(frames_name(run)) as ring:
            parent.send([])
            while wait([parent, asked.fileno()]) == [asked.fileno()]:
                question: FindQuestion | None = asked.recv()
                if question is not None:
                    asked.send((question.ticket, _found(finders[question.job_number], question, ring)))
    except (EOFError, ConnectionResetError, BrokenPipeError):
        return


def _found(finder: Finder, question: FindQuestion, ring: RingReader) -> FoundJoint:
    """Return the joint in a question's frames, without the arrays of its track."""
    setup = finder.geometry.setup
    shown: list[tuple[Frame, Pose]] = []
    for position, T_base_tool in question.shown:
        record = ring.read(position)
        if record is None:
            # The request was withdrawn, and another one's frames are there.
            return FoundJoint.refused("seam", flags.FRAME_UNREADABLE.name)
        image_dn: Any = record[FIELDS.size :].view(setup.sensor.dtype).reshape(setup.frame_shape)
        shown.append((unpack_frame(record, image_dn), Pose(T_base_tool)))
    joint = find_joint(finder, shown)
    if joint.track is None:
        return joint
    return replace(joint, track=replace(joint.track, stripe=None, checks=()))
