"""A robot's port as a process of its own: it answers the robot in time, whatever the tracker computes."""

from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection

import can

from arctrack.control.cell_file import BusChoice, ProcessChoice
from arctrack.errors import ArctrackError
from arctrack.live.journal.message_pipe import PipeEnd, message_pipe
from arctrack.live.serve.process import garbage_left, schedule
from arctrack.live.serve.supervisor import SupervisedProcess
from robot_io.ports.port import PORTS, RobotPort, address_of
from robot_io.ports.report import PortError


class PortBus(can.BusABC):
    """The tracker's end of a port, as python-can has a bus."""

    def __init__(self, end: PipeEnd) -> None:
        super().__init__(channel="port")
        self._end = end

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put a frame into the pipe at once, with the time that it bears."""
        try:
            self._end.send((msg.arbitration_id, bytes(msg.data), msg.timestamp))
        except OSError as error:
            raise can.CanOperationError(f"the port takes nothing ({error.strerror})") from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._end.poll(timeout):
            return None, True
        arbitration_id, data, sent_at_s = self._end.recv()
        frame = can.Message(
            timestamp=sent_at_s, arbitration_id=arbitration_id, data=data, is_extended_id=False
        )
        return frame, True


OpenBus = Callable[[], can.BusABC]


def port_process(bus: BusChoice, process: ProcessChoice) -> tuple[SupervisedProcess, OpenBus]:
    """Return the process of a robot's port, and what opens the bus that it is to a tracker."""
    end, its_end = message_pipe()
    return SupervisedProcess("port", serve_port, (bus, process), (its_end,)), lambda: PortBus(end)


def serve_port(bus: BusChoice, process: ProcessChoice, parent: Connection, tracker: PipeEnd) -> None:
    """Run a port until the parent is gone; say when it is ready, and what is wrong with its robot.

    ArctrackError where it cannot listen. It has the priority of the loop, and any processor.
    """
    try:
        address = address_of(bus.interface, bus.channel)
        port = RobotPort(PORTS[bus.interface].open_line(address, bus.running_word), tracker)
    except PortError as error:
        raise ArctrackError(f"[bus] channel: {error}; choose another address or port") from None
    # What the machine does not allow is said of the loop.
    schedule(replace(process, cpus=None))
    problem = ""
    with garbage_left():
        try:
            parent.send(None)
            while not port.turn((parent,)):
                if port.line.problem != problem:
                    problem = port.line.problem
                    parent.send(problem)
        except (BrokenPipeError, ConnectionResetError):
            return
        finally:
            port.close()
