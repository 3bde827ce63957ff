"""Robot, tracker and bus behind one scheduler."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from arctrack.control.job import Bridging, Job
from arctrack.simulation.cell.bus import Bus
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.robot_node import RobotNode
from arctrack.simulation.cell.scheduler import Scheduler
from arctrack.simulation.cell.tracker_node import SimulatedCamera, TrackerNode
from arctrack.simulation.cell.world import World
from robot_io import Command

ARMED_S = 0.2
"""Time at which the robot commands TRACK."""

BRIDGE_MM = 20.0
"""Distance that the job lets a tracker go without a joint."""

TORCH_MM = 0.5
"""Largest distance of the torch from the seam at a run's end."""


class Cell:
    """One run of a simulated cell; `make_camera` makes the camera at a robot's tool."""

    def __init__(
        self,
        world: World,
        rng: np.random.Generator,
        make_camera: Callable[[Robot], SimulatedCamera],
        frame_period_s: float,
    ) -> None:
        self.rng = rng
        bridging = Bridging(world.path, (world.look_ahead_mm, 0.0, 0.0), BRIDGE_MM)
        self.job = Job("lap", poses_proven=True, bridging=bridging)
        self.scheduler = Scheduler()
        robot = Robot(world)
        self.bus, self.robot = self._make_robot(robot)
        self.tracker = self._make_tracker(robot, make_camera(robot), frame_period_s)
        self.scheduler.at(ARMED_S, lambda: self.command(Command.TRACK))

    def _make_robot(self, robot: Robot) -> tuple[Bus, RobotNode]:
        """Return a bus with the robot's node."""
        bus = Bus(self.scheduler, self.rng)
        return bus, RobotNode(robot, bus, self.scheduler)

    def _make_tracker(self, robot: Robot, camera: SimulatedCamera, frame_period_s: float) -> TrackerNode:
        """Return the tracker's node."""
        return TrackerNode(robot, self.bus, self.scheduler, self.rng, self.job, camera, frame_period_s)

    @property
    def world(self) -> World:
        """Present state of the world."""
        return self.robot.robot.world

    @world.setter
    def world(self, world: World) -> None:
        self.robot.robot.world = world

    def command(self, command: Command, is_new_request: bool = False) -> None:
        """Let the robot want something else of the tracker."""
        wanted = self.robot.robot.command
        number = (wanted.request_number + is_new_request) % 256
        self.robot.robot.command = replace(wanted, command=command, request_number=number)

    def run(self, until_s: float) -> None:
        """Run to a time, s."""
        self.scheduler.run(until_s)
