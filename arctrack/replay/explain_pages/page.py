"""explain_NNNNNN.html: why one frame gave its seam, or none, on one self-contained page."""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from PIL.ImageColor import getrgb

from arctrack.diagnose.pages.words import number, percent
from arctrack.printable import quoted
from arctrack.recording.setup_writer import FILE_NAME
from arctrack.replay.explain import Explanation, StripeLook
from arctrack.replay.explain_lines import READ, UNLIT, SigmaParts, read_with
from arctrack.replay.explain_pages import plots, words
from arctrack.report import style
from arctrack.report.embedded import CHANGE, Scale, binned, coloured, scale
from arctrack.report.image import seam_point_px, uri, visible
from arctrack.report.template import environment
from noise_model.compiled.arrays import Bool, Float64
from noise_model.instrument.sensor import Sensor, respond
from tracker.geometry import SensorGeometry
from tracker.joint.measured import off_section
from tracker.stripe.viterbi import GAIN_CAP

FRAME_PX, MAP_PX = 640, 320
"""Pictures are shrunk to about these widths; the residual's pixels are means, which show what noise hides."""

SATURATED = 255
"""The grey that stands for saturated pixels, which are drawn in a colour of their own."""

RESIDUAL_SIGMAS = 5.0
"""End of the residual's colour scale, sigmas."""

EXAGGERATIONS = (1, 2, 5, 10, 20, 50, 100, 200)
BAND_SHARE, SIGMA_QUANTILE = 1.0 / 24.0, 0.9
"""The stripe's sigma is enlarged so far that most scan lines' take no more than this share of the height."""


MARK_SHARE = 0.02
"""Half the size of a scan line's mark, over the image's height."""

MARK_PLACES = (-3.0, 3.0, -6.0, 6.0)
"""Places of a mark relative to the stripe, in half sizes: the first free one is used."""


@dataclass(frozen=True)
class Overlay:
    """Overlay of the frame, as SVG paths in its pixels; "" where there is none.

    `limits` are the band's, `sigma` the position ± `exaggeration` sigmas, `seam` the seam's point (x, y).
    """

    expected: str = ""
    limits: str = ""
    fitted: str = ""
    sigma: str = ""
    exaggeration: int = 1
    seam: tuple[float, float] | None = None


@dataclass(frozen=True)
class ArcPictures:
    """The predicted arc light, on the frame's scale, and the whitened residual with its colours."""

    predicted: str
    residual: str
    scale: Scale
    bin_px: int


def frame_picture(explanation: Explanation) -> str:
    """Return the frame in grey, by the square root, its saturated pixels in vermillion."""
    image, geometry = explanation.frame.image_dn, explanation.geometry
    return _grey(image, image >= geometry.saturation_dn, geometry.setup.sensor)


def arc_pictures(explanation: Explanation) -> ArcPictures | None:
    """Return the arc's pictures, None where no arc light could be predicted."""
    if explanation.look is None or explanation.look.arc is None:
        return None
    sensor, arc = explanation.geometry.setup.sensor, explanation.look.arc
    mean_dn = np.clip(respond(np.nan_to_num(arc.mean_e), sensor), 0.0, sensor.max_dn)
    bin_px = max(1, math.ceil(arc.whitened.shape[1] / MAP_PX))
    limit = RESIDUAL_SIGMAS
    return ArcPictures(
        _grey(mean_dn.astype(np.float32), np.zeros(mean_dn.shape, bool), sensor),
        coloured(binned(arc.whitened, bin_px), CHANGE, -limit, limit),
        scale(CHANGE, -limit, limit),
        bin_px,
    )


def overlay(explanation: Explanation) -> Overlay:
    """Return what is drawn over the frame."""
    camera, look = explanation.geometry.setup.camera, explanation.look
    # Where a seam was found is shown of a frame that is refused, too.
    point = seam_point_px(replace(explanation.track, flags=0), camera)
    seam = None if point is None else (float(point[0]), float(point[1]))
    if look is None or look.expected is None:
        return Overlay(seam=seam)
    expected = look.expected.shown_px
    rims = (expected - look.reach_px, expected + look.reach_px)
    drawn = Overlay(
        expected=path(explanation.geometry, expected),
        limits=" ".join(path(explanation.geometry, rim) for rim in rims),
        seam=seam,
    )
    return drawn if look.stripe is None else _with_stripe(drawn, explanation, look.stripe)


def marks(explanation: Explanation, scans: Sequence[int]) -> list[tuple[float, float]]:
    """Return where in the image (x, y), px, scan lines are marked, apart from each other."""
    look, camera = explanation.look, explanation.geometry.setup.camera
    if look is None or look.expected is None or look.stripe is None:
        return []
    fitted, size = look.stripe.reading.stripe.position_px, MARK_SHARE * camera.height
    stripe = np.where(np.isfinite(fitted), fitted, look.expected.position_px)
    most = np.array([camera.width, camera.height]) - size
    placed: list[Float64] = []
    for s in scans:
        tried = [
            np.clip(
                explanation.geometry.image_points(np.array([s]), stripe[[s]] + away * size)[0], size, most
            )
            for away in MARK_PLACES
        ]
        free = [point for point in tried if all(math.dist(point, other) > 2.5 * size for other in placed)]
        placed.append((free or tried)[0])
    return [(float(x), float(y)) for x, y in placed]


def path(geometry: SensorGeometry, position_px: Float64) -> str:
    """Return positions per scan line (n_scan,) as an SVG path in image pixels, broken where they are NaN.

    Nothing is drawn out of the image.
    """
    position = np.where((position_px >= 0.0) & (position_px < geometry.n_pos), position_px, np.nan)
    parts, is_down = [], False
    lines = np.arange(geometry.n_scan, dtype=np.float64)
    points = geometry.image_points(lines, position) + 0.5
    for x, y in points:
        if not math.isfinite(x + y):
            is_down = False
            continue
        parts.append(f"{'L' if is_down else 'M'}{x:.1f} {y:.1f}")
        is_down = True
    return "".join(parts)


def _with_stripe(drawn: Overlay, explanation: Explanation, look: StripeLook) -> Overlay:
    stripe = look.reading.stripe
    if not np.isfinite(stripe.position_px).any():
        return drawn
    room = (
        BAND_SHARE
        * explanation.geometry.setup.camera.height
        / float(np.nanquantile(stripe.sigma_px, SIGMA_QUANTILE))
    )
    times = max((k for k in EXAGGERATIONS if k <= room), default=1)
    rims = (stripe.position_px - times * stripe.sigma_px, stripe.position_px + times * stripe.sigma_px)
    return Overlay(
        drawn.expected,
        drawn.limits,
        path(explanation.geometry, stripe.position_px),
        " ".join(path(explanation.geometry, rim) for rim in rims),
        times,
        drawn.seam,
    )


def _grey(image_dn: npt.NDArray[np.generic], saturated: Bool, sensor: Sensor) -> str:
    """Return an image in grey by the square root, saturated pixels in vermillion."""
    bin_px = max(1, math.ceil(image_dn.shape[1] / FRAME_PX))
    shown = binned(image_dn.astype(np.float32), bin_px)
    grey = np.minimum(visible(shown, sensor), SATURATED - 1)
    grey[binned(saturated.astype(np.float32), bin_px) > 0.0] = SATURATED
    picture = Image.fromarray(grey).convert("L")
    palette = np.repeat(np.arange(256, dtype=np.uint8), 3)
    palette[-3:] = getrgb(style.VERMILLION)
    picture.putpalette(palette.tobytes())
    drawn = io.BytesIO()
    picture.save(drawn, format="png", optimize=True)
    return uri("image/png", drawn.getvalue())


@dataclass(frozen=True)
class PeakCandidate:
    """A place where the matched filter peaks, px, its score in sigmas, its gain; whether the path took it."""

    position_px: float
    score: float
    gain: float
    is_chosen: bool


@dataclass(frozen=True)
class ScanLineView:
    """A scan line on the page: its mark in the frame, what it is, its picture and candidates."""

    mark: str
    scan: int
    title: str
    summary: str
    uri: str
    candidates: tuple[PeakCandidate, ...]


def page(explanation: Explanation) -> str:
    """Return the page, which needs no other file and no network."""
    pages = environment()
    pages.globals.update(words=words, number=number, percent=percent)
    return pages.get_template("explain.html.j2").render(**_content(explanation))


def telling_lines(stripe: StripeLook) -> list[tuple[str, int]]:
    """Return informative scan lines with their role: best, median and worst sigma, one without a stripe.

    Of those without a stripe a refused fit is more informative than a line that the path passed over.
    """
    sigma = stripe.reading.stripe.sigma_px
    read = np.flatnonzero(np.isfinite(sigma))
    chosen: dict[int, str] = {}
    if read.size:
        order = read[np.argsort(sigma[read], kind="stable")]
        for name, s in (("best", order[0]), ("median", order[len(order) // 2]), ("worst", order[-1])):
            chosen.setdefault(int(s), f"{name} σ")
    why = stripe.refusals.why
    refused = np.flatnonzero((why != READ) & (why != UNLIT))
    if refused.size:
        fitted = refused[np.isfinite(stripe.reading.start_px[refused])]
        among = fitted if fitted.size else refused
        s = int(among[len(among) // 2])
        chosen[s] = f"no stripe ({why[s]})"
    return [(name, s) for s, name in chosen.items()]


def candidates(explanation: Explanation, stripe: StripeLook, s: int) -> tuple[PeakCandidate, ...]:
    """Return a scan line's likeliest candidates, the likeliest first, and the chosen one if it is no peak."""
    reading = stripe.reading
    score = reading.score[s].astype(float)
    gains = np.minimum(0.5 * np.maximum(score, 0.0) ** 2, GAIN_CAP)
    places = reading.around_px[s] + reading.offsets_px
    around = np.concatenate([[-np.inf], score, [-np.inf]])
    # Candidates that gain less are noise and not listed.
    peaks = np.flatnonzero((score >= around[:-2]) & (score > around[2:]) & (gains >= 2.0))
    # Candidates of a scan line that are listed.
    shown = list(peaks[np.argsort(-score[peaks], kind="stable")][:4])
    start = float(reading.start_px[s])
    taken = int(np.argmin(np.abs(places - start))) if math.isfinite(start) else None
    if taken is not None and taken not in shown:
        shown.append(taken)
    return tuple(PeakCandidate(float(places[i]), float(score[i]), float(gains[i]), i == taken) for i in shown)


def _content(explanation: Explanation) -> dict[str, Any]:
    look = explanation.look
    stripe = None if look is None else look.stripe
    lines = [] if stripe is None else _lines(explanation, stripe)
    # Without the map one variance stands for all pixels: it has no parts.
    has_parts = (
        stripe is not None and explanation.use_arc_map and bool(np.isfinite(stripe.parts.stripe).any())
    )
    has_path = look is not None and (look.seam is not None or explanation.before.history.n > 0)
    camera = explanation.geometry.setup.camera
    return {
        "explanation": explanation,
        "track": explanation.track,
        "look": look,
        "label": "valid" if explanation.track.valid else "no seam to use",
        "flags": words.raised(explanation.track.flags),
        "places": words.places(explanation),
        "frame": frame_picture(explanation),
        "overlay": overlay(explanation),
        "camera": camera,
        "saturated": int((explanation.frame.image_dn >= explanation.geometry.saturation_dn).sum()),
        "marks": marks(explanation, [line.scan for line in lines]),
        "arc": arc_pictures(explanation),
        "candidates": None if stripe is None else plots.candidates_picture(explanation, stripe),
        "gain_cap": GAIN_CAP,
        "lines": lines,
        "line": words.scan_line(explanation),
        "refused": words.refused_lines(explanation),
        "sigmas": plots.sigma_picture(explanation, stripe) if stripe is not None and has_parts else None,
        "parts": _shares(stripe.parts) if stripe is not None and has_parts else [],
        "sum_off": _sum_off(stripe) if stripe is not None and has_parts else math.nan,
        "profile": plots.profile_picture(explanation, look) if look is not None and look.profile else None,
        "left_out": _left_out(explanation),
        "history": plots.history_picture(explanation, look) if look is not None and has_path else None,
        "replay": _replay(explanation),
    }


def _replay(explanation: Explanation) -> str:
    """Return the command that replays the whole recording in the same way."""
    recording = explanation.recording
    command = f"arctrack replay {quoted(recording.path)}"
    if recording.setup_path != recording.path / FILE_NAME:
        command += f" --setup {quoted(recording.setup_path)}"
    return command if explanation.use_arc_map else f"{command} --no-arc-map"


def _lines(explanation: Explanation, stripe: StripeLook) -> list[ScanLineView]:
    lines = []
    for mark, (name, s) in zip("abcd", telling_lines(stripe), strict=False):
        title = f"{mark}: {words.scan_line(explanation)} {s}, {name}"
        uri = plots.line_picture(explanation, stripe, s, title)
        lines.append(
            ScanLineView(
                mark, s, title, _summary(explanation, stripe, s), uri, candidates(explanation, stripe, s)
            )
        )
    return lines


def _summary(explanation: Explanation, stripe: StripeLook, s: int) -> str:
    refusals = stripe.refusals
    if refusals.why[s] != READ:
        measured = ""
        if math.isfinite(refusals.height_e[s]):
            height, ratio = refusals.height_e[s], refusals.width_ratio[s]
            measured = f" What it found is {number(height)} e- high, {ratio:.2f} times as wide as expected."
        return f"No stripe: {words.REFUSALS[str(refusals.why[s])]}.{measured}"
    position, sigma, amplitude, _, chi2 = stripe.reading.fits[s, :5]
    share = (
        f"; the arc's share of the variance {percent(stripe.parts.arc_share[s])}"
        if explanation.use_arc_map
        else ""
    )
    pair = read_with(stripe.reading, s)
    together = f" Read as one with line {2 * pair.start + 1 - s}." if pair.stop - pair.start > 1 else ""
    return (
        f"Position {position:.2f} ± {number(sigma)} px; {number(amplitude)} e- high; "
        f"χ² {number(chi2)} per pixel{share}.{together}"
    )


def _shares(parts: SigmaParts) -> list[tuple[str, int]]:
    """Return each part's mean share of the variance in percent, rounded such that they add up to 100."""
    labels, _, values = zip(*plots.parts_with_floor(parts), strict=True)
    shares = 100.0 * np.nanmean(np.array(values) / np.sum(values, axis=0), axis=1)
    whole = np.floor(shares).astype(int)
    whole[np.argsort(whole - shares, kind="stable")[: 100 - whole.sum()]] += 1
    return list(zip(labels, whole.tolist(), strict=True))


def _sum_off(stripe: StripeLook) -> float:
    """Return how far the parts' sum is off the variance that the fit stated, at most, as a share of it."""
    return float(np.nanmax(np.abs(stripe.parts.variance_px2 / stripe.reading.stripe.sigma_px**2 - 1.0)))


def _left_out(explanation: Explanation) -> tuple[int, int] | None:
    """Return how many of the profile's points lie off the fitted section, and how many there are."""
    if explanation.look is None or explanation.look.joint is None:
        return None
    assert explanation.look.profile is not None
    left_out = off_section(explanation.look.profile.points, explanation.look.joint)
    return int(left_out.sum()), len(left_out)
