"""A robot's node on the bus that reports wrong poses, spoils its status or commands nothing."""

from collections.abc import Callable
from dataclasses import dataclass

from arctrack.simulation.cell.robot_node import RobotNode, RobotReport
from robot_io import BusMessage, RobotStatus

Spoil = Callable[[float, RobotReport], RobotReport | None]
"""Function of the time and the true pose that returns the pose to send; None for nothing."""


@dataclass
class FaultyRobotNode(RobotNode):
    """Robot's node on the bus.

    `spoil` disturbs the poses that are sent. `spoils_crc` makes the status' CRC wrong. Without `commands` it
    commands nothing.
    """

    spoil: Spoil | None = None
    spoils_crc: bool = False
    commands: bool = True

    def report(self) -> RobotReport | None:
        """Return the pose that the robot reports; None for one that is lost."""
        report = super().report()
        if self.spoil is None or report is None:
            return report
        return self.spoil(self.scheduler.now_s, report)

    def _send_command(self) -> None:
        if self.commands:
            super()._send_command()

    def _send(self, message: BusMessage) -> None:
        arbitration_id, data = self._protector.protect(message)
        if self.spoils_crc and isinstance(message, RobotStatus):
            data = bytes([data[0] ^ 0x5A]) + data[1:]
        self.bus.send(self.name, arbitration_id, data)
