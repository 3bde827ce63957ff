"""Pictures of calibration boards by Mitsuba 3, a renderer that is not ours, before cameras of known truth.

Mitsuba casts the rays and computes the light: its stock `roughplastic` on a bent mesh, its `constant`,
`sphere` and `projector` emitters, its `direct` integrator. Around it stand the lens, written out in
`camera_worlds.project` from OpenCV's documentation, a thin lens' defocus, cos^4, a Gaussian point-spread
function, shot noise, read noise and rounding. Nothing here is the estimator's.

Light adds up: room, lamp and laser are rendered apart, each with the way of sampling that scatters least.
Frames are the camera's, in mm. Pixel centres are at integers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from camera_worlds import project

from calibration.boards.board import Board, BoardKind
from noise_model.compiled.arrays import Float64, Integers
from validation.second_renderer.path_traced import load_mitsuba

ROOM_SAMPLES = 4
"""Directions to the room's light for each ray: gloss scatters more there than under lamp and laser."""

INVERSE_ROUNDS, INVERSE_SETTLED = 200, 1e-8
"""Fixed points of the lens' inverse: a ray is found to some 1e-5 px."""

TEXELS = 48
"""Texels along a square's side. Edges lie between texels, and are as sharp as rays are."""

MARGIN = 0.5
"""What is white about the outer squares, over a square's side."""

MESH = 64
"""Pieces of the bent mesh along a side: it is off the parabola by 1/4000 of the bend."""

WHITE, BLACK, TABLE = 0.8, 0.04, 0.35
"""What paper, print, and the table behind the board reflect diffusely."""

TABLE_MM = 3.0, 5000.0
"""How far behind the board the table is, and half its side."""

LINE_TEXELS, LINE_SIZE = 12.0, (256, 4096)
"""The projected line's texels to its sigma, and texels across it and along it."""

CENTRED = 0.65
"""What share of the full well white paper fills under room and lamp together, squarely lit."""


ROUGHNESS = 0.15, 0.4
"""From paper that shines to paper that hardly does."""


@dataclass(frozen=True)
class Sensor:
    """A camera: OpenCV's coefficients, its optics and its pixels.

    Parameters
    ----------
    size : tuple of int
        Width and height, px.
    lens : dict
        fx, fy, cx, cy and OpenCV's distortion coefficients.
    aperture_mm, focus_mm : float
        The pupil's diameter, and how far away what is sharp is.
    blur_px : float
        1 sigma of the point-spread function, beside defocus and the pixel's own square.
    full_well_e, read_noise_e : float
        Electrons at the last code, and 1 sigma of those that reading adds.
    bits : int
        Of a code.
    strata : int
        Its square is the number of rays through a pixel.
    """

    size: tuple[int, int]
    lens: dict[str, float]
    aperture_mm: float
    focus_mm: float
    blur_px: float = 0.6
    full_well_e: float = 15000.0
    read_noise_e: float = 8.0
    bits: int = 8
    strata: int = 4


@dataclass(frozen=True)
class Lamp:
    """A luminous ball beside room light of irradiance 1: centre (3,), mm, radius, and how strong it is.

    `share` is its irradiance where it shines squarely, at its distance from `aim_mm` (3,), over the room's.
    """

    center_mm: Float64
    radius_mm: float
    aim_mm: Float64
    share: float


@dataclass(frozen=True)
class Paper:
    """A printed board: which, how far it rises in the middle along x and y, mm, and the gloss' roughness.

    `roughness` is GGX's alpha (Walter et al. 2007): 0.1 is glossy, 0.4 is matt.
    """

    board: Board
    warp_mm: Float64
    roughness: float


@dataclass(frozen=True)
class Sheet:
    """A laser sheet: its origin (3,), mm, unit vectors to its middle and along it, angles in rad.

    `sigma` is 1 sigma of half its thickness as seen from the origin. `peak` is its irradiance on a board that
    it meets squarely where it meets `aim_mm` (3,), over the room's.
    """

    origin_mm: Float64
    middle: Float64
    along: Float64
    sigma: float
    half_angle: float
    aim_mm: Float64
    peak: float

    @property
    def plane(self) -> Float64:
        """The plane (4,), n.X + d = 0, mm."""
        normal = np.cross(self.middle, self.along)
        return np.array([*normal, -normal @ self.origin_mm])


@dataclass(eq=False)
class Studio:
    """A camera in a lit room.

    Raises ImportError where Mitsuba cannot start; it says what is missing.
    """

    sensor: Sensor
    lamp: Lamp
    rng: np.random.Generator
    exposure: float = 1.0
    _mi: Any = field(init=False)
    _rays: Any = field(init=False)
    _cos4: Float64 = field(init=False)

    def __post_init__(self) -> None:
        self._mi = load_mitsuba()
        xy, origins = sample_rays(self.sensor, self.rng)
        d = np.column_stack([xy, np.ones(len(xy))]) * self.sensor.focus_mm - origins
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        self._cos4 = (1.0 + np.sum(xy**2, axis=1)) ** -2.0
        o, d = (np.ascontiguousarray(each.T, dtype=np.float32) for each in (origins, d))
        self._rays = self._mi.RayDifferential3f(o=self._mi.Point3f(o), d=self._mi.Vector3f(d))

    def light_e(self, paper: Paper, R: Float64, t: Float64, sheet: Sheet | None = None) -> Float64:
        """Return the electrons (H, W) that a board makes; R and t take its points, mm, to the camera.

        Expected ones but for Mitsuba's own scatter. With a sheet they are those of its light alone.
        """
        shapes = self._shapes(paper, R, t)
        if sheet is None:
            light = self._traced(
                shapes, {"type": "constant", "radiance": 1.0 / math.pi}, "bsdf_samples", ROOM_SAMPLES
            )
            if self.lamp.share > 0.0:
                light += self._traced(shapes, self._lamp(), "emitter_samples")
        else:
            light = self._traced(shapes, self._projector(sheet), "emitter_samples")
        full = WHITE / math.pi * (1.0 + self.lamp.share) / CENTRED
        blurred = cv2.GaussianBlur(light / full, (0, 0), self.sensor.blur_px)
        return np.asarray(self.exposure * self.sensor.full_well_e * blurred)

    def picture(self, light_e: Float64) -> Integers:
        """Return the codes (H, W) of a frame: shot noise, read noise, rounding, the last code."""
        last = 2**self.sensor.bits - 1
        counted = self.rng.poisson(light_e) + self.sensor.read_noise_e * self.rng.standard_normal(
            light_e.shape
        )
        codes = np.rint(counted * (last / self.sensor.full_well_e)).clip(0, last)
        return codes.astype(np.uint8 if self.sensor.bits <= 8 else np.uint16)

    def _traced(
        self, shapes: dict[str, Any], emitter: dict[str, Any], sampled: str, samples: int = 1
    ) -> Float64:
        """Return the radiance (H, W) of one light, over pixels and pupil; `sampled` says what is drawn."""
        mi, n = self._mi, len(self._cos4)
        direct = {"type": "direct", "bsdf_samples": 0, "emitter_samples": 0, "hide_emitters": True}
        direct[sampled] = samples
        scene = mi.load_dict({"type": "scene", "integrator": direct, "light": emitter, **shapes})
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(int(self.rng.integers(2**31)), n)
        radiance, *_ = scene.integrator().sample(scene, sampler, self._rays)
        width, height = self.sensor.size
        light = np.array(radiance, dtype=np.float64).reshape(-1) * self._cos4
        return np.asarray(light.reshape(height, width, self.sensor.strata**2).mean(axis=2))

    def _lamp(self) -> dict[str, Any]:
        distance = float(np.linalg.norm(self.lamp.center_mm - self.lamp.aim_mm))
        radiance = self.lamp.share / math.pi * (distance / self.lamp.radius_mm) ** 2
        return {
            "type": "sphere",
            "center": self.lamp.center_mm.tolist(),
            "radius": self.lamp.radius_mm,
            "emitter": {"type": "area", "radiance": radiance},
        }

    def _projector(self, sheet: Sheet) -> dict[str, Any]:
        """Return a projector of a line: a Gaussian across it, even along it to the fan's ends."""
        mi = self._mi
        u, v = (np.arange(n) - 0.5 * (n - 1) for n in LINE_SIZE)
        pitch = math.tan(sheet.sigma) / LINE_TEXELS
        shape = (
            np.exp(-0.5 * (u / LINE_TEXELS) ** 2) * (np.abs(v) * pitch <= np.tan(sheet.half_angle))[:, None]
        )
        depth = float((sheet.aim_mm - sheet.origin_mm) @ sheet.middle)
        bitmap = mi.Bitmap(shape[:, :, np.newaxis].astype(np.float32))
        return {
            "type": "projector",
            "irradiance": {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"},
            "scale": sheet.peak * depth**2,
            "fov": math.degrees(2.0 * math.atan(0.5 * len(u) * pitch)),
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f().look_at(
                origin=sheet.origin_mm.tolist(),
                target=(sheet.origin_mm + sheet.middle).tolist(),
                up=sheet.along.tolist(),
            ),
        }

    def _shapes(self, paper: Paper, R: Float64, t: Float64) -> dict[str, Any]:
        """Return board and table for Mitsuba; R and t take the board's points, mm, to the camera."""
        mi, board = self._mi, paper.board
        span = np.array([board.columns - 1, board.rows - 1]) * board.square_mm
        low = -(1.0 + MARGIN) * board.square_mm
        steps = np.linspace(0.0, 1.0, MESH + 1)
        u, v = (each.ravel() for each in np.meshgrid(steps, steps))
        x, y = (low + share * (length - 2.0 * low) for share, length in zip((u, v), span, strict=True))
        a, b = 2.0 * x / span[0] - 1.0, 2.0 * y / span[1] - 1.0
        z = paper.warp_mm[0] * (1.0 - a * a) + paper.warp_mm[1] * (1.0 - b * b)
        # The printed side looks to the camera, along the board's -z.
        slope = -4.0 * paper.warp_mm / span
        normals = np.column_stack([slope[0] * a, slope[1] * b, -np.ones_like(a)])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        first = (np.arange(MESH)[:, np.newaxis] * (MESH + 1) + np.arange(MESH)).ravel()
        right, down, across = first + 1, first + MESH + 1, first + MESH + 2
        triangles = np.vstack([np.stack([first, down, right], 1), np.stack([right, down, across], 1)])
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(
            {
                "type": "roughplastic",
                "distribution": "ggx",
                "alpha": paper.roughness,
                "diffuse_reflectance": {
                    "type": "bitmap",
                    "bitmap": mi.Bitmap(printed(board)[:, :, np.newaxis].astype(np.float32)),
                    "raw": True,
                    "filter_type": "nearest",
                    "wrap_mode": "clamp",
                },
            }
        )
        mesh = mi.Mesh(
            "board",
            len(x),
            len(triangles),
            has_vertex_normals=True,
            has_vertex_texcoords=True,
            props=properties,
        )
        values = mi.traverse(mesh)
        points = np.column_stack([x, y, z]) @ R.T + t
        for name, each in (
            ("vertex_positions", points),
            ("vertex_normals", normals @ R.T),
            ("vertex_texcoords", np.column_stack([u, v])),
        ):
            values[name] = mi.Float(each.astype(np.float32).ravel())
        values["faces"] = mi.UInt32(triangles.astype(np.uint32).ravel())
        values.update()
        back, half_side = TABLE_MM
        # A rectangle looks along its own z: half a turn about x lets it look to the camera.
        to_world = np.eye(4)
        to_world[:3, :3] = R @ np.diag([1.0, -1.0, -1.0]) * half_side
        to_world[:3, 3] = R @ np.array([*0.5 * span, back]) + t
        table = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(to_world),
            "bsdf": {"type": "diffuse", "reflectance": TABLE},
        }
        return {"board": mesh, "table": table}


def draw_studio(
    rng: np.random.Generator,
    size: tuple[int, int],
    lens: dict[str, float],
    distance_mm: float,
    exposure: float = 1.0,
) -> Studio:
    """Return a random camera and a random lamp; boards are some `distance_mm` away.

    What is sharp is near there. The pupil is so wide that a board a third nearer has a defocus of 1 px, 1
    sigma, at most. The lamp is 20 to 55 deg off the camera's line of sight.
    """
    focal = lens["fx"]
    sensor = Sensor(
        size,
        lens,
        aperture_mm=float(rng.uniform(2.0, 8.0)) * distance_mm / focal,
        focus_mm=distance_mm * float(rng.uniform(0.9, 1.1)),
        blur_px=float(rng.uniform(0.5, 0.9)),
        full_well_e=float(rng.uniform(8e3, 3e4)),
        read_noise_e=float(rng.uniform(3.0, 12.0)),
        bits=int(rng.choice([8, 12])),
    )
    lean, side = np.radians(rng.uniform(20.0, 55.0)), rng.uniform(0.0, 2.0 * np.pi)
    towards = np.array([np.sin(lean) * np.cos(side), np.sin(lean) * np.sin(side), -np.cos(lean)])
    aim = np.array([0.0, 0.0, distance_mm])
    away_mm = distance_mm * rng.uniform(0.8, 1.6)
    lamp = Lamp(aim + away_mm * towards, 0.06 * away_mm, aim, float(rng.uniform(0.3, 1.2)))
    return Studio(sensor, lamp, rng, exposure)


def printed(board: Board) -> Float64:
    """Return what a board's face reflects (rows, columns) diffusely, its white margin included."""
    counts = np.array([board.columns + 1, board.rows + 1])
    if board.kind is BoardKind.CHARUCO:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
        drawn = cv2.aruco.CharucoBoard(counts.tolist(), board.square_mm, board.marker_mm, dictionary)
        is_white = drawn.generateImage((counts * TEXELS).tolist()) > 127
    else:
        column, row = (np.arange(n * TEXELS) // TEXELS for n in counts)
        is_white = (column + row[:, np.newaxis]) % 2 == 1
    margin = round(MARGIN * TEXELS)
    return np.pad(np.where(is_white, WHITE, BLACK), margin, constant_values=WHITE)


def sample_rays(sensor: Sensor, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Return rays (n, 2), as (x, y, 1), and their points on the pupil (n, 3), mm, strata^2 for each pixel.

    In a pixel they are a lattice of one point to a row and a column of strata^2, shifted by chance (Kensler,
    Correlated Multi-Jittered Sampling, 2013; Cranley and Patterson 1976). So is the pupil, in another order.
    """
    (width, height), strata = sensor.size, sensor.strata
    i, j = (each.ravel() for each in np.meshgrid(np.arange(strata), np.arange(strata)))
    lattice = np.column_stack([i + (j + 0.5) / strata, j + (i + 0.5) / strata]) / strata
    pixel, pupil = (
        (pattern + rng.random((height, width, 1, 2))) % 1.0 for pattern in (lattice, rng.permutation(lattice))
    )
    v, u = np.mgrid[:height, :width]
    image = (np.stack([u, v], axis=-1)[:, :, np.newaxis] + pixel - 0.5).reshape(-1, 2)
    # Equal areas of the square are equal areas of the disc.
    radius, angle = 0.5 * sensor.aperture_mm * np.sqrt(pupil[..., 0]), 2.0 * np.pi * pupil[..., 1]
    origins = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros_like(radius)], axis=-1)
    return undistorted(sensor.lens, image), origins.reshape(-1, 3)


def undistorted(lens: dict[str, float], image_px: Float64) -> Float64:
    """Return the rays (n, 2), as (x, y, 1), that OpenCV's formula takes to image points (n, 2), px.

    Raises ValueError where fixed points do not settle: the lens folds.
    """
    focal, center = (np.array([lens[f"{kind}x"], lens[f"{kind}y"]]) for kind in "fc")
    xy = (image_px - center) / focal
    # Where the lens folds, fixed points run off.
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(INVERSE_ROUNDS):
            off = (project(lens, np.column_stack([xy, np.ones(len(xy))])) - image_px) / focal
            xy = xy - off
            if np.abs(off).max() < INVERSE_SETTLED:
                return np.asarray(xy)
    raise ValueError("the lens shows no ray at some of the image's points: its distortion folds")
