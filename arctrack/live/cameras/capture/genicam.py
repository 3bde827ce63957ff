"""A GigE Vision camera set up by its GenICam features: region, pixels, exposure, trigger, laser."""

import importlib.util
import sys
from importlib.machinery import PathFinder
from typing import Any

from arctrack.control.cell_file import CameraChoice
from arctrack.errors import ArctrackError
from noise_model.setup import Setup

US = 1e-6

CURE = "install the packages gir1.2-aravis-0.8 and python3-gi, or pip install 'arctrack[gige]'"


def aravis() -> tuple[Any, Any]:
    """Return Aravis and GLib; ArctrackError where they are not installed."""
    try:
        if importlib.util.find_spec("gi") is None:
            _import_debians_gi()
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis, GLib
    except (ImportError, ValueError) as error:
        raise ArctrackError(f"[camera] kind = 'gige': {error}; {CURE}") from None
    return Aravis, GLib


def _import_debians_gi() -> None:
    # Debian's package python3-gi lies where a virtual environment does not look.
    spec = PathFinder.find_spec("gi", ["/usr/lib/python3/dist-packages"])
    if spec is None or spec.loader is None:
        return
    sys.modules["gi"] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except ImportError:
        # It is compiled for the Python of Debian.
        del sys.modules["gi"]
        raise


def set_up(camera: Any, choice: CameraChoice, setup: Setup) -> float:
    """Set a camera up as a cell file and its setup say, and return its exposure, s.

    Raises ArctrackError for what the camera cannot do, and GLib.Error where it does not answer.
    """
    Aravis, _ = aravis()
    camera.set_acquisition_mode(Aravis.AcquisitionMode.CONTINUOUS)
    name, known = f"Mono{setup.sensor.bits}", camera.dup_available_pixel_formats_as_strings()
    if name not in known:
        grey = ", ".join(sorted(k for k in known if k.startswith("Mono") and k[4:].isdigit())) or "none"
        raise ArctrackError(
            f"[camera] name: the camera has no {name}; it has {grey}: state its bits as [sensor] bits"
        )
    camera.set_pixel_format_from_string(name)
    _choose_region(camera, choice, setup)
    if camera.is_gain_auto_available():
        camera.set_gain_auto(Aravis.Auto.OFF)
    if camera.is_exposure_auto_available():
        camera.set_exposure_time_auto(Aravis.Auto.OFF)
    exposure_s = set_exposure(camera, setup.camera.exposure_s)
    _choose_trigger(camera, choice)
    if choice.capture.laser_line is not None:
        _choose_laser(camera, choice)
        switch_laser(camera, choice, False)
    if camera.is_gv_device():
        camera.gv_auto_packet_size()
    return exposure_s


def set_exposure(camera: Any, exposure_s: float) -> float:
    """Set an exposure, and return what the camera made of it, s."""
    camera.set_exposure_time(exposure_s / US)
    return float(camera.get_exposure_time()) * US


def switch_laser(camera: Any, choice: CameraChoice, is_on: bool) -> None:
    """Let the laser's line be driven, or not."""
    if choice.capture.laser == "switch":
        camera.set_string("UserOutputSelector", "UserOutput1")
        camera.set_boolean("UserOutputValue", is_on)
        return
    camera.set_string("LineSelector", choice.capture.laser_line)
    camera.set_string("LineSource", "ExposureActive" if is_on else "Off")


def _choose_region(camera: Any, choice: CameraChoice, setup: Setup) -> None:
    if choice.capture.rows is not None:
        first, count = choice.capture.rows
        if not camera.is_region_offset_available():
            raise ArctrackError("[camera] rows: the camera has no OffsetY; leave rows out")
        region = camera.get_region()
        # An offset that is kept may not leave room for the new height.
        camera.set_region(region.x, 0, region.width, count)
        camera.set_region(region.x, first, region.width, count)
    region, wanted = camera.get_region(), setup.camera
    if choice.capture.rows is not None and (region.y, region.height) != choice.capture.rows:
        raise ArctrackError(
            f"[camera] rows = {list(choice.capture.rows)}: the camera makes [{region.y}, {region.height}] "
            "of it; state what it can do"
        )
    if (region.width, region.height) != (wanted.width, wanted.height):
        raise ArctrackError(
            f"[camera] name: the camera gives {region.width} x {region.height} px, the setup's [camera] says "
            f"{wanted.width} x {wanted.height}; state the size of its region, or choose rows"
        )


def _choose_trigger(camera: Any, choice: CameraChoice) -> None:
    trigger = choice.capture.trigger
    if camera.is_frame_rate_available():
        # This ends all triggers too. A rate that is kept would hold triggered frames up.
        min_hz, max_hz = camera.get_frame_rate_bounds()
        wanted_hz = choice.frame_rate_hz if trigger == "free" else max_hz
        camera.set_frame_rate(min(max(wanted_hz, min_hz), max_hz))
    camera.clear_triggers()
    if trigger == "free":
        return
    line = "Software" if trigger == "software" else choice.capture.trigger_line
    known = camera.dup_available_trigger_sources()
    if line not in known:
        key = "trigger" if trigger == "software" else "trigger_line"
        raise ArctrackError(
            f"[camera] {key} = {line!r}: the camera has no such source; it has {', '.join(known)}"
        )
    camera.set_trigger(line)


def _choose_laser(camera: Any, choice: CameraChoice) -> None:
    line = choice.capture.laser_line
    if not camera.is_feature_available("LineSource"):
        raise ArctrackError("[camera] laser_line: the camera switches no line; leave it out")
    known = camera.dup_available_enumerations_as_strings("LineSelector")
    if line not in known:
        raise ArctrackError(
            f"[camera] laser_line = {line!r}: the camera has no such line; it has {', '.join(known)}"
        )
    camera.set_string("LineSelector", line)
    if camera.is_feature_available("LineMode"):
        camera.set_string("LineMode", "Output")
    if choice.capture.laser == "switch":
        camera.set_string("LineSource", "UserOutput1")
