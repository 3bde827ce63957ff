"""The camera: whether it is there, how many frames come, and how old they are when they come."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

from arctrack.control.cell_file import CellFile
from arctrack.errors import ArctrackError
from arctrack.live.cameras.camera import CameraProtocol, UnreadableFrame
from arctrack.live.doctor.finding import POLICY, DoctorFinding, FindingState, judged
from arctrack.live.serve.latency import LatencyCounts, Quantiles
from arctrack.live.serve.live_run import run_parts

SLOW_SHARE = 0.9
"""Least share of the stated frame rate: a second's count is off by one at most."""


@dataclass(frozen=True)
class CameraReading:
    """Frames that a camera delivered: count, unusable ones, rate, and age on arrival since mid-exposure."""

    frames: int
    unreadable: int
    rate_hz: float
    age: Quantiles


def watch(camera: CameraProtocol, seconds: float) -> CameraReading:
    """Look at what a camera gives, for some seconds, or until it is over."""
    ages, frames, unreadable = LatencyCounts(), 0, 0
    camera.begin()
    began_s = time.monotonic()
    while time.monotonic() - began_s < seconds and not camera.is_over:
        frame = camera.newest()
        if frame is not None:
            frames += 1
            unreadable += isinstance(frame, UnreadableFrame)
            ages.add(camera.now_s() - frame.timestamp_s)
        time.sleep(0.001)
    watched_s = time.monotonic() - began_s
    return CameraReading(frames, unreadable, (frames + camera.dropped) / watched_s, ages.quantiles())


def camera_findings(cell: CellFile) -> Iterator[DoctorFinding | CameraReading]:
    """Yield the findings about a cell's camera, and what it gave where it is live.

    What opens it is what opens it for a run, whatever its kind. Its laser is off meanwhile.
    """
    kind, name = cell.camera.kind, cell.camera.name
    if kind is None:
        cure = "state [camera] kind and name"
        yield DoctorFinding(
            "camera", FindingState.WARNING, "the cell file states none: nothing is run live", cure
        )
        return
    job_number = next(iter(cell.jobs)) if kind == "recording" else None
    try:
        camera = run_parts(cell, job_number).camera
    except ArctrackError as error:
        yield DoctorFinding("camera", FindingState.FAILED, str(error))
        return
    try:
        yield DoctorFinding("camera", FindingState.OK, f"{kind} {name} opens")
        watched = watch(camera, POLICY.listen_s)
    finally:
        camera.close()
    yield from frames_findings(watched, cell.camera.frame_rate_hz)
    if kind != "recording" and watched.frames > 0:
        yield watched


def frames_findings(watched: CameraReading, rate_hz: float) -> Iterator[DoctorFinding]:
    """Yield the findings about frames that came, against the stated frame rate."""
    if watched.frames == 0:
        cure = "start the camera; is it waiting for a trigger?"
        yield DoctorFinding("frames", FindingState.FAILED, f"none came in {POLICY.listen_s:g} s", cure)
        return
    text = f"{watched.rate_hz:.1f} a second, the cell file states {rate_hz:g}"
    cure = "state what it gives in [camera] frame_rate_hz, or see what slows it"
    few = f"{watched.frames} came: too few to tell how many come a second"
    if watched.frames * SLOW_SHARE > 1.0 and rate_hz * POLICY.listen_s > 10.0:
        yield judged("frames", text, FindingState.WARNING, cure, watched.rate_hz >= SLOW_SHARE * rate_hz)
    else:
        yield DoctorFinding("frames", FindingState.OK, few)
    if watched.unreadable:
        text = f"{watched.unreadable} of {watched.frames} do not fit the setup"
        yield DoctorFinding(
            "frames", FindingState.FAILED, text, "state width, height and bits of the camera in the setup"
        )
    yield DoctorFinding("age", FindingState.OK, f"from mid-exposure to arrival {watched.age}")
