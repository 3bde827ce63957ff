"""Small setups of every joint, and the surfaces of RECORDING.md once more, marched along in plain NumPy.

The twins here know nothing of strips, half-spaces, tables or discs: a surface is a height over (x, y) that
jumps at a lap's edge, what hides something is found by walking there, and the arc is a sum over its surface.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from noise_model.arc_source import Arc
from noise_model.compiled.arrays import Bool, Float64
from noise_model.instrument.camera import Camera
from noise_model.instrument.laser import Laser
from noise_model.instrument.sensor import Sensor
from noise_model.instrument.spectrum import Filter
from noise_model.setup import Setup
from noise_model.surface.brdf import TABLE_1, Material
from noise_model.surface.joint import Joint

JOINTS = {
    "flat": Joint("flat", {}, ((-300.0, 0.0, 0.0), (300.0, 0.0, 0.0))),
    "v_groove": Joint(
        "v_groove",
        {"included_angle_deg": 70.0, "depth_mm": 4.0, "root_gap_mm": 1.0},
        ((-300.0, 0.0, 0.0), (300.0, 0.0, 0.0)),
    ),
    "lap": Joint("lap", {"thickness_mm": 2.0}, ((-300.0, 0.0, 0.0), (300.0, 0.0, 0.0))),
    "corrugation": Joint(
        "corrugation",
        {"thickness_mm": 1.5, "pitch_mm": 60.0, "height_mm": 8.0, "width_mm": 30.0},
        ((-300.0, 0.0, 0.0), (300.0, 0.0, 0.0)),
    ),
}
LINE = ((-300.0, 0.0, 0.0), (300.0, 0.0, 0.0))
MORE_JOINTS = {
    "butt": Joint("butt", {"gap_mm": 1.5, "thickness_mm": 3.0}, LINE),
    "fillet": Joint("fillet", {"included_angle_deg": 100.0}, LINE),
    "ridge": Joint("fillet", {"included_angle_deg": 250.0}, LINE),
    "half_v": Joint("half_v", {"bevel_angle_deg": 40.0, "depth_mm": 4.0, "root_gap_mm": 1.0}, LINE),
    "u_groove": Joint(
        "u_groove",
        {"depth_mm": 6.0, "root_radius_mm": 3.0, "bevel_angle_deg": 15.0, "root_gap_mm": 1.0},
        LINE,
    ),
    "edge": Joint("edge", {"gap_mm": 0.8, "thickness_mm": 3.0}, LINE),
}
EDGE_STANDS_MM = 60.0
ARC_HEIGHT_MM = {"lap": 2.0, "corrugation": 1.5}
RADIANCE_E = {"mild_steel": 2.0e8, "zn_coated": 8.0e6}

AHEAD = ((95.0, 0.0, 130.0), (36.0, 0.0, 0.0))
BEHIND = ((-20.0, 0.0, 135.0), (36.0, 0.0, 0.0))


def camera(
    view: tuple[tuple[float, float, float], tuple[float, float, float]] = AHEAD,
    width: int = 160,
    height: int = 120,
    psf_sigma_px: float = 0.7,
    focal_px: float | None = None,
) -> Camera:
    """A camera that stands at view[0] and looks at view[1], tool frame, x to the right.

    It is 17 degrees wide, unless another focal length is given; 2190 px is that of a full-sized camera.
    """
    eye, target = np.asarray(view[0]), np.asarray(view[1])
    z_axis = (target - eye) / np.linalg.norm(target - eye)
    x_axis = np.array([0.0, -1.0, 0.0]) + z_axis[1] * z_axis
    x_axis /= np.linalg.norm(x_axis)
    T_tool_camera = np.eye(4)
    T_tool_camera[:3, :3] = np.column_stack([x_axis, np.cross(z_axis, x_axis), z_axis])
    T_tool_camera[:3, 3] = eye
    f = 547.5 * width / 160.0 if focal_px is None else focal_px
    center = (width - 1) / 2.0, (height - 1) / 2.0
    return Camera(width, height, f, f, *center, T_tool_camera, psf_sigma_px=psf_sigma_px)


def setup(
    joint: str | Joint,
    material: str | Material = "zn_coated",
    *,
    of_camera: Camera | None = None,
    arc_center_mm: tuple[float, float, float] | None = None,
) -> Setup:
    """A whole nominal setup, its laser 35 mm ahead of the torch."""
    joint = (JOINTS | MORE_JOINTS)[joint] if isinstance(joint, str) else joint
    material = TABLE_1[material] if isinstance(material, str) else material
    center = (0.0, 0.0, ARC_HEIGHT_MM.get(joint.type, 0.0)) if arc_center_mm is None else arc_center_mm
    return Setup(
        camera=camera() if of_camera is None else of_camera,
        sensor=Sensor(8, 80.0, 4.0, 45.0, 20400.0),
        filter=Filter(690.0, 10.0, 1.8),
        laser=Laser(690.0, (1.0, 0.0, 0.0, -35.0), (35.0, 0.0, 140.0), 0.45, 5000.0),
        arc=Arc(3.0, center, RADIANCE_E.get(material.name, 1.0e7), 100.0, 1.3),
        material=material,
        joint=joint,
    )


def pose(
    translation_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Float64:
    """T_base_tool (or any other pose) of a shift and a rotation vector."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    T[:3, 3] = translation_mm
    return T


def height(joint: Joint, x: Float64, y: Float64) -> Float64:
    """The surface's height, mm, after the drawn cross-sections; on an upright edge the lower one."""
    size = joint.dimensions
    if joint.type == "flat":
        return np.zeros(np.broadcast(x, y).shape)
    if joint.type == "v_groove":
        tangent = math.tan(math.radians(size["included_angle_deg"]) / 2.0)
        above_root = np.maximum(np.abs(y) - size["root_gap_mm"] / 2.0, 0.0) / tangent
        return np.minimum(above_root - size["depth_mm"], 0.0) + 0.0 * x
    if joint.type in ("butt", "edge"):
        side = np.abs(y) - size["gap_mm"] / 2.0
        depth = size["thickness_mm"] if joint.type == "butt" else EDGE_STANDS_MM
        width = np.inf if joint.type == "butt" else size["thickness_mm"]
        return np.where((side > 0.0) & (side < width), 0.0, -depth) + 0.0 * x
    if joint.type == "fillet":
        return np.abs(y) / math.tan(math.radians(size["included_angle_deg"]) / 2.0) + 0.0 * x
    if joint.type == "half_v":
        beside = y - size["root_gap_mm"] / 2.0
        bevel = np.maximum(beside, 0.0) / math.tan(math.radians(size["bevel_angle_deg"])) - size["depth_mm"]
        return np.where(y <= -size["root_gap_mm"] / 2.0, 0.0, np.minimum(bevel, 0.0)) + 0.0 * x
    if joint.type == "u_groove":
        radius, bevel = size["root_radius_mm"], math.radians(size["bevel_angle_deg"])
        out = np.maximum(np.abs(y) - size["root_gap_mm"] / 2.0, 0.0)
        rounded = radius - np.sqrt(np.maximum(radius**2 - out**2, 0.0))
        straight = (out - radius * math.cos(bevel)) / math.tan(bevel) + radius * (1.0 - math.sin(bevel))
        over_root = np.where(out < radius * math.cos(bevel), rounded, straight)
        return np.minimum(over_root - size["depth_mm"], 0.0) + 0.0 * x
    step = np.where(y < 0.0, size["thickness_mm"], 0.0)
    return step + (corrugation(joint, x) if joint.type == "corrugation" else 0.0 * x)


def corrugation(joint: Joint, x: Float64) -> Float64:
    """height/2 (1 + cos(2 pi u / width)) for |u| < width/2, u = x to the nearest multiple of pitch."""
    size = joint.dimensions
    u = np.remainder(x + size["pitch_mm"] / 2.0, size["pitch_mm"]) - size["pitch_mm"] / 2.0
    wave = size["height_mm"] * np.cos(np.pi * u / size["width_mm"]) ** 2
    return np.where(np.abs(u) < size["width_mm"] / 2.0, wave, 0.0)


def top_and_bottom(joint: Joint) -> tuple[float, float]:
    """The highest and the lowest level of the surface, mm."""
    size = joint.dimensions
    if joint.type == "fillet":
        plates = height(joint, np.zeros(2), np.array([0.0, 40.0]))
        return float(plates.max()), float(plates.min())
    if joint.type in ("butt", "edge"):
        return 0.0, float(height(joint, np.zeros(1), np.zeros(1))[0])
    top = size.get("thickness_mm", 0.0) + (size["height_mm"] if joint.type == "corrugation" else 0.0)
    return top, -size.get("depth_mm", 0.0)


def march(joint: Joint, origin: Float64, d: Float64, steps: int = 20000) -> float:
    """How far along a ray the surface's height first crosses it, in units of d; inf where it never does."""
    top, bottom = top_and_bottom(joint)
    if d[2] == 0.0:
        ends = [0.0, 300.0 / float(np.linalg.norm(d))]
    else:
        ends = sorted(max(0.0, (level - origin[2]) / d[2]) for level in (top + 1e-3, bottom - 1e-3))
    if ends[1] == 0.0:
        return math.inf
    t = np.linspace(*ends, steps + 1)

    def is_above(t: Float64) -> Bool:
        walk = origin + np.multiply.outer(t, d)
        return walk[..., 2] > height(joint, walk[..., 0], walk[..., 1])

    changes = np.flatnonzero(np.diff(is_above(t)))
    if not changes.size:
        return math.inf
    low, high = t[changes[0]], t[changes[0] + 1]
    was_above = is_above(low)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_above(middle) == was_above else (low, middle)
    return float(high)


def normal_at(joint: Joint, P: Float64) -> Float64:
    """The surface's unit normal from the height's differences; an upright edge faces the lower side."""
    x, y, z = P
    e = 1e-5
    right, left = (float(height(joint, x, y + side)) for side in (-1e-6, 1e-6))
    if abs(right - left) > 0.1 and min(right, left) + 1e-6 < z < max(right, left) - 1e-6:
        return np.array([0.0, math.copysign(1.0, right - left), 0.0])
    slope_x = (height(joint, x + e, y) - height(joint, x - e, y)) / (2.0 * e)
    slope_y = (height(joint, x, y + e) - height(joint, x, y - e)) / (2.0 * e)
    normal = np.array([-float(slope_x), -float(slope_y), 1.0])
    return normal / np.linalg.norm(normal)


def clearance(joint: Joint, P: Float64, targets: Float64, steps: int = 400) -> Float64:
    """How far the straight ways (N,) from P to targets (N, 3) stay above the surface at the least, mm.

    The walk ends where nothing is high enough to hide; a plain section is looked at where it bends only.
    """
    way = targets - P
    lowest = np.full(len(targets), np.inf)
    bends = [0.0] if joint.type != "flat" else []
    if joint.type == "v_groove":
        half_gap = joint.dimensions["root_gap_mm"] / 2.0
        tangent = math.tan(math.radians(joint.dimensions["included_angle_deg"]) / 2.0)
        half_mouth = half_gap + joint.dimensions["depth_mm"] * tangent
        bends = [-half_mouth, -half_gap, half_gap, half_mouth]
    elif joint.type not in ("flat", "lap", "corrugation", "fillet"):
        # Wherever the drawn height bends; a rounding that is seen from inside hides nothing.
        y = np.linspace(-10.0, 10.0, 200001)
        slopes = np.diff(height(joint, np.zeros_like(y), y)) / np.diff(y)
        bends = list(y[1:-1][np.abs(np.diff(slopes)) > 0.01])
    for bend in bends:
        if abs(P[1] - bend) < 1e-9:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (bend - P[1]) / way[:, 1]
        at = P + np.where((share > 0) & (share < 1), share, 0.0)[:, np.newaxis] * way
        # A lap's edge is reached from either side, so that the higher sheet counts.
        edge = np.maximum(height(joint, at[:, 0], bend + 1e-12), height(joint, at[:, 0], bend - 1e-12))
        lowest = np.minimum(lowest, np.where((share > 0) & (share < 1), at[:, 2] - edge, np.inf))
    if joint.type == "corrugation":
        top, _ = top_and_bottom(joint)
        with np.errstate(divide="ignore"):
            reach = np.where(way[:, 2] > 0, np.clip((top - P[2]) / way[:, 2], 0.0, 1.0), 1.0)
        for share in (np.arange(steps) + 1.0) / steps:
            walk = P + (share * reach)[:, np.newaxis] * way
            lowest = np.minimum(lowest, walk[:, 2] - height(joint, walk[:, 0], walk[:, 1]))
    return lowest


def f_r(omega_i: Float64, omega_r: Float64, normal: Float64, material: Material) -> Float64:
    """Eq. 5 and 7 for unit vectors omega_i (N, 3) above the surface, written out in angles."""
    half = omega_i + omega_r
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cos_i, cos_r = omega_i @ normal, float(omega_r @ normal)
    alpha = np.arctan2(np.linalg.norm(np.cross(half, normal), axis=1), half @ normal)
    beta = np.arccos(np.clip(np.sum(half * omega_i, axis=1), -1.0, 1.0))
    masking = 2.0 * np.cos(alpha) * np.minimum(cos_i, cos_r) / np.cos(beta)
    G = np.minimum(1.0, masking)
    return material.kappa_diff + material.kappa_spec * G / cos_r * fall(alpha, half, normal, material)


def fall(alpha: Float64, half: Float64, normal: Float64, material: Material) -> Float64:
    """The lobe over the half vector's angle and its azimuth from the rolling marks, in the face."""
    lobe = material.lobe
    across = np.cross(
        normal, [math.cos(math.radians(lobe.marks_deg)), math.sin(math.radians(lobe.marks_deg)), 0.0]
    )
    across /= np.linalg.norm(across)
    psi = np.arctan2(half @ across, half @ np.cross(across, normal))
    c2 = material.c2 * (
        math.exp(lobe.anisotropy) * np.cos(psi) ** 2 + math.exp(-lobe.anisotropy) * np.sin(psi) ** 2
    )
    if lobe.tail == 0.0:
        return np.exp(-c2 * alpha**2)
    return np.exp(-np.log1p(lobe.tail * c2 * alpha**2) / lobe.tail)


def arc_nodes(
    P: Float64, center: Float64, radius: float, nodes: tuple[int, int] = (10946, 6765)
) -> tuple[Float64, Float64, Float64]:
    """Points (N, 3) on the luminous side that faces P, the directions to them, and cos(phi) / r^2 dA (N,).

    They are a Fibonacci lattice on the cap that faces P, spread evenly over its apparent disc.
    """
    n, generator = nodes
    towards = center - P
    distance = float(np.linalg.norm(towards))
    w = towards / distance
    side = np.cross(w, [1.0, 0.0, 0.0] if abs(w[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    i = np.arange(n)
    share, azimuth = (i + 0.5) / n, 2.0 * np.pi * np.remainder(i * generator / n, 1.0)
    cos_rim = radius / distance
    sin2 = share * (1.0 - cos_rim**2)
    cos_sigma, sin_sigma = np.sqrt(1.0 - sin2), np.sqrt(sin2)
    around = np.outer(np.cos(azimuth), side) + np.outer(np.sin(azimuth), np.cross(w, side))
    outward = -cos_sigma[:, np.newaxis] * w + sin_sigma[:, np.newaxis] * around
    shines = outward[:, 2] > 0
    outward, cos_sigma = outward[shines], cos_sigma[shines]
    on_arc = center + radius * outward
    omega_i = on_arc - P
    r = np.linalg.norm(omega_i, axis=1)
    omega_i /= r[:, np.newaxis]
    cos_phi = -np.sum(omega_i * outward, axis=1)
    # dA = R^2 sin(sigma) d(sigma) d(azimuth), and d(sin^2 sigma) = 2 sin(sigma) cos(sigma) d(sigma).
    dA = np.pi * radius**2 * (1.0 - cos_rim**2) / (n * cos_sigma)
    return on_arc, omega_i, np.maximum(cos_phi, 0.0) / r**2 * dA


def arc_light(
    joint: Joint,
    P: Float64,
    normal: Float64,
    omega_r: Float64,
    center: Float64,
    radius: float,
    material: Material,
) -> float:
    """The integral of f_r cos(phi) cos(theta_i) / r^2 dA over what P sees of the upper half, node by node."""
    if np.linalg.norm(center - P) <= radius:
        return 0.0
    on_arc, omega_i, weight = arc_nodes(P, center, radius)
    seen = omega_i @ normal > 0
    on_arc, omega_i, weight = on_arc[seen], omega_i[seen], weight[seen]
    if joint.type != "flat":
        inside = on_arc[:, 2] < height(joint, on_arc[:, 0], on_arc[:, 1]) - 1e-9
        free = ~inside & (clearance(joint, P, on_arc) > -1e-6)
        omega_i, weight = omega_i[free], weight[free]
    return float(np.sum(f_r(omega_i, omega_r, normal, material) * (omega_i @ normal) * weight))
