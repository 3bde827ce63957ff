"""A rendered camera: what the sensor sees from where the tool truly is, and the real tracker behind it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from arctrack.control.cell_file import CellJob
from arctrack.control.frame_tracking import Capture, FrameTracking, TrackedFrame
from arctrack.control.seam_passes import SeamPasses
from arctrack.simulation.cell.cell import COMPUTED_S, Shown
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.turning_seam import TurningSeam
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64, Integers
from noise_model.condition import Condition
from noise_model.drawn_profile import draw_profile
from noise_model.effects import apply_setup_effects, checked
from noise_model.forward import Renderer, draw_frame
from noise_model.instrument.sensor import saturation_dn
from noise_model.plan.noise import expected_speckle
from noise_model.setup import Setup
from noise_model.surface.joint import BentSeam, SeamLine
from robot_io import Switch
from tracker.state import Frame


@dataclass
class RenderedCamera:
    """Simulated camera and tracker: renders each frame, and tracks it as a live tracker would.

    The tool stands still during an exposure. The tracker knows `setup` alone, whose nominal seam is that of
    the robot's world; `true_setup` and the true seam are hidden from it. Without `laser_speckle` the laser
    speckles as its optics say.

    `arc_level` is the arc's output over its nominal one by time, s; None burns as the robot's status says.
    `tacks_mm` are intervals of stations under a tack. NaN as `exposure_s` is the true setup's own. `aside_mm`
    shifts the seam farther to the left, out of the camera's view. `job` is a cell's, whose passes follow each
    other; None for one pass alone. One without the laser gets black frames.
    """

    robot: Robot
    setup: Setup
    true_setup: Setup
    rng: np.random.Generator
    arc_level: Callable[[float], float] | None = None
    tacks_mm: tuple[tuple[float, float], ...] = ()
    is_laser_on: bool = True
    exposure_s: float = math.nan
    aside_mm: float = 0.0
    job: CellJob | None = None
    part_seed: int = field(init=False)

    def __post_init__(self) -> None:
        self.part_seed = int(self.rng.integers(2**31))
        self._renderer = Renderer(1)
        effects = dict(self.true_setup.effects)
        if self.setup.profiler is None:
            effects.setdefault("laser_speckle", expected_speckle(self.setup))
        joint, missing = self.true_setup.joint, self.true_setup.missing
        self._true = replace(self.true_setup, effects=checked(effects, joint, missing))
        self.begin()

    def begin(self) -> None:
        """Reset the tracker, as in a new process."""
        self.tracking = FrameTracking(self.setup)
        if self.job is not None:
            make_passes = partial(SeamPasses, self.job)
            self.tracking = FrameTracking(self.setup, self.job.correction, make_passes=make_passes)

    def finish(self) -> None:
        """End the pass."""
        self.tracking.finish()

    def look(self) -> Shown:
        """Return the image (H, W), DN, that the camera takes now, or the profile (2, columns)."""
        if self.job is not None and self.job.again is not None and not self.job.again.laser:
            return np.zeros(self.setup.frame_shape, self.setup.sensor.dtype)
        T_base_tool = self.robot.T_base_tool()
        true_setup, seam = self._seen(T_base_tool)
        if true_setup.profiler is not None:
            return self._profile(true_setup, T_base_tool, seam)
        exposure_s = self._true.camera.exposure_s if math.isnan(self.exposure_s) else self.exposure_s
        condition = Condition(float(self.is_laser_on), self.level_now(), exposure_s, self.robot.now_s)
        image_dn = draw_frame(
            true_setup,
            T_base_tool,
            condition,
            self.rng,
            seam=seam,
            renderer=self._renderer,
            part_seed=self.part_seed,
        )
        if self.tacks_mm:
            view = self._renderer.layers(apply_setup_effects(true_setup), T_base_tool, seam).view
            self._tack(image_dn, view.surface[0])
        return image_dn

    def _profile(self, true_setup: Setup, T_base_tool: Float64, seam: BentSeam) -> Integers:
        """Return the profile (2, columns) along the stretch that the sheet meets; none with the laser off."""
        sheet_mm = true_setup.laser.origin_in_tool_mm[0]
        station_mm = float(make_scene(true_setup, T_base_tool).T_joint_tool[0] @ [sheet_mm, 0.0, 0.0, 1.0])
        stretch = seam.lines[int(seam.stretch_at(np.array(station_mm)))]
        image = draw_profile(true_setup, make_scene(true_setup, T_base_tool, stretch), self.rng)
        return image if self.is_laser_on else np.zeros_like(image)

    def _tack(self, image_dn: Integers, surface_mm: Float64) -> None:
        """Draw tacks over an image (H, W) that shows points (H, W, 3), mm, joint frame: bright, uneven beads.

        They are drawn on the image alone: a bead hides joint and stripe, but casts no shadow.
        """
        # Past the workpiece there is no bead.
        # Position without a workpiece.
        surface_mm = np.nan_to_num(surface_mm.reshape(*image_dn.shape, 3), nan=1e6)
        station_mm = surface_mm[..., 0] - self.robot.world.start_base_mm[0]
        aside_mm = surface_mm[..., 1]
        # Its rims wander, and its ripples run over the joint beneath.
        # Half-width of a tack's bead.
        rim_mm = 4.0 + 0.8 * np.sin(1.3 * station_mm)
        off_mm = np.abs(aside_mm - 0.8 * np.sin(0.9 * station_mm))
        rows, columns = np.indices(image_dn.shape)
        ripples = 0.7 + 0.2 * np.sin(0.11 * rows) + 0.1 * np.cos(0.07 * columns)
        for first_mm, last_mm in self.tacks_mm:
            is_bead = (first_mm < station_mm) & (station_mm < last_mm) & (off_mm < rim_mm)
            image_dn[is_bead] = (ripples[is_bead] * saturation_dn(self.setup.sensor)).astype(image_dn.dtype)

    def track(self, shown: Shown, capture: Capture) -> TrackedFrame:
        """Track a frame; of poses that are doubted nothing lasts."""
        assert shown is not None
        robot = capture.robot
        frame = Frame(
            index=capture.index,
            timestamp_s=capture.captured_s,
            image_dn=shown,
            exposure_s=self.setup.camera.exposure_s,
            current_a=self.setup.arc.current_a,
            arc_on=robot is not None and robot.arc is Switch.ON,
        )
        return replace(self.tracking.track(frame, capture), took_ms=1000.0 * COMPUTED_S)

    def level_now(self) -> float:
        """Return the arc's output over the expected one."""
        if self.arc_level is not None:
            return self.arc_level(self.robot.now_s)
        return 1.0 if self.robot.status.arc is Switch.ON else 0.0

    def _seen(self, T_base_tool: Float64) -> tuple[Setup, BentSeam]:
        """Return the true setup and seam as they are seen from a pose (4, 4)."""
        world, joint = self.robot.world, self.true_setup.joint
        if world.course is not None:

            def displacement_mm(station_mm: float) -> tuple[float, float]:
                y_mm, z_mm = world.along_mm(station_mm)
                return y_mm + self.aside_mm, z_mm

            seen = TurningSeam(world.course, displacement_mm, world.part_mm).seen_from(
                self._true, T_base_tool
            )
            stations_mm = make_scene(apply_setup_effects(seen.joint_setup), T_base_tool).stations_mm
            return seen.joint_setup, BentSeam.along(seen.line_at, stations_mm[:2], stations_mm[2], False)

        def line(station_mm: float) -> SeamLine:
            # A joint's stations count from base's origin, a world's from where its path begins.
            on_path_mm = station_mm - world.start_base_mm[0]
            y_mm, z_mm = world.seam_mm(on_path_mm)
            slope_y, slope_z = world.seam_slope(on_path_mm)
            return SeamLine(station_mm, y_mm + self.aside_mm, z_mm, slope_y, slope_z)

        first_mm, last_mm, torch_mm = make_scene(apply_setup_effects(self._true), T_base_tool).stations_mm
        return self._true, BentSeam.along(line, (first_mm, last_mm), torch_mm, joint.has_ridges)
