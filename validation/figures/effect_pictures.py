"""A picture of each effect: the nominal frame, the frame that it makes, and what it changes, in DN."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image, PngImagePlugin
from scipy.spatial import KDTree

from arctrack.nominal import nominal_setup
from arctrack.report import style
from arctrack.simulation.simulate import balance
from noise_model.compiled.arrays import Float64, UInt8
from noise_model.condition import Condition
from noise_model.effects import Effect, checked, pose_time_s
from noise_model.forward import Prediction, Renderer, draw_frame, predict
from noise_model.instrument.sensor import respond
from noise_model.setup import Setup
from noise_model.surface.joint import corrugation_height, seam_frame, section
from validation.figures.paper_figures import NAMES

GREYS, CHANGE, SCATTER = "gray", "RdBu_r", "viridis"
"""The colour maps of frames, differences and standard deviations."""

WIDTH_INCH = 8.4
TITLE_LETTERS, CAPTION_LETTERS = 88, 138
TITLE_INCH, CAPTION_INCH = 0.2, 0.15
CLIPPED_PERCENT = 99.5
"""The colours of a difference reach as far as this share of its pixels."""

MIN_DN = 0.5
"""The smallest difference that the colours' ends stand for: smaller ones are no frame's business."""

TRAVEL_SPEED_MM_S, WEAVE_MM, WEAVE_PERIOD_S, HEIGHT_MM = 8.0, 1.5, 1.7, 1.0
TIMES_S = (0.0, 1.0, 2.0, 3.0, 4.0)
SEED = 3

JOINT_NAMES = {"v_groove": "V-groove", "lap": "lap", "corrugation": "corrugated lap"}
WHAT_IS_ON = {(True, False): "laser alone", (False, True): "arc alone", (True, True): "laser and arc on"}


class Form(Enum):
    """How an effect is shown: expected frames, single random ones, or frames one after another."""

    EXPECTED = "the expected frames"
    SINGLE = "a single frame of each, and the predicted 1 σ"
    IN_TURN = "frames one after another"


@dataclass(frozen=True)
class Choice:
    """Where an effect shows best.

    `station_mm` is the tool's place along the seam; `window` (u, v, width) the part of the frame that is
    shown, as shares of its width and height, of the frame's own shape.
    """

    joint: str = "v_groove"
    material: str = "mild_steel"
    laser_on: bool = True
    arc_on: bool = True
    form: Form = Form.EXPECTED
    station_mm: float = 0.0
    window: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @property
    def scene(self) -> str:
        """The scene in words."""
        on = WHAT_IS_ON[self.laser_on, self.arc_on]
        return f"{JOINT_NAMES[self.joint]}, {NAMES[self.material]}, {on}"


ARC = Choice(laser_on=False)
LASER = Choice(arc_on=False)
LOBE = Choice("corrugation", station_mm=10.0)
CLOSE, NEAR = (0.4, 0.4, 0.2), (0.35, 0.35, 0.3)
CHOICES: Mapping[str, Choice] = {
    "arc_length": ARC,
    "arc_deflection": ARC,
    "arc_radius": ARC,
    "arc_flicker": Choice(form=Form.IN_TURN),
    "argon_line_leak": ARC,
    "laser_power_drift": replace(LASER, form=Form.IN_TURN),
    "laser_speckle": replace(LASER, form=Form.SINGLE, window=CLOSE),
    "uneven_fan": LASER,
    "stripe_profile": replace(LASER, window=NEAR),
    "ambient_light": LASER,
    "plate_outline": Choice("lap", "zn_coated"),
    "interreflection": Choice("corrugation", "zn_coated", station_mm=20.0),
    "wrong_material": LOBE,
    "roughness_change": LOBE,
    "brdf_tail": LOBE,
    "rolling_marks": LOBE,
    "groove_glare": ARC,
    "mirrored_stripe": replace(LASER, window=NEAR),
    "spatter": Choice(form=Form.SINGLE),
    "spatter_streaks": Choice(form=Form.SINGLE),
    "defocus": Choice(window=NEAR),
    "ghost_stripe": LASER,
    "exposure_drift": Choice(form=Form.IN_TURN),
    "fixed_pattern": Choice(form=Form.SINGLE, window=CLOSE),
    "blooming": LOBE,
    "read_noise": Choice(form=Form.SINGLE, window=CLOSE),
    "image_compression": Choice(form=Form.SINGLE, window=CLOSE),
    "lens_distortion": LOBE,
}
"""Where each effect shows best; one that is not named here is shown on the groove, laser and arc on."""


def choice(effect_id: str) -> Choice:
    """Return where an effect shows best."""
    return CHOICES.get(effect_id, Choice())


def stated(effect: Effect) -> str:
    """Return an effect's typical values in words."""
    return ", ".join(f"{name} = {value:g}" for name, value in effect.typical.items())


def description(effect: Effect) -> str:
    """Return what a picture shows, as its file says it: a picture of other values is out of date."""
    return f"{effect.id}: {stated(effect)}; {choice(effect.id)}"


def write(figure: Figure, effect: Effect, path: Path) -> None:
    """Write an effect's picture as a small PNG whose Description says what it shows."""
    full = io.BytesIO()
    figure.savefig(full, format="png")
    picture = _in_few_colours(np.asarray(Image.open(full).convert("RGB")))
    says = PngImagePlugin.PngInfo()
    says.add_text("Description", description(effect))
    picture.save(path, optimize=True, pnginfo=says)


def _in_few_colours(picture: UInt8) -> Image.Image:
    """Return a picture (H, W, 3) in the colours of the colour maps; ones made from it would bend the maps."""
    maps = ((GREYS, 106), (CHANGE, 101), (SCATTER, 48))
    colours = np.vstack([mpl.colormaps[name](np.linspace(0.0, 1.0, n))[:, :3] for name, n in maps])
    palette = np.rint(255.0 * colours).astype(np.uint8)
    shown, place = np.unique(picture.reshape(-1, 3), axis=0, return_inverse=True)
    nearest = KDTree(palette).query(shown)[1].astype(np.uint8)
    few = Image.fromarray(nearest[place].reshape(picture.shape[:2]))
    few.putpalette(palette.tobytes())
    return few


@dataclass(frozen=True, eq=False)
class EffectScene:
    """The scene that an effect is shown in: the setup without and with it."""

    nominal: Setup
    changed: Setup
    chosen: Choice
    renderer: Renderer

    @classmethod
    def of(cls, effect: Effect, renderer: Renderer, *, width: int = 640, height: int = 480) -> EffectScene:
        """Set the scene up; images of other sizes keep the field of view."""
        chosen = choice(effect.id)
        setup = balance(nominal_setup(chosen.joint, chosen.material, width=width, height=height))
        changed = replace(setup, effects=checked({effect.id: effect.typical}))
        return cls(setup, changed, chosen, renderer)

    def condition(self, timestamp_s: float) -> Condition:
        """Return what is on."""
        exposure_s = self.nominal.camera.exposure_s
        return Condition(float(self.chosen.laser_on), float(self.chosen.arc_on), exposure_s, timestamp_s)

    def T_base_tool(self, setup: Setup) -> Float64:
        """Return the pose (4, 4), mm, of a frame at time 0 of a level tool that weaves over the seam."""
        time_s = pose_time_s(setup, 0.0)
        joint = self.nominal.joint
        x_mm = self.chosen.station_mm + TRAVEL_SPEED_MM_S * time_s
        T_joint_tool = np.eye(4)
        T_joint_tool[:3, 3] = (
            x_mm,
            WEAVE_MM * math.sin(2.0 * math.pi * time_s / WEAVE_PERIOD_S),
            HEIGHT_MM + float(corrugation_height(np.array(x_mm), section(joint).corrugation)),
        )
        return seam_frame(joint, np.asarray(joint.seam_in_base_mm[0])) @ T_joint_tool

    def expected(self, setup: Setup, timestamp_s: float = 0.0) -> Prediction:
        """Predict a frame; all are taken from the pose at time 0."""
        return predict(setup, self.T_base_tool(setup), self.condition(timestamp_s), renderer=self.renderer)

    def single(self, setup: Setup, rng: np.random.Generator) -> Float64:
        """Draw a frame (H, W), DN."""
        frame = draw_frame(setup, self.T_base_tool(setup), self.condition(0.0), rng, renderer=self.renderer)
        return frame.astype(np.float64)

    def part(self, image: Float64) -> Float64:
        """Return the part of an image (H, W) that is shown."""
        u, v, share = self.chosen.window
        height, width = image.shape
        column, row = round(u * width), round(v * height)
        return image[row : row + round(share * height), column : column + round(share * width)]


def draw(effect: Effect, shown: EffectScene) -> Figure:
    """Return an effect's picture, drawn for a page."""
    forms = {Form.EXPECTED: _expected, Form.SINGLE: _single, Form.IN_TURN: _in_turn}
    return forms[shown.chosen.form](effect, shown)


def _expected(effect: Effect, shown: EffectScene) -> Figure:
    before, after = shown.expected(shown.nominal), shown.expected(shown.changed)
    change = after.mean_dn - before.mean_dn
    largest = _largest(shown.part(change))
    noise = float(np.median(np.sqrt(before.variance_dn2)))
    figure = _page(
        effect,
        2.75,
        f"{_scene(shown)}. Largest difference {_signed(largest)} DN, a frame's noise {noise:.1f} DN.",
    )
    cells = figure.subplots(1, 3)
    _frame(cells[0], shown, before.mean_dn, "nominal")
    _frame(cells[1], shown, after.mean_dn, "with the effect")
    limit = _limit(shown.part(change))
    _difference(cells[2], shown, change, limit, "difference")
    _colours(figure, list(cells), CHANGE, -limit, limit, "both" if abs(largest) > limit else "neither")
    return figure


def _single(effect: Effect, shown: EffectScene) -> Figure:
    sigmas = [np.sqrt(shown.expected(setup).variance_dn2) for setup in (shown.nominal, shown.changed)]
    rng = np.random.default_rng(SEED)
    frames = [shown.single(setup, rng) for setup in (shown.nominal, shown.changed)]
    figure = _page(
        effect,
        2.3,
        f"{_scene(shown)}. Single frames, and 1 σ of each pixel as predicted.",
    )
    cells = figure.subplots(1, 4)
    _frame(cells[0], shown, frames[0], "a nominal frame")
    _frame(cells[1], shown, frames[1], "one with the effect")
    top = _nice(float(max(shown.part(sigma).max() for sigma in sigmas)))
    for axes, sigma, title in zip(cells[2:], sigmas, ("1 σ, nominal", "1 σ, with the effect"), strict=True):
        _bare(axes, title).imshow(shown.part(sigma), cmap=SCATTER, vmin=0.0, vmax=top)
    _colours(figure, list(cells), SCATTER, 0.0, top, "neither")
    return figure


def _in_turn(effect: Effect, shown: EffectScene) -> Figure:
    nominal, sensor = shown.expected(shown.nominal), shown.nominal.sensor
    modes = shown.expected(shown.changed).modes_e
    changed: list[Float64]
    if modes:
        rng = np.random.default_rng(SEED)
        changed = [shown.single(shown.changed, rng) for _ in TIMES_S[1:]]
        titles = [f"frame {n}" for n in range(1, len(TIMES_S))]
        (mode_e,) = modes.values()
        # Behind the response: a saturated pixel cannot go up.
        below = respond(nominal.mean_e + mode_e, sensor) - respond(nominal.mean_e, sensor)
        first, under = "expected, nominal", "1 σ up, predicted"
        words = "Single frames from one pose; below, what differs"
    else:
        changed = [shown.expected(shown.changed, time_s).mean_dn for time_s in TIMES_S[1:]]
        titles = [f"after {time_s:g} s" for time_s in TIMES_S[1:]]
        below = shown.expected(shown.changed, TIMES_S[0]).mean_dn - nominal.mean_dn
        first, under = "at first, nominal", "difference"
        words = "Expected frames from one pose; below, what differs"
    changes = [frame - nominal.mean_dn for frame in changed]
    figure = _page(
        effect,
        3.4,
        f"{_scene(shown)}. {words}.",
    )
    cells = figure.subplots(2, len(TIMES_S))
    _frame(cells[0, 0], shown, nominal.mean_dn, first)
    for axes, frame, title in zip(cells[0, 1:], changed, titles, strict=True):
        _frame(axes, shown, frame, title)
    limit = max(_limit(change) for change in changes)
    _difference(cells[1, 0], shown, below, limit, under)
    for axes, change in zip(cells[1, 1:], changes, strict=True):
        _difference(axes, shown, change, limit, f"{_signed(_largest(change))} DN at most")
    extend = "both" if max(np.abs(change).max() for change in changes) > limit else "neither"
    _colours(figure, list(cells[1]), CHANGE, -limit, limit, extend)
    return figure


def _page(effect: Effect, height_inch: float, caption: str) -> Figure:
    """Return an empty figure; `height_inch` is that with a title and a caption of one line each."""
    title = textwrap.wrap(f"{effect.id}: {stated(effect)}".replace("-", "−"), TITLE_LETTERS)
    lines = textwrap.wrap(caption, CAPTION_LETTERS)
    height_inch += TITLE_INCH * (len(title) - 1) + CAPTION_INCH * (len(lines) - 1)
    figure = style.new_figure(WIDTH_INCH, height_inch, "\n".join(title))
    figure.supxlabel("\n".join(lines), x=0.01, ha="left", fontsize=8.5)
    return figure


def _bare(axes: Axes, title: str) -> Axes:
    axes.set_title(title, loc="left", fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    return axes


def _frame(axes: Axes, shown: EffectScene, image_dn: Float64, title: str) -> None:
    sensor = shown.nominal.sensor
    signal = np.maximum(image_dn - sensor.black_level_dn, 0.0) / (sensor.max_dn - sensor.black_level_dn)
    _bare(axes, title).imshow(shown.part(np.sqrt(signal)), cmap=GREYS, vmin=0.0, vmax=1.0)


def _difference(axes: Axes, shown: EffectScene, change: Float64, limit: float, title: str) -> None:
    _bare(axes, title).imshow(shown.part(change), cmap=CHANGE, vmin=-limit, vmax=limit)


def _colours(figure: Figure, cells: list[Axes], name: str, low: float, high: float, extend: str) -> None:
    colours = ScalarMappable(Normalize(low, high), mpl.colormaps[name])
    bar = figure.colorbar(colours, ax=cells, aspect=14, shrink=0.8, pad=0.01, extend=extend)
    bar.set_label("DN", fontsize=9)
    bar.ax.tick_params(labelsize=8)


def _limit(change: Float64) -> float:
    """Return where a difference's colours end, DN."""
    return _nice(max(MIN_DN, float(np.percentile(np.abs(change), CLIPPED_PERCENT))))


def _nice(value: float) -> float:
    """Return the next higher one of 1, 1.5, 2, 3, 4, 5, 6, 8 and their tenfolds."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(step * decade for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10, 15) if step * decade >= value)


def _largest(change: Float64) -> float:
    """Return the difference that is farthest from 0, with its sign."""
    return float(change.ravel()[np.abs(change).argmax()])


def _signed(value: float) -> str:
    return f"{value:+.1f}".replace("-", "−")


def _scene(shown: EffectScene) -> str:
    sensor, camera, share = shown.nominal.sensor, shown.nominal.camera, shown.chosen.window[2]
    scene = shown.chosen.scene
    part = f", {round(share * camera.width)} × {round(share * camera.height)} px" if share < 1.0 else ""
    brightness = f"brightness by √, {sensor.black_level_dn:g} to {sensor.max_dn} DN"
    return f"{scene[:1].upper()}{scene[1:]}{part}; {brightness}"
