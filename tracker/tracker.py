"""The tracker as most callers hold it: a setup's tables, the state between frames and the scratch."""

from __future__ import annotations

import warnings

from noise_model.setup import Setup
from tracker import flags
from tracker.geometry import SensorGeometry
from tracker.observation import Reading
from tracker.seam.correction import UNSTATED, Correction
from tracker.state import AT_ONCE, Frame, OffsetLookAhead, Pose, Track, frame_misfit
from tracker.step import step
from tracker.stripe.read import Work
from tracker.tracker_state import TrackerMemory
from tracker.warm_up import OnCompiled, WarmUp, warm_up


class Tracker:
    """A seam tracker: `step` takes a frame and its pose, and returns a track.

    Parameters
    ----------
    setup : Setup
        The nominal setup.
    use_arc_map : bool
        False reads the stripe over a local median with one variance for all pixels, for comparison.
    correction : Correction
        What of the seam's displacement is sent; by default the displacement as it is.
    """

    def __init__(self, setup: Setup, use_arc_map: bool = True, correction: Correction = UNSTATED) -> None:
        self.geometry = SensorGeometry.of(setup)
        self.state = TrackerMemory()
        self.reading: Reading | None = None
        self.use_arc_map = use_arc_map
        self.correction = correction
        self._work = Work.of(self.geometry)

    def __repr__(self) -> str:
        setup = self.geometry.setup
        means = "with the arc map" if self.use_arc_map else "without the arc map"
        size = f"{setup.camera.width} x {setup.camera.height} px"
        return f"Tracker(a {setup.joint.type} seen by {size}, {means}; {self.state.frames} frames so far)"

    def step(self, frame: Frame, pose: Pose | None, lead: OffsetLookAhead = AT_ONCE) -> Track:
        """Track one frame and keep the new state.

        Nothing about a frame raises: what is not known is NaN, with a flag that says why. A frame that is not
        of the setup's size and type is warned of: no seam was looked for in it.

        Parameters
        ----------
        frame : Frame
            A raw frame and its condition.
        pose : Pose or None
            The tool's pose at the frame's time, None where there is none.
        lead : OffsetLookAhead
            When, and how much farther along the seam, the correction will act.

        Returns
        -------
        Track
            The seam, the offset at the torch, their sigmas and the flags.
        """
        self.state, track, self.reading = step(
            geometry=self.geometry,
            state=self.state,
            frame=frame,
            pose=pose,
            work=self._work,
            use_arc_map=self.use_arc_map,
            correction=self.correction,
            lead=lead,
        )
        if track.flags & flags.FRAME_UNREADABLE.mask:
            misfit = frame_misfit(frame.image_dn.shape, frame.image_dn.dtype, self.geometry.setup)
            warnings.warn(f"frame {frame.index} {misfit}", stacklevel=2)
        return track

    def warm_up(self, on_compiled: OnCompiled | None = None) -> WarmUp:
        """Compile and load all that a step may need: afterwards no frame waits for it.

        The first time on a machine takes a minute, on a slow one several; what is compiled is kept on disk.
        The state is not touched.

        Parameters
        ----------
        on_compiled : callable, optional
            Hears each function's name as its compilation begins, how many there were before it, and seconds.

        Returns
        -------
        WarmUp
            How many functions were compiled, and the seconds in all.
        """
        return warm_up(self.geometry, self.correction, self.use_arc_map, on_compiled)
