"""The sensor's tables of recording.toml: camera, sensor, filter, laser.

The physics is imported once the keys are right: it takes seconds, and a misspelt key needs none of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from arctrack.limits import LIMITS, source_of
from arctrack.recording.schema import MAX_NUMBER, Bounds, Table, key, within
from noise_model.compiled.arrays import Float64
from noise_model.setup_keys import COEFFICIENTS

if TYPE_CHECKING:
    from noise_model.instrument.profiler import Profiler
    from noise_model.instrument.spectrum import Filter, FilterCurve

# One bound for each type: pydantic leaves out that of a field whose type has its own.
Number = Annotated[float, Field(ge=-MAX_NUMBER, le=MAX_NUMBER)]
IN_TOOL = Bounds(-1e4, 1e4, "ten metres")
PointInTool = Annotated[list[Annotated[float, within(IN_TOOL)]], Field(min_length=3, max_length=3)]
Vector3 = Annotated[list[Number], Field(min_length=3, max_length=3)]
Vector4 = Annotated[list[Number], Field(min_length=4, max_length=4)]
Distortions = Annotated[
    list[Annotated[float, within(Bounds(-1e4, 1e4, "k3 of long lenses is in the thousands"))]],
    Field(min_length=min(COEFFICIENTS), max_length=max(COEFFICIENTS)),
]
SIDE = Bounds(None, LIMITS.side_px, source_of("side_px"))
FOCAL = Bounds(1.0, 1e6, "a field of view of a half space; a 1 m lens on pixels of 1 um")
CENTER = Bounds(-1e5, 1e5, "six times the longest side")
PITCH = Bounds(1e-4, 10.0, "profilers resolve 0.002 to 1 mm")
GAMMA = Bounds(0.1, 10.0, "cameras show 0.4 to 2.5")


class RigidPoseTable(Table):
    """A rigid pose of a frame in the tool frame."""

    translation_mm: PointInTool = key("Where the frame's origin stands in the tool frame: x, y, z", "mm")
    quaternion_xyzw: Vector4 = key(
        "How the frame is turned in the tool frame: unit quaternion, x y z w, w last"
    )

    def matrix(self, place: str) -> Float64:
        """Return the pose as a 4x4 matrix; ValueError names `place` if it is no rotation."""
        from noise_model.transforms import pose_matrix

        try:
            return pose_matrix(self.translation_mm, self.quaternion_xyzw)
        except ValueError as error:
            raise ValueError(f"[{place}] quaternion_xyzw: {error}") from None


class CameraPoseTable(RigidPoseTable):
    """The camera's pose, T_tool_camera."""

    translation_mm: PointInTool = key(
        "Where the camera's centre stands in the tool frame: x, y, z",
        "mm",
        "50 to 250 from the tool's origin",
        "a calibration. `arctrack calibrate hand-eye` from images of a board, or the drawing; the arc's "
        "light refines it. The tool frame: origin at the electrode's working point, x along the travel, y "
        "to its left, z away from the part.",
    )
    quaternion_xyzw: Vector4 = key(
        "How the camera is turned in the tool frame: unit quaternion, x y z w, w last",
        "",
        "length 1",
        "a calibration. As the translation. The camera's axes are OpenCV's: x to the right in the image, y "
        "down, z forward.",
    )


class ProfilePoseTable(RigidPoseTable):
    """The profile's pose, T_tool_profile: y along the columns, z up, away from the part."""

    translation_mm: PointInTool = key(
        "Where the middle column's z = 0 stands in the tool frame: x, y, z",
        "mm",
        "20 to 100 ahead",
        "a calibration, or the drawing. The tool frame: origin at the electrode's working point, x along the "
        "travel, y to its left, z away from the part.",
    )
    quaternion_xyzw: Vector4 = key(
        "How the profile is turned in the tool frame: unit quaternion, x y z w, w last",
        "",
        "[0, 0, 0, 1], or [0, 0, 1, 0] where the columns run to the right",
        "a calibration, or the drawing. The profile's axes: y along rising columns, z up, x = y x z.",
    )


class CameraTable(Table):
    """The camera and its lens."""

    width: int = key(
        "The image's width",
        "px",
        "320 to 2048",
        "the data sheet. Of the frames that you record: a region of interest counts, not the whole sensor.",
        bounds=SIDE,
    )
    height: int = key("The image's height", "px", "240 to 2048", "the data sheet. As the width.", bounds=SIDE)
    fx: float = key(
        "Focal length across the image",
        "px",
        "1000 to 6000",
        "a calibration. `arctrack calibrate camera`, with a chessboard. Check: focal_length_mm over the "
        "pixel's size in mm, some 10 % more when focused near by.",
        bounds=FOCAL,
    )
    fy: float = key(
        "Focal length down the image", "px", "1000 to 6000", "a calibration. As fx.", bounds=FOCAL
    )
    cx: float = key(
        "Where the optical axis meets the image, from the first pixel's centre",
        "px",
        "0.4 to 0.6 of the width",
        "a calibration. `arctrack calibrate camera`. Check: near (width - 1) / 2.",
        bounds=CENTER,
    )
    cy: float = key(
        "The same down the image", "px", "0.4 to 0.6 of the height", "a calibration. As cx.", bounds=CENTER
    )
    distortion: Distortions = key(
        "The lens' distortion, OpenCV's k1 k2 p1 p2 k3, or its first 8 (k4 k5 k6) or 14 (s1 to s4, tau_x, "
        "tau_y in rad) coefficients",
        "",
        "k1 -0.3 to 0.3",
        "a calibration. `arctrack calibrate camera` chooses how many it needs. All 0 for a lens that has "
        "none.",
    )
    focal_length_mm: Number = key(
        "The lens' focal length", "mm", "8 to 50", "the data sheet. On the lens. Only planning uses it."
    )
    f_number: Number = key(
        "The aperture", "", "4 to 16", "your choice. As set on the lens. Only planning uses it."
    )
    psf_sigma_px: float = key(
        "Blur of lens and pixel together: 1 sigma of a Gaussian",
        "px",
        "0.5 to 1.5",
        "a picture. Of a sharp edge in focus: the distance over which it rises from 16 % to 84 % is 2 sigma.",
        bounds=Bounds(None, 100.0, "at 100 px no stripe is left to find"),
    )
    exposure_s: Number = key(
        "The usual exposure", "s", "0.0001 to 0.02", "your choice. frames.csv states that of each frame."
    )
    pixel_format: str = key(
        "The pixels' format, a monochrome one", "", "mono8, mono12", "the data sheet. As set on the camera."
    )
    pose_in_tool: CameraPoseTable


class ProfilerTable(Table):
    """A laser profiler in the camera's place: it gives heights, no images."""

    kind: Literal["profile"] = key("What the camera gives: profiles, each a height over its columns")
    columns: int = key(
        "Columns of a profile",
        "",
        "320 to 4096",
        "the data sheet. Files with other places are laid on these columns.",
        bounds=Bounds(16, LIMITS.side_px, source_of("side_px")),
    )
    pitch_mm: float = key(
        "Distance of two columns",
        "mm",
        "0.01 to 0.3",
        "the data sheet. The resolution in x of the sensor's setting.",
        bounds=PITCH,
    )
    range_mm: float = key(
        "Span of the heights, whose middle is the profile's z = 0",
        "mm",
        "10 to 300",
        "the data sheet. The measuring range in z. 65534 codes span it.",
        bounds=Bounds(0.1, 1e4, "ten metres"),
    )
    stand_off_mm: float = key(
        "Height of the laser's window over the profile's z = 0",
        "mm",
        "50 to 500",
        "the data sheet. The clearance distance and half the measuring range.",
        bounds=Bounds(1.0, 1e4, "ten metres"),
    )
    sigma_mm: float = key(
        "1 sigma of a single height; what heights scatter beyond it is learned from frame to frame",
        "mm",
        "0 to 0.05",
        "the data sheet. The repeatability of one point, not of a mean.",
        default=0.0,
        bounds=Bounds(0.0, 10.0, "a height that is known worse shows no joint"),
    )
    point_sigma: bool = key(
        "Whether profiles have a third row, each height's own 1 sigma; `sigma_mm` holds where it is unknown",
        "",
        "",
        "the sensor. True if its program gives a sigma of each point.",
        default=False,
    )
    exposure_s: Number = key(
        "The usual exposure", "s", "0.0001 to 0.01", "your choice. frames.csv states that of each frame."
    )
    pose_in_tool: ProfilePoseTable

    def to_profiler(self) -> Profiler:
        """Return the profiler; ValueError names the key of what cannot be."""
        from noise_model.instrument.profiler import Profiler

        values = self.known
        del values["kind"], values["pose_in_tool"]
        return Profiler(T_tool_profile=self.pose_in_tool.matrix("camera.pose_in_tool"), **values)


class SensorTable(Table):
    """The sensor: charge to grey levels, noise, saturation."""

    bits: int = key("Bits of a pixel as recorded, 8 to 16", "", "8 to 12", "the data sheet. 8 for mono8.")
    gain_e_per_dn: Number = key(
        "Charge for one grey level, at full well or for gamma 1",
        "e-/DN",
        "5 to 150 at 8 bits",
        "the data sheet. EMVA 1288 calls its inverse the system gain K. Check: full_well_e over the highest "
        "grey level. `arctrack calibrate sensor` measures it.",
    )
    black_level_dn: float = key(
        "The mean grey level without light",
        "DN",
        "1 to 20 at 8 bits",
        "a picture. The mean of a frame with the lens covered; `arctrack calibrate sensor` measures it. It "
        "must be above 0, or noise is cut off.",
        bounds=Bounds(-65535, 65535, "the codes of 16 bits"),
    )
    read_noise_e: Number = key(
        "Noise without light: 1 sigma",
        "e-",
        "2 to 60",
        "the data sheet. EMVA 1288's temporal dark noise. `arctrack calibrate sensor` measures it.",
    )
    full_well_e: Number = key(
        "The charge at which a pixel is full",
        "e-",
        "5000 to 100000",
        "the data sheet. EMVA 1288's saturation capacity; gain_e_per_dn times the highest grey level where "
        "that is less. `arctrack calibrate sensor` measures it on flat frames.",
    )
    gamma: float = key(
        "The response's exponent: 1 where twice the light is twice the grey level",
        "",
        "1, or 0.45 with gamma on",
        "your choice. Switch the camera's gamma off, and state 1. `arctrack calibrate sensor` measures it "
        "on flat frames.",
        bounds=GAMMA,
    )


class FilterTable(Table):
    """The interference filter; a measured curve, where there is one, stands in for centre and width."""

    center_nm: Number = key(
        "The passband's centre", "nm", "635 to 850", "the data sheet. At normal incidence."
    )
    fwhm_nm: Number = key("The passband's full width at half height", "nm", "2 to 30", "the data sheet.")
    effective_index: Number = key(
        "By how much the passband moves under an angle: the effective index",
        "",
        "1.4 to 2.2",
        "the data sheet. The maker's n_eff. `arctrack calibrate filter` takes a measured curve.",
    )
    curve_wavelength_nm: list[Number] | None = key(
        "Wavelengths of a measured curve",
        "nm",
        "",
        "a calibration. `arctrack calibrate filter`.",
        default=None,
    )
    curve_transmission: list[Number] | None = key(
        "The transmission at each of them, 0 to 1", "", "", "a calibration. As the wavelengths.", default=None
    )

    def to_filter(self) -> Filter | FilterCurve:
        """Return the filter; ValueError names the key of a curve that cannot be."""
        from noise_model.instrument.spectrum import CurveError, Filter, FilterCurve

        wavelengths, transmission = self.curve_wavelength_nm, self.curve_transmission
        if wavelengths is None and transmission is None:
            return Filter(self.center_nm, self.fwhm_nm, self.effective_index)
        if wavelengths is None or transmission is None:
            raise ValueError(
                "[filter] curve_wavelength_nm, curve_transmission: one is given without the other"
            )
        try:
            return FilterCurve(np.array(wavelengths), np.array(transmission), self.effective_index)
        except CurveError as error:
            raise ValueError(f"[filter] curve_wavelength_nm, curve_transmission: {error}") from None


class LaserTable(Table):
    """The sheet of light."""

    wavelength_nm: Number = key("The laser's wavelength", "nm", "635 to 850", "the data sheet.")
    plane_in_tool: Vector4 = key(
        "The sheet of light in the tool frame: n_x, n_y, n_z, d of n·p + d = 0, n of length 1, d in mm",
        "",
        "30 to 60 ahead",
        "a calibration. `arctrack calibrate laser`, from images of a board without and with the stripe; "
        "`arctrack calibrate sheet`, from a scan of any flat plate; `arctrack calibrate gauge`, from the "
        "stripe on a block of known size. An upright sheet 35 mm ahead of the torch is [1, 0, 0, -35].",
    )
    origin_in_tool_mm: PointInTool = key(
        "Where the sheet fans out from: x, y, z in the tool frame",
        "mm",
        "80 to 300 above the part",
        "a ruler or the drawing. The laser's exit window, to a few mm. It must lie in the sheet.",
    )
    stripe_sigma_mm: Number = key(
        "The sheet's half thickness where it meets the part: 1 sigma",
        "mm",
        "0.05 to 0.6",
        "a calibration. `arctrack calibrate laser`. Check: the stripe's full width at half height over "
        "2.35; a width in px times the distance over fx is mm.",
    )
    peak_e: Number = key(
        "The stripe's peak on a flat plate at the tool's height, before the blur, middle column",
        "e-",
        "0.2 to 0.8 of full_well_e",
        "a picture. Arc off: the stripe's highest grey level less the black level, times gain_e_per_dn.",
    )
    fan_half_angle_deg: Number | None = key(
        "Where the fan of light ends to either side of its axis, the steepest line in the sheet",
        "deg",
        "5 to 45",
        "the data sheet. Without it the stripe is longer than the image shows. Half the fan angle; "
        "`arctrack calibrate laser` measures it. Check: half the stripe's length over the laser's height is "
        "its tangent.",
        default=None,
        example="30.0",
    )
    bow: Number = key(
        "The sheet's bow off its plane: bow u²/z mm along the plane's normal, u mm to either side of the "
        "fan's axis and z mm below the origin",
        "",
        "-0.2 to 0.2",
        "a calibration. `arctrack calibrate laser` fits it where the boards show one. Check: how far the "
        "stripe's middle on a flat plate lies off the line through its ends, times the laser's height, over "
        "the square of half its length.",
        default=0.0,
    )
