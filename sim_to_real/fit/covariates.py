"""Covariates of a residual: each bin's place in the image, on the part and in time, and its light."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Bool, Float32, Float64, Int32, Integers
from noise_model.effects import apply_setup_effects
from noise_model.instrument.camera import Rays
from noise_model.setup import Setup
from noise_model.surface.joint import SurfaceSection, corrugation_height
from noise_model.transforms import invert, transform
from noise_model.view import View
from sim_to_real.data.binned import STRATA, ObservedFrame, ObservedRecording
from sim_to_real.fit.gauss_newton import Refit
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.nuisances import apply_nuisances

UNITS: Mapping[str, str] = {
    "distance": "mm",
    "theta_i": "deg",
    "theta_r": "deg",
    "phi_r": "deg",
    "half_angle": "deg",
    "field_angle": "deg",
    "gray_level": "DN",
    "exposure": "s",
    "current": "A",
    "time": "s",
    "velocity_sign": "",
    "concavity": "",
    "beside_sheet": "mm",
    "row": "px",
    "column": "px",
    "radius": "px",
}
"""The covariates and their units.

`distance` is that from the arc's centre, the paper's a; `theta_i`, `phi_r` and `half_angle` are those of a
point source in the middle of the luminous half-sphere, R / 2 above its centre, which itself may lie in the
plate's plane; phi_r = 0 on the side opposite the arc. These four are NaN while the arc is off.
`velocity_sign` says whether the tool goes to the left of travel (1), to the right (-1) or neither (0).
`concavity` is the share of the light of a diffuse sky that other faces of the joint keep from the point.
`beside_sheet` is how far the point lies before the laser's sheet (behind it: less than 0).
`row`, `column` and `radius`, from the principal point, are in pixels of the recording.
"""


@dataclass(frozen=True, eq=False)
class Covariates:
    """All bins that count (n,) of all frames, frame after frame, at one set of nuisances.

    `values` are the covariates by name, see `UNITS`; `frame` is the frame's position, `bins` the place in the
    flattened frame of bins `shape` (h, w), `stratum` an index into `STRATA`; `sigma_dn` the noise. `arc_dn`,
    `laser_dn` and `predicted_dn` are the predicted light of the sources and the predicted mean, DN;
    `part_mm` (n, 2) is the place on the part, along the seam and to its left, NaN past it, on a `face`.
    `by_camera` (n, 6) are the changes of the whitened prediction with the camera's pose.
    """

    shape: tuple[int, int]
    values: Mapping[str, Float32]
    frame: Int32
    bins: Int32
    stratum: npt.NDArray[np.int8]
    in_stripe: Bool
    sigma_dn: Float32
    arc_dn: Float32
    laser_dn: Float32
    predicted_dn: Float32
    part_mm: Float32
    face: Int32
    by_camera: Float32

    @property
    def light_dn(self) -> Float32:
        """The predicted light of both sources (n,), DN."""
        return self.arc_dn + self.laser_dn

    def subset(self, chosen: Integers) -> "Covariates":
        """Return some bins alone; `chosen` are their places among all."""
        arrays = vars(self).keys() - {"shape", "values"}
        values = {name: of_all[chosen] for name, of_all in self.values.items()}
        return replace(self, values=values, **{name: getattr(self, name)[chosen] for name in arrays})

    def image(self, frame: int, values: Float32) -> Float32:
        """Return the values (n,) of one frame's bins as an image (h, w), NaN where no bin counts."""
        image = np.full(self.shape, np.nan, dtype=np.float32)
        chosen = self.frame == frame
        image.reshape(-1)[self.bins[chosen]] = values[chosen]
        return image


def covariates(model: LinearizedModel, fit: Refit) -> Covariates:
    """Gather the covariates of every bin that counts, with the light and the nuisances of a fit."""
    anchor = fit.nuisance
    observed = model.observed
    true = apply_setup_effects(apply_nuisances(observed.binned, anchor))
    rays = Rays.of(true.camera)
    parts = []
    for frame, light in zip(observed.frames, fit.lights, strict=True):
        seam = model.renderings.seam(frame, anchor, {})
        T_base_tool = frame.T_base_tool_in(true)
        bins = np.flatnonzero(frame.keep)
        view = View.of(true, T_base_tool, seam.middle, rays, bins, ground=seam.ground)
        values = _of_surface(view) | _of_frame(observed, frame, true, len(bins)) | _of_image(observed, view)
        if frame.condition.arc_level == 0.0:
            for name in ("distance", "theta_i", "phi_r", "half_angle"):
                values[name] = np.full(len(bins), np.nan)
        predicted_dn = light.mean_dn()
        # Of a bent response each source gets its share of what the light adds.
        light_dn = predicted_dn - light.sensor.black_level_dn - light.black_dn
        dn_per_e = light_dn / np.maximum(light.arc_e + light.laser_e + light.other_e, 1e-3)
        parts.append(
            {
                **values,
                "gray_level": predicted_dn,
                "frame": np.full(len(bins), frame.position),
                "bins": bins,
                "stratum": np.full(len(bins), STRATA.index(frame.stratum)),
                "in_stripe": frame.in_stripe,
                "sigma_dn": frame.sigma_dn,
                "arc_dn": dn_per_e * light.arc_e,
                "laser_dn": dn_per_e * light.laser_e,
                "predicted_dn": predicted_dn,
                "part_mm": view.surface[0][:, :2],
                "face": view.faces,
            }
        )

    def joined(name: str, kind: npt.DTypeLike = np.float32) -> npt.NDArray[Any]:
        return np.concatenate([part[name] for part in parts]).astype(kind)

    return Covariates(
        shape=observed.frames[0].keep.shape,
        values={name: joined(name) for name in UNITS},
        frame=joined("frame", np.int32),
        bins=joined("bins", np.int32),
        stratum=joined("stratum", np.int8),
        in_stripe=joined("in_stripe", np.bool_),
        sigma_dn=joined("sigma_dn"),
        arc_dn=joined("arc_dn"),
        laser_dn=joined("laser_dn"),
        predicted_dn=joined("predicted_dn"),
        part_mm=joined("part_mm"),
        face=joined("face", np.int32),
        by_camera=model.camera_columns(fit.lights).astype(np.float32),
    )


def _of_surface(view: View) -> dict[str, Float64]:
    """Return distances and angles between bins' places on the part, arc, sheet and camera, (n,) each."""
    points, normals, _ = view.surface
    to_center = view.scene.center_mm - points
    to_arc = to_center + np.array([0.0, 0.0, 0.5 * view.setup.arc.radius_mm])
    omega_i = to_arc / np.linalg.norm(to_arc, axis=1, keepdims=True)
    omega_r = -view.directions
    cos_i, cos_r = np.sum(omega_i * normals, axis=1), np.sum(omega_r * normals, axis=1)
    half = omega_i + omega_r
    cos_half = np.sum(half * normals, axis=1) / np.linalg.norm(half, axis=1)
    # The azimuth between the view and the mirrored arc, both laid into the face.
    ahead, seen = cos_i[:, None] * normals - omega_i, omega_r - cos_r[:, None] * normals
    length = np.linalg.norm(ahead, axis=1) * np.linalg.norm(seen, axis=1)
    cos_phi = np.sum(ahead * seen, axis=1) / np.maximum(length, 1e-12)
    return {
        "distance": np.linalg.norm(to_center, axis=1),
        "theta_i": _degrees(cos_i),
        "theta_r": _degrees(cos_r),
        "phi_r": _degrees(cos_phi),
        "half_angle": _degrees(cos_half),
        "concavity": concavity(points, normals, view.scene.shape),
        "beside_sheet": view.setup.laser.off_mm(transform(invert(view.scene.T_joint_tool), points)),
    }


def _degrees(cosine: Float64) -> Float64:
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def concavity(points_mm: Float64, normals: Float64, shape: SurfaceSection) -> Float64:
    """Return the share (n,) of a diffuse sky's light that other faces of a section keep from points (n, 3).

    1 - (sin phi_2 - sin phi_1) / 2 with phi_1, phi_2 the angles from the normal, across the seam, between
    which the sky is open: faces run along the seam without end (Siegel and Howell's crossed strings).
    """
    # A corrugation raises the whole of a section by as much and turns no face across the seam.
    normal = normals[:, 1:] / np.maximum(np.linalg.norm(normals[:, 1:], axis=1), 1e-12)[:, None]
    along = np.column_stack([normal[:, 1], -normal[:, 0]])
    low, high = np.full(len(points_mm), -1.0), np.full(len(points_mm), 1.0)
    raised = corrugation_height(points_mm[:, 0], shape.corrugation)
    for y, z in shape.vertices:
        to_vertex = np.column_stack([y - points_mm[:, 1], z + raised - points_mm[:, 2]])
        far = np.maximum(np.linalg.norm(to_vertex, axis=1), 1e-12)
        up, aside = np.sum(to_vertex * normal, axis=1) / far, np.sum(to_vertex * along, axis=1) / far
        hides = up > 1e-6
        low = np.where(hides & (aside < 0.0), np.maximum(low, aside), low)
        high = np.where(hides & (aside >= 0.0), np.minimum(high, aside), high)
    return np.asarray(1.0 - 0.5 * np.maximum(high - low, 0.0))


def _of_frame(observed: ObservedRecording, frame: ObservedFrame, true: Setup, n: int) -> dict[str, Float64]:
    """Return the covariates (n,) that a frame's bins have in common."""
    arc = observed.setup.arc
    values = {
        "exposure": frame.condition.exposure_s,
        "current": arc.current_a * frame.condition.arc_level ** (1.0 / arc.current_exponent),
        "time": frame.timestamp_s - observed.frames[0].timestamp_s,
        "velocity_sign": velocity_sign(frame, true),
    }
    return {name: np.full(n, value) for name, value in values.items()}


def velocity_sign(frame: ObservedFrame, true: Setup) -> float:
    """Return 1 if the tool goes to the left of travel while a frame is taken, -1 to the right, 0 neither."""
    span_s = 0.02
    before, after = (frame.T_base_tool_in(true, by * span_s) for by in (-0.5, 0.5))
    step_base = after[:3, 3] - before[:3, 3]
    start, end = (np.asarray(point) for point in true.joint.seam_in_base_mm[:2])
    left_base = np.cross(true.joint.surface_normal_in_base, end - start)
    speed = float(step_base @ left_base / np.linalg.norm(left_base)) / span_s
    # A tool that moves sideways more slowly counts as moving neither way.
    return 0.0 if abs(speed) < 0.2 else float(np.sign(speed))


def _of_image(observed: ObservedRecording, view: View) -> dict[str, Float64]:
    """Return the covariates (n,) of the bins' places in the image."""
    # A bin's middle among the recording's own pixels.
    px = (view.rays.uv_px.astype(np.float64) + 0.5) * observed.bin_px - 0.5
    camera = observed.setup.camera
    radius = np.hypot(px[:, 0] - camera.cx, px[:, 1] - camera.cy)
    return {"field_angle": np.degrees(view.theta), "row": px[:, 1], "column": px[:, 0], "radius": radius}
