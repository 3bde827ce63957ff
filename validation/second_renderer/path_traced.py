"""The arc's light by Mitsuba 3, a path tracer that is not ours (Jakob et al. 2022, mitsuba-renderer.org).

Ray casting, the choice of points on the arc, shadow rays and the sum over light paths are Mitsuba's own: its
stock `direct` integrator, its `sphere` with an `area` emitter, its meshes. Added are only what Mitsuba does
not have: the paper's reflectance (Eq. 7) and a texture that leaves the arc's lower half dark. Only direct
light is traced. Mitsuba computes in float32: rays leave a surface some 0.005 mm above it, and shadow rays end
9e-4 of their length before the arc, so that a face that cuts into the arc hides 0.03 mm too little of it.

Nothing here is imported until it is called: Mitsuba is the extra `arctrack[reference]`.
"""

from __future__ import annotations

import ctypes.util
import functools
import math
import os
from typing import Any

import numpy as np
import numpy.typing as npt

from arctrack.child_process import is_child
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.instrument.camera import Rays
from noise_model.setup import Setup
from noise_model.surface.joint import NOMINAL_SEAM, SeamLine
from validation.second_renderer.joint_mesh import FaceMesh, joint_mesh

VARIANT = "llvm_ad_mono"

BATCHES = 16
"""Independent batches of samples: their scatter is the Monte-Carlo error, itself known to 18 % a pixel."""

PATHS_AT_ONCE = 2**22

OLDEST_LLVM, OLDEST_LLVM_1_4 = 15, 17
"""What Dr.Jit needs; from 1.4 on it emits llvm.maximum, at which an older x86 backend ends the process."""

LLVM_NAMES = ("LLVM", *(f"LLVM-{major}" for major in range(25, OLDEST_LLVM - 1, -1)))


def path_traced_arc(
    setup: Setup,
    T_base_tool: Float64,
    *,
    samples: int = 256,
    seed: int = 0,
    seam: SeamLine = NOMINAL_SEAM,
    xy: npt.NDArray[np.floating[Any]] | None = None,
) -> tuple[Float64, Float64]:
    """Return the arc's light at pixel centres and its Monte-Carlo standard error, e-, both (...,).

    As `map.arc_at` gives it: for `camera.exposure_s` at `arc.current_a`, pinhole and cos^4, before the
    point-spread function; NaN for a ray that meets nothing within `joint_mesh.REACH_MM` of the arc. `xy`
    (..., 2) are normalised rays (x, y, 1) of the camera, every pixel's (H, W, 2) without them. At least
    `samples` paths a ray go out, in `BATCHES` batches, each a multi-jittered set of its own with a square
    number of paths; equal seeds give equal images. `setup.effects` are left out.

    Raises ImportError where Mitsuba or its LLVM is missing, ValueError for samples < 1.
    """
    if samples < 1:
        raise ValueError(f"samples = {samples}: must be >= 1")
    mi = load_mitsuba()
    rays = Rays.of(setup.camera).xy if xy is None else xy
    shape = rays.shape[:-1]
    flat = np.asarray(rays, dtype=np.float64).reshape(-1, 2)
    scene = make_scene(setup, T_base_tool, seam)
    # float32 counts from the arc's station: a seam may be metres long.
    station = float(scene.center_mm[0])
    traced = _scene(mi, setup, scene.center_mm, station)
    d = np.column_stack([flat, np.ones(len(flat))]) @ scene.T_joint_camera[:3, :3].T
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    origin = scene.T_joint_camera[:3, 3] - [station, 0.0, 0.0]
    per_ray = math.ceil(math.sqrt(samples / BATCHES)) ** 2
    sampler = mi.load_dict({"type": "multijitter", "sample_count": per_ray})
    at_once = max(1, PATHS_AT_ONCE // per_ray)
    seeds = np.random.SeedSequence(seed).generate_state(BATCHES * -(-len(flat) // at_once))
    mean, sigma = np.empty(len(flat)), np.empty(len(flat))
    for i, first in enumerate(range(0, len(flat), at_once)):
        some = slice(first, first + at_once)
        mean[some], sigma[some] = _trace(mi, traced, sampler, origin, d[some], seeds[BATCHES * i :][:BATCHES])
    electrons = setup.arc.radiance_e * (1.0 + np.sum(flat**2, axis=1)) ** -2.0
    return (electrons * mean).reshape(shape), (electrons * sigma).reshape(shape)


def load_mitsuba() -> Any:
    """Return the module Mitsuba, with its LLVM variant set and what is added to it here.

    A libLLVM that the system's loader knows is found by itself, unless DRJIT_LIBLLVM_PATH names one. Raises
    ImportError that says what is missing and the cure.
    """
    if "DRJIT_LIBLLVM_PATH" not in os.environ and (known := _known_llvm()):
        os.environ["DRJIT_LIBLLVM_PATH"] = known
    try:
        import drjit
        import mitsuba
    except ImportError as error:
        raise ImportError("Mitsuba 3 is not installed: pip install 'arctrack[reference]'") from error
    try:
        mitsuba.set_variant(VARIANT)
    except ImportError as error:
        raise ImportError(
            f"Mitsuba's variant {VARIANT} cannot start: install libLLVM {OLDEST_LLVM_1_4} or newer (Debian: "
            f"libllvm19) or set DRJIT_LIBLLVM_PATH to one ({error})"
        ) from error
    dr_jit = tuple(int(part) for part in drjit.__version__.split(".")[:2])
    llvm = drjit.detail.llvm_version()[0]
    if dr_jit >= (1, 4) and llvm < OLDEST_LLVM_1_4:
        raise ImportError(
            f"Dr.Jit {drjit.__version__} needs libLLVM {OLDEST_LLVM_1_4} or newer, found is {llvm}: install "
            "one (Debian: libllvm19) and set DRJIT_LIBLLVM_PATH to it, or pip install 'mitsuba<3.9'"
        )
    if is_child():
        # The other processes have the other cores, and waiting threads would keep them busy.
        drjit.set_thread_count(1)
    _register(mitsuba)
    return mitsuba


@functools.cache
def _known_llvm() -> str | None:
    """Return the newest libLLVM of those that the system's loader knows."""
    return next((path for path in map(ctypes.util.find_library, LLVM_NAMES) if path), None)


def _scene(mi: Any, setup: Setup, center_mm: Float64, station: float) -> Any:
    """Build Mitsuba's scene: joint frame in mm, its origin moved along x to a station."""
    lobe = setup.material.lobe
    metal = {
        "type": "arctrack_metal",
        "kappa_diff": setup.material.kappa_diff,
        "kappa_spec": setup.material.kappa_spec,
        "c2": setup.material.c2,
        "tail": lobe.tail,
        "anisotropy": lobe.anisotropy,
        "marks_deg": lobe.marks_deg,
    }
    arc = {
        "type": "sphere",
        "center": [center_mm[0] - station, center_mm[1], center_mm[2]],
        "radius": setup.arc.radius_mm,
        "emitter": {"type": "area", "radiance": {"type": "arctrack_upper_half"}},
    }
    # The arc is not in the picture, only its light: hide_emitters lets the camera's rays through it.
    direct = {"type": "direct", "bsdf_samples": 0, "emitter_samples": 1, "hide_emitters": True}
    # Robust: otherwise a ray now and then slips between two of a corrugation's triangles.
    parts = {"type": "scene", "embree_use_robust_intersections": True, "integrator": direct, "arc": arc}
    for i, face in enumerate(joint_mesh(setup.joint, station)):
        parts[f"face_{i}"] = _mesh(mi, face, station, metal)
    return mi.load_dict(parts)


def _mesh(mi: Any, face: FaceMesh, station: float, metal: dict[str, Any]) -> Any:
    """Hand a face to Mitsuba, its origin moved along x to a station."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(metal)
    n_vertices, n_triangles = len(face.vertices_mm), len(face.triangles)
    mesh = mi.Mesh("face", n_vertices, n_triangles, has_vertex_normals=True, props=properties)
    values = mi.traverse(mesh)
    values["vertex_positions"] = mi.Float((face.vertices_mm - [station, 0.0, 0.0]).ravel().astype(np.float32))
    values["vertex_normals"] = mi.Float(face.normals.ravel().astype(np.float32))
    values["faces"] = mi.UInt32(face.triangles.ravel().astype(np.uint32))
    values.update()
    return mesh


def _trace(
    mi: Any,
    traced: Any,
    sampler: Any,
    origin: Float64,
    d: Float64,
    seeds: npt.NDArray[np.unsignedinteger[Any]],
) -> tuple[Float64, Float64]:
    """Return mean and standard error of the radiance (n,) along rays d (n, 3) over batches with `seeds`."""
    per_ray = sampler.sample_count()
    n = per_ray * len(d)
    directions = np.repeat(d.T.astype(np.float32), per_ray, axis=1)
    ray = mi.RayDifferential3f(o=mi.Point3f(*map(float, origin)), d=mi.Vector3f(directions))
    batches = np.empty((len(seeds), len(d)))
    for batch, seed in zip(batches, seeds, strict=True):
        sampler.set_samples_per_wavefront(per_ray)
        sampler.seed(int(seed), n)
        radiance, meets, *_ = traced.integrator().sample(traced, sampler, ray)
        value = np.array(radiance, dtype=np.float32).reshape(len(d), per_ray)
        batch[:] = np.where(np.array(meets).reshape(value.shape), value, np.nan).mean(
            axis=1, dtype=np.float64
        )
    return batches.mean(axis=0), batches.std(axis=0, ddof=1) / len(batches) ** 0.5


@functools.cache
def _register(mi: Any) -> None:
    """Teach Mitsuba the paper's reflectance and an emission of the upper half alone."""
    import drjit as dr

    class Metal(mi.BSDF):
        """f_r = kappa_diff + kappa_spec G / cos(theta_r) exp(-c2 alpha^2), theta_r towards the camera."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            for name in ("kappa_diff", "kappa_spec", "c2", "tail", "anisotropy", "marks_deg"):
                setattr(self, name, float(properties[name]))
            self.m_flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            # Paths start at the camera: si.wi points to it, wo to the arc, both in the face's own frame.
            omega_r, omega_i = si.wi, wo
            h = dr.normalize(omega_i + omega_r)
            lean2 = h.x * h.x + h.y * h.y
            alpha = dr.atan2(dr.sqrt(lean2), h.z)
            lower = dr.minimum(omega_i.z, omega_r.z)
            attenuation = dr.minimum(1.0, 2.0 * h.z * lower / dr.dot(h, omega_i))
            exponent = self.c2 * alpha * alpha
            if self.anisotropy != 0.0:
                angle = math.radians(self.marks_deg)
                marks = si.to_local(mi.Vector3f(math.cos(angle), math.sin(angle), 0.0))
                along = h.x * marks.x + h.y * marks.y
                both = lean2 * (marks.x * marks.x + marks.y * marks.y)
                cos2 = dr.select(both > 0.0, along * along / both, 0.0)
                exponent *= math.exp(self.anisotropy) * cos2 + math.exp(-self.anisotropy) * (1.0 - cos2)
            if self.tail == 0.0:
                fall = dr.exp(-exponent)
            else:
                fall = dr.power(1.0 + self.tail * exponent, -1.0 / self.tail)
            f_r = self.kappa_diff + self.kappa_spec * attenuation / omega_r.z * fall
            seen = active & (omega_i.z > 0.0) & (omega_r.z > 0.0)
            return dr.select(seen, mi.UnpolarizedSpectrum(f_r * omega_i.z), 0.0)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            # Directions are chosen on the arc alone.
            return mi.Float(0.0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    class UpperHalf(mi.Texture):
        """1 where a surface faces up, 0 elsewhere.

        It does not call itself varying: an area emitter then chooses points by the sphere's solid angle.
        """

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.UnpolarizedSpectrum(dr.select(active & (si.n.z > 0.0), mi.Float(1.0), mi.Float(0.0)))

        def is_spatially_varying(self) -> bool:
            return False

    mi.register_bsdf("arctrack_metal", Metal)
    mi.register_texture("arctrack_upper_half", UpperHalf)
