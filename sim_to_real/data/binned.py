"""A recording as the diagnosis sees it: frames binned, with their poses, seams and usable pixels."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
from scipy.stats import chi2

from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Bool, Float32, Float64, Int64, Integers
from noise_model.condition import Condition
from noise_model.effects import Values, apply_setup_effects, pose_time_s
from noise_model.forward import Layers, Renderer
from noise_model.instrument.camera import Camera
from noise_model.instrument.sensor import linearise, respond_moments, saturation_dn
from noise_model.setup import Setup
from noise_model.transforms import moved
from sim_to_real.data.blocks import DETAIL_2X2, block_means, dilate, near_face_edges, weighted_sums_in_bins
from tracker.seam.curve import SeamCurve
from tracker.seam_observations import TRIANGULATION_EFFECTS, SeamObservations
from tracker.state import Frame, Pose

PoseAt = Callable[[float], Pose | None]
"""The tool's pose as the controller stamped it for a time, None where there is none."""

FLOOR_REL, FLOOR_DN = 0.006, 0.05
"""The model's floor, its own error in a bin: relative to the light, and in DN."""

STRIPE_RIM_BINS = 5
"""The side of the square by which the stripe is dilated: what blurs into it, or where it moves to."""

STRATA = ("dark", "laser", "arc", "both")
"""The strata of frames: what is on."""


@dataclass(frozen=True, eq=False)
class ObservedFrame:
    """One frame.

    `stratum` names the sources that are on, `condition` the stated one, `stations_mm` the first and last seen
    station of the seam, and the torch's. `image_dn` (H, W) is the frame, `binned_dn` (h, w) its means over
    bins. `keep` (h, w) are the bins that count: unsaturated, off edges of joint and shadow, thinned;
    `kept_dn` (n,) their means, `rendered` (h, w) adds the saturated ones, whose light may overflow, and the
    stripe with its rim; `sigma_dn` (n,) the noise of these with the model's floor, `in_stripe` (n,) whether
    the laser lights them. `shown_dn2` (n,) is the part of that variance which the recording shows beyond the
    stated noise. `stated_e` (h, w) is the light that the nominal setup puts there along the tracked seam, e-,
    and `stated_arc_e` that of the arc, for the nominal exposure and output.
    """

    position: int
    index: int
    timestamp_s: float
    stratum: str
    condition: Condition
    pose_at: Callable[[float], Float64]
    stations_mm: tuple[float, float, float]
    image_dn: Integers
    binned_dn: Float32
    keep: Bool
    rendered: Bool
    sigma_dn: Float64
    in_stripe: Bool
    stated_e: Float32
    stated_arc_e: Float32
    shown_dn2: Float64

    @cached_property
    def bins(self) -> Int64:
        """The places (n,) of the bins that count in the flattened frame."""
        return np.flatnonzero(self.keep)

    @cached_property
    def kept_dn(self) -> Float64:
        """The means of the bins that count (n,)."""
        return self.binned_dn.reshape(-1)[self.bins].astype(np.float64)

    def with_bins(self, chosen: Int64) -> "ObservedFrame":
        """Return the frame with some of its bins alone, (n,) by their places among those that count."""
        keep = np.zeros_like(self.keep)
        keep.reshape(-1)[self.bins[chosen]] = True
        return replace(
            self,
            keep=keep,
            sigma_dn=self.sigma_dn[chosen],
            in_stripe=self.in_stripe[chosen],
            shown_dn2=self.shown_dn2[chosen],
        )

    def T_base_tool_in(self, setup: Setup, later_s: float = 0.0) -> Float64:
        """Return the tool's pose as the frame was taken, by a setup's clocks, or somewhat later."""
        return self.pose_at(pose_time_s(setup, self.timestamp_s) + later_s)


@dataclass(frozen=True, eq=False)
class ObservedRecording:
    """A recording's frames, and its seam as the tracker found it by `seam_observations`.

    The first six modes of the `seam` are those of the camera's pose. `setup` is as stated, `binned` the same
    with a camera of `bin_px` wide bins. `is_metal_fitted` is True where the setup states no metal and that of
    the stripe was fitted.
    """

    setup: Setup
    binned: Setup
    bin_px: int
    seam: SeamCurve
    seam_observations: SeamObservations
    frames: tuple[ObservedFrame, ...]
    is_metal_fitted: bool = False

    @property
    def lit(self) -> Bool:
        """The frames (n_frames,) that the arc lights."""
        return np.array([frame.condition.arc_level > 0.0 for frame in self.frames], dtype=np.bool_)

    @property
    def shows_arc(self) -> Bool:
        """The frames (n_frames,) that the arc lights and in which a bin counts: not all is saturated."""
        return self.lit & (self.counts > 0)

    @cached_property
    def counts(self) -> Int64:
        """Number of bins of each frame that count (n_frames,)."""
        return np.array([np.count_nonzero(frame.keep) for frame in self.frames], dtype=np.int64)

    def seam_with(self, effects: Mapping[str, Values]) -> SeamCurve:
        """Return the seam that a tracker with these effects in its setup would have found."""
        moving = {name: values for name, values in effects.items() if name in TRIANGULATION_EFFECTS}
        if not moving:
            return self.seam
        known = replace(self.setup, effects={**self.setup.effects, **moving})
        return self.seam.through(
            *self.seam_observations.in_joint(known), self.seam_observations.variances_mm2
        )

    def of_metal(self, change: Callable[[Setup], Setup]) -> "ObservedRecording":
        """Return the recording with another metal; `change` puts it into a setup."""
        setup, binned = change(self.setup), change(self.binned)
        return replace(self, setup=setup, binned=binned, is_metal_fitted=True)

    def with_read_noise(self, ratio: float) -> "ObservedRecording":
        """Return the recording with its stated read noise times a ratio."""
        sensor = replace(self.setup.sensor, read_noise_e=ratio * self.setup.sensor.read_noise_e)
        return replace(self, setup=replace(self.setup, sensor=sensor))

    def subset(self, chosen: Bool) -> "ObservedRecording":
        """Return a recording of some of the frames (n_frames,)."""
        frames = [frame for frame, is_in in zip(self.frames, chosen, strict=True) if is_in]
        return replace(self, frames=tuple(replace(f, position=n) for n, f in enumerate(frames)))


def observe(setup: Setup, frames: Sequence[Frame], pose_at: PoseAt) -> ObservedRecording:
    """Gather a recording's frames for the diagnosis; those without a pose are left out.

    The seam is taken where the tracker finds it, frame by frame along its history. Raises ValueError if no
    frame has a pose.
    """
    posed = [frame for frame in frames if pose_at(frame.timestamp_s) is not None]
    if not posed:
        raise ValueError("no frame has a pose: there is nothing to compare with a prediction")
    poses = [_tool(pose_at, frame) for frame in posed]
    sightings = SeamObservations.of(setup, posed, poses)
    return observe_along(setup, posed, poses, sightings, frames[0].timestamp_s)


def observe_along(
    setup: Setup,
    posed: Sequence[Frame],
    poses: Sequence[Callable[[float], Float64]],
    seam_observations: SeamObservations,
    first_s: float,
) -> ObservedRecording:
    """Gather frames with their poses along an observed seam; the recording began at `first_s`."""
    true = apply_setup_effects(setup)
    stations_mm = [
        make_scene(true, T(pose_time_s(setup, frame.timestamp_s))).stations_mm
        for T, frame in zip(poses, posed, strict=True)
    ]
    ends_mm = np.min(stations_mm), np.max(stations_mm)
    has_ridges = setup.joint.has_ridges
    seen = seam_observations.in_joint(setup)
    seam = SeamCurve.of(*seen, seam_observations.variances_mm2, ends_mm, has_ridges)
    seam = seam.with_modes(_modes_by_camera(setup, seam, seam_observations))
    # Some 160 bins across the image resolve light and stripe; bins of 2 px or more show their pixels'
    # scatter.
    bin_px = max(2, round(setup.camera.width / 160))
    binned = replace(setup, camera=binned_camera(setup.camera, bin_px))
    usable = [block_means(frame.image_dn >= saturation_dn(setup.sensor), bin_px) == 0.0 for frame in posed]
    transfer = photon_transfer([frame.image_dn for frame in posed], usable, bin_px)

    def observed(
        position: int, frame: Frame, T_base_tool: Callable[[float], Float64], usable: Bool
    ) -> ObservedFrame:
        condition = stated_condition(setup, frame, first_s)
        pose = T_base_tool(pose_time_s(setup, frame.timestamp_s))
        stations_mm, layers = stated_layers(setup, binned, pose, seam)
        keep, in_stripe = bins_that_count(binned, layers, condition, usable)
        binned_dn = block_means(frame.image_dn, bin_px).astype(np.float32)
        sigma_dn, shown_dn2 = _noise(binned_dn, setup, bin_px, transfer)
        return ObservedFrame(
            position=position,
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            stratum=STRATA[int(condition.laser_level > 0.0) + 2 * int(condition.arc_level > 0.0)],
            condition=condition,
            pose_at=T_base_tool,
            stations_mm=stations_mm,
            image_dn=frame.image_dn,
            binned_dn=binned_dn,
            keep=keep,
            rendered=keep | ~usable | dilate(in_stripe, STRIPE_RIM_BINS),
            sigma_dn=sigma_dn[keep],
            in_stripe=in_stripe[keep],
            stated_e=_stated_e(setup, layers, condition),
            stated_arc_e=layers.arc_e if condition.arc_level > 0.0 else np.zeros_like(binned_dn),
            shown_dn2=shown_dn2[keep],
        )

    frames = tuple(
        observed(n, *of_frame) for n, of_frame in enumerate(zip(posed, poses, usable, strict=True))
    )
    return ObservedRecording(setup, binned, bin_px, seam, seam_observations, frames)


def _modes_by_camera(setup: Setup, seam: SeamCurve, seam_observations: SeamObservations) -> Float64:
    """Return the change (6, 2, g) of the seam's course with the camera's pose, mm per deg and mm per mm.

    Its observations are points of the image: they go where the camera says.
    """
    step, modes = 1e-3, []
    for along in step * np.eye(6):
        T_tool_camera = moved(setup.camera.T_tool_camera, along[:3], along[3:])
        there = replace(setup, camera=replace(setup.camera, T_tool_camera=T_tool_camera))
        curve = seam.through(*seam_observations.in_joint(there), seam_observations.variances_mm2)
        modes.append((curve.mean_mm - seam.mean_mm) / step)
    return np.array(modes)


def stated_condition(setup: Setup, frame: Frame, first_s: float) -> Condition:
    """Return a frame's condition; an arc with a current of 0 is off, an unknown current is the nominal one.

    `first_s` is when the recording's first frame was taken.
    """
    is_known = math.isfinite(frame.current_a)
    return Condition.of(
        setup,
        laser_on=frame.laser_on,
        arc_on=frame.arc_on and not frame.current_a <= 0.0,
        current_a=frame.current_a if is_known else setup.arc.current_a,
        exposure_s=frame.exposure_s,
        timestamp_s=frame.timestamp_s - first_s,
    )


def binned_camera(camera: Camera, bin_px: int) -> Camera:
    """Return the camera whose pixels are bins of bin_px by bin_px; a rest at the rim is left out.

    A bin's box widens the point-spread function by (bin_px^2 - 1) / 12 px^2.
    """
    variance_px2 = camera.psf_sigma_px**2 + (bin_px**2 - 1) / 12.0
    return replace(camera.coarser(bin_px), psf_sigma_px=float(np.sqrt(variance_px2)) / bin_px)


def _tool(pose_at: PoseAt, frame: Frame) -> Callable[[float], Float64]:
    """Return the tool's pose (4, 4) for a time about a frame's."""

    @lru_cache
    def T_base_tool(timestamp_s: float) -> Float64:
        pose = pose_at(timestamp_s)
        # Before the first pose and after the last one the frame's own stands.
        pose = pose_at(frame.timestamp_s) if pose is None else pose
        assert pose is not None
        return pose.T_base_tool

    return T_base_tool


def stated_layers(
    setup: Setup, binned: Setup, T_base_tool: Float64, seam: SeamCurve
) -> tuple[tuple[float, float, float], Layers]:
    """Return stations of what is seen and of the torch, mm, and the light of bins, of the nominal setup."""
    stations_mm = make_scene(apply_setup_effects(setup), T_base_tool).stations_mm
    unmoved = seam.bent(np.zeros(seam.n_modes), *stations_mm)
    return stations_mm, Renderer().layers(apply_setup_effects(binned), T_base_tool, unmoved)


def _stated_e(setup: Setup, layers: Layers, condition: Condition) -> Float32:
    """Return the light (h, w), e-, of a frame before any effect on the image."""
    light = np.zeros(layers.view.shape, dtype=np.float32)
    if condition.arc_level > 0.0:
        light += np.float32(condition.arc_level) * layers.arc_e
    if condition.laser_level > 0.0:
        light += np.float32(condition.laser_level) * layers.laser_e
    return np.asarray(light * np.float32(condition.exposure_s / setup.camera.exposure_s))


def _noise(
    binned_dn: Float32, setup: Setup, bin_px: int, transfer: "PhotonTransfer"
) -> tuple[Float64, Float64]:
    """Return the noise (h, w) of bins with the model's floor, and its variance beyond the stated noise.

    It follows from the observed light, not from a prediction: all candidates explain the same data with the
    same weights. The larger of the stated and the observed noise counts.
    """
    seen_dn = cv2.blur(binned_dn, (3, 3)).astype(np.float64)
    stated_dn2, floor_dn2 = variances_dn2(seen_dn, setup)
    shown_dn2 = np.maximum(transfer.variance_at(seen_dn) - stated_dn2, 0.0) / bin_px**2
    return np.sqrt(stated_dn2 / bin_px**2 + shown_dn2 + floor_dn2), shown_dn2


def variances_dn2(mean_dn: Float64, setup: Setup) -> tuple[Float64, Float64]:
    """Return the stated noise's variance of pixels of a mean (...), and that of the model's floor."""
    electrons = np.maximum(linearise(mean_dn, setup.sensor), 0.0)
    _, stated_dn2 = respond_moments(electrons, electrons + setup.sensor.read_noise_e**2, setup.sensor)
    return stated_dn2, (FLOOR_REL * (mean_dn - setup.sensor.black_level_dn)) ** 2 + FLOOR_DN**2


def bins_that_count(setup: Setup, layers: Layers, condition: Condition, usable: Bool) -> tuple[Bool, Bool]:
    """Return the bins (h, w) that count, and those in the stripe."""
    keep = usable & shows_one_face(layers.faces)
    thin = np.zeros_like(keep)
    # Off the stripe every n-th bin counts, some 27 along a row.
    apart = max(1, round(keep.shape[1] / 27))
    thin[::apart, ::apart] = True
    if condition.arc_level > 0.0:
        keep &= _changes_slowly(layers.arc_e)
    in_stripe = np.zeros_like(keep)
    if condition.laser_level > 0.0:
        # In the stripe the laser has more than 2 % of its peak.
        in_stripe = layers.laser_e > 0.02 * setup.laser.peak_e
    rows, columns = np.indices(keep.shape)
    return keep & (thin | (in_stripe & ((rows + columns) % 2 == 0))), in_stripe


def shows_one_face(faces: Integers) -> Bool:
    """Return the mask (h, w) of bins in whose surroundings only one face of the joint is seen.

    Nuisances move edges: an edge that enters a bin would outweigh all else that they change.
    """
    return ~near_face_edges(faces, 5)


def _changes_slowly(image: Float32) -> Bool:
    """Return the mask (h, w) of an image where it changes by less than half to each neighbour."""
    gentle = np.ones(image.shape, dtype=bool)
    for axis in (0, 1):
        for shift in (-1, 1):
            gentle &= np.abs(np.roll(image, shift, axis=axis) - image) <= 0.5 * image
    gentle[[0, -1], :] = gentle[:, [0, -1]] = True
    return gentle


@dataclass(frozen=True, eq=False)
class PhotonTransfer:
    """The variance of a pixel's noise (k,), DN^2, at grey levels (k,), DN; empty if none was measured."""

    levels_dn: Float64
    variances_dn2: Float64

    def variance_at(self, levels_dn: Float64) -> Float64:
        """Return the variance (...,), DN^2, at levels (...,), DN; outside the range that of the nearest."""
        if not len(self.levels_dn):
            return np.zeros_like(levels_dn)
        return np.interp(levels_dn, self.levels_dn, self.variances_dn2)


def photon_transfer(images_dn: Sequence[Integers], usable: Sequence[Bool], bin_px: int) -> PhotonTransfer:
    """Measure the noise of frames (H, W) in bins `bin_px` wide; those count that are `usable` (h, w).

    A sensor whose response or read noise is not as stated has another noise, too. It shows in the mixed
    second differences of neighbouring pixels, which vanish for smooth light. (EMVA Standard 1288 takes
    differences of two frames.)
    Each level's variance is the median over bins of their details' mean square: flanks of stripes and edges
    scatter more, but are few.
    """
    level, variance = (
        np.concatenate(values)
        for values in zip(
            *(_of_bins(image, use, bin_px) for image, use in zip(images_dn, usable, strict=True)), strict=True
        )
    )
    # A level's median takes 500 bins; there are 24 levels at most.
    min_bins = 500
    if len(level) < min_bins:
        return PhotonTransfer(np.empty(0), np.empty(0))
    order = np.argsort(level, kind="stable")
    parts = np.array_split(order, min(24, len(level) // min_bins))
    # The median of a mean of squares of normal variables lies below its expectation.
    squares = (bin_px // 2) ** 2
    median_ratio = float(chi2.median(squares)) / squares
    return PhotonTransfer(
        np.array([np.median(level[part]) for part in parts], dtype=np.float64),
        np.array([np.median(variance[part]) / median_ratio for part in parts], dtype=np.float64),
    )


def _of_bins(image_dn: Integers, usable: Bool, bin_px: int) -> tuple[Float64, Float64]:
    """Return means (n,), DN, and variances (n,), DN^2, of a frame's bins that are usable."""
    small = weighted_sums_in_bins(image_dn.astype(np.float32), DETAIL_2X2, bin_px)[usable]
    return block_means(image_dn, bin_px)[usable], np.mean(small**2, axis=-1, dtype=np.float64)
