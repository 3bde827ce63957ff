"""Camera that a subprocess captures: drivers and decoding never touch the loop."""

import os
from functools import partial
from pathlib import Path

from arctrack.control.cell_file import CameraChoice
from arctrack.errors import ArctrackError, in_file
from arctrack.live.cameras.camera import CameraTraits
from arctrack.live.cameras.capture.device import device_source
from arctrack.live.cameras.capture.files import folder_source, sidecar_of, video_source
from arctrack.live.cameras.capture.gige import gige_source
from arctrack.live.cameras.capture.process import OVER, Open, run_capture
from arctrack.live.cameras.capture.profile_stream import profile_stream
from arctrack.live.cameras.shared_frames import path_of
from arctrack.live.cameras.shared_memory import SharedMemoryCamera
from arctrack.live.journal.message_pipe import message_pipe
from arctrack.live.serve.supervisor import SupervisedProcess
from noise_model.setup import Setup

ENDS_S = 10.0
"""Time that a driver may take to release its camera."""


class CapturedCamera(SharedMemoryCamera):
    """Camera that is read by a subprocess of this one.

    Paths are relative to the cell file. Raises ArctrackError if the camera cannot be opened, or its
    frames do not fit the setup.
    """

    def __init__(self, choice: CameraChoice, cell_path: Path, setup: Setup) -> None:
        try:
            opened, traits = _opening(choice, cell_path, setup)
        except ArctrackError as error:
            raise in_file(cell_path, str(error)) from None
        name = f"captured-{os.getpid()}"
        self._pipe, its_end = message_pipe()
        self.process = SupervisedProcess(
            "camera", run_capture, (opened, setup, name), (its_end,), ends_s=ENDS_S
        )
        try:
            self.process.wait_ready()
            super().__init__(name, setup, traits)
        except ArctrackError as error:
            self.process.end()
            text = str(error)
            raise in_file(cell_path, text) if text.startswith("[camera]") else error from None
        self._is_ended = False

    @property
    def frames_path(self) -> Path:
        """Path of its frames in memory."""
        return path_of(self._name)

    @property
    def is_over(self) -> bool:
        """True once a file has come to its end, and all of it was handed out."""
        if not self._is_ended and self._pipe.poll():
            self._is_ended = self._pipe.recv() == OVER
        return self._is_ended and self.is_newest_read

    def begin(self) -> None:
        """Let it capture."""
        self._pipe.send(True)

    def close(self) -> None:
        """Read no more, and let the process end."""
        super().close()
        self.process.end()


def _opening(choice: CameraChoice, cell_path: Path, setup: Setup) -> tuple[Open, CameraTraits]:
    assert choice.name is not None
    options = choice.capture
    if choice.kind in ("video", "folder"):
        path = (cell_path.parent / choice.name).absolute()
        traits = CameraTraits(knows_arc=sidecar_of(path).exists(), switches_laser=False)
        if choice.kind == "video":
            return partial(video_source, path, setup, options.loop), traits
        return partial(folder_source, path, setup, choice.frame_rate_hz, options.loop), traits
    if choice.kind == "profile_tcp":
        if setup.profiler is None:
            raise ArctrackError(
                "[camera] kind = 'profile_tcp': gives profiles, the setup's camera gives images; "
                "state kind = 'profile' in the setup's [camera]"
            )
        traits = CameraTraits(knows_arc=False, switches_laser=False)
        return partial(profile_stream, choice.name, setup.profiler), traits
    if setup.profiler is not None:
        raise ArctrackError(
            f"[camera] kind = {choice.kind!r}: gives images, the setup's camera is a profiler; "
            "state kind = 'profile_tcp' or 'shared_memory'"
        )
    if choice.kind == "device":
        traits = CameraTraits(knows_arc=False, switches_laser=False)
        return partial(device_source, choice.name, setup, choice.frame_rate_hz), traits
    switches = options.laser_line is not None
    traits = CameraTraits(False, switches, interleaves=options.interleave is not None)
    return partial(gige_source, choice, setup), traits
