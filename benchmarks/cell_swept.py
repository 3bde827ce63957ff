"""Welds in the simulated cell whose camera shares nothing with the forward model.

    python benchmarks/cell_swept.py [--joint JOINT] [--displaced-mm D] [--seed N] [--length-mm L]

As `arctrack cell run`, but `swept_world` casts the rays, computes the arc's light and draws the speckle.
Tracker, bus, controller and robot are those of the cell. Prints how far the torch is off the seam.
"""

from __future__ import annotations

import argparse

import numpy as np

from arctrack.nominal import DIMENSIONS
from arctrack.simulation.cell.cell import Shown
from arctrack.simulation.cell.weld.closed_loop import ClosedLoop, LoopPlan
from arctrack.simulation.cell.weld.rendered_camera import RenderedCamera
from noise_model.plan.noise import expected_speckle
from noise_model.surface.joint import seam_frame
from noise_model.transforms import invert
from robot_io import Switch
from validation.anywhere.swept_joint import SweptJoint
from validation.anywhere.swept_light import SceneSurroundings
from validation.anywhere.swept_world import SpeckleField, SweptWorld


class SweptCamera(RenderedCamera):
    """A rendered eye whose images come from a swept world; the seam may be displaced, not bent."""

    def __post_init__(self) -> None:
        super().__post_init__()
        speckle = expected_speckle(self.setup)
        self._swept = SweptWorld(
            self.true_setup,
            SweptJoint.of(self.true_setup.joint, 0.0, 1000.0, 0.0),
            SpeckleField(speckle["contrast"], speckle["grain_px"]),
            SceneSurroundings(),
        )

    def look(self) -> Shown:
        """Return the image (H, W), DN, that the camera takes now."""
        y_mm, z_mm = self.robot.world.seam_mm(self.robot.station_mm)
        joint = self.true_setup.joint
        T_base_seam = seam_frame(joint, np.asarray(joint.seam_in_base_mm[0]))
        T_base_seam[:3, 3] += T_base_seam[:3, :3] @ (0.0, y_mm + self.aside_mm, z_mm)
        T_seam_tool = invert(T_base_seam) @ self.robot.T_base_tool()
        arc_on = self.robot.status.arc is Switch.ON
        return self._swept.frame(np.ascontiguousarray(T_seam_tool), True, arc_on, self.rng)


def main() -> None:
    """Run one weld."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--joint", default="lap", choices=sorted(DIMENSIONS))
    parser.add_argument("--displaced-mm", type=float, default=3.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--length-mm", type=float, default=60.0)
    options = parser.parse_args()
    plan = LoopPlan(
        joint=options.joint,
        displaced_mm=options.displaced_mm,
        length_mm=options.length_mm,
        seed=options.seed,
    )
    loop = ClosedLoop(plan)
    draw = np.random.default_rng([plan.seed, 4])
    loop.cell.tracker.camera = SweptCamera(loop.cell.robot.robot, loop.setup, loop.setup, draw)
    loop.cell.tracker.start()
    result = loop.run()
    print(f"{plan.joint}, displaced by {plan.displaced_mm:+g} mm: locked after {result.lock_s:.2f} s")
    print(
        f"torch off the seam by {result.rms_mm:.3f} mm RMS "
        f"(across {result.rms_y_mm:.3f}, height {result.rms_z_mm:.3f}), {result.max_mm:.3f} mm at most"
    )
    print(f"{result.offsets}; {result.reasons}; weave {result.weave_mm:.3f} mm")


if __name__ == "__main__":
    main()
