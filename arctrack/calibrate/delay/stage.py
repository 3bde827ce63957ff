"""Calibration of the delay between poses and frames from a recording with motion, and its page."""

import numpy as np
from matplotlib.ticker import FormatStrFormatter

from arctrack.calibrate.page import HALF_95, CalibrationPage, PagePicture, row_of, with_sigma
from arctrack.calibrate.stage import CalibrationStage, Steps
from arctrack.errors import in_file
from arctrack.recording import CalibrationValues, Recording
from arctrack.report import style
from arctrack.report.embedded import svg
from calibration.pose_delay import MAX_SIGMA_S, PoseDelay, PoseTrack, estimate_pose_delay, with_delay

LINEAR_NATS = 10.0
"""Further below its maximum the likelihood's scale is a logarithm: other maxima show."""


def delay_page(result: PoseDelay, recording: Recording) -> CalibrationPage:
    """Return the page's content."""
    delay_ms, sigma_ms = 1e3 * result.delay_s, 1e3 * result.sigma_s
    value, sigma = with_sigma(delay_ms, sigma_ms)
    count = len(result.observations.timestamps_s)
    stated_s = recording.setup.effects.get("pose_delay", {}).get("delay_s", 0.0)
    is_known = result.unestimated is None
    why = () if result.unestimated is None else (f"{result.unestimated[0].upper()}{result.unestimated[1:]}.",)
    sentences = (
        *why,
        "A frame's pose is the one that the controller stamps this much after the frame's own time. The "
        f"setup stated {1e3 * stated_s:g} ms.",
        f"{count} frames show the seam. Across it and in height their points move by "
        f"{result.motion_mm_s:.1f} mm/s (RMS).",
    )
    return CalibrationPage(
        title=f"arctrack calibrates the delay of {recording.name}",
        label="pose delay" if is_known else "unestimated",
        headline=f"{value} ± {sigma} ms" if is_known else "The delay is unestimated",
        sentences=sentences,
        rows=(row_of("delay of the poses' clock", "delay_s", delay_ms, sigma_ms, "ms"),) if is_known else (),
        pictures=(
            PagePicture(
                _seam(result, recording),
                "the seam beside its nominal line: with the delay as stated, and as estimated",
                "With the right delay the points lie on one smooth seam; with another the tool's own "
                "motion shows.",
            ),
            PagePicture(
                _likelihood(result),
                "the likelihood's logarithm over the delay, 0 at its maximum",
                f"A delay is estimated where 1 σ is below {1e3 * MAX_SIGMA_S:g} ms and no other one is as "
                "likely.",
            ),
        ),
        notes=(
            f"About a smooth seam its points scatter by {result.scatters_mm[0]:.3f} mm sideways and "
            f"{result.scatters_mm[1]:.3f} mm in height beyond the tracker's own sigmas.",
        ),
        mark="no_gap" if is_known else "ambiguous",
    )


def _seam(result: PoseDelay, recording: Recording) -> str:
    figure = style.new_figure(10.5, 4.4, "")
    lateral, height = figure.subplots(1, 2)
    stated = recording.setup.effects.get("pose_delay", {}).get("delay_s", 0.0)
    for axis, (axes, title) in enumerate(((lateral, "sideways, + left"), (height, "in height, + up"))):
        style.plain(axes, "station [mm]", "mm", title)
        for delay_s, colour, marker, name in (
            (stated, style.GREY, "x", "as stated"),
            (result.delay_s, style.BLUE, ".", "as estimated" if result.unestimated is None else "likeliest"),
        ):
            stations, seen = result.observations.in_joint(with_delay(recording.setup, delay_s))
            axes.plot(
                stations,
                seen[:, axis],
                marker,
                color=colour,
                markersize=5,
                label=f"{name}: {1e3 * delay_s:.1f} ms",
            )
    lateral.legend(fontsize=8)
    return svg(figure)


def _likelihood(result: PoseDelay) -> str:
    figure = style.new_figure(10.5, 3.2, "")
    axes = style.plain(figure.add_subplot(), "delay [ms]", "ln likelihood")
    axes.plot(1e3 * result.delays_s, result.ln_likelihood, "-", color=style.BLUE, linewidth=1.2)
    if np.isfinite(result.sigma_s):
        ends = 1e3 * (result.delay_s + HALF_95 * result.sigma_s * np.array([-1.0, 1.0]))
        axes.axvspan(*ends, color=style.VERMILLION, alpha=0.3, lw=0, label="95 %")
        axes.legend(fontsize=8)
    axes.axvline(1e3 * result.delay_s, color=style.VERMILLION, linewidth=0.9)
    lowest = float(np.min(result.ln_likelihood, where=np.isfinite(result.ln_likelihood), initial=-1.0))
    if lowest < -LINEAR_NATS:
        axes.set_yscale("symlog", linthresh=LINEAR_NATS)
    axes.set_ylim(1.2 * lowest, 2.0)
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    return svg(figure)


def delay_stage(read: Recording, steps: Steps) -> CalibrationStage[PoseDelay]:
    """Calibrate the delay between poses and frames, from a recording whose tool weaves or rises.

    It is refused where the motion does not determine the delay. Raises ArctrackError where too few frames
    show the seam.
    """
    frames, bad_frames = read.readable_frames()
    track = PoseTrack.through(read.poses.timestamps_s, read.poses.T_base_tool)
    try:
        result = estimate_pose_delay(read.setup, frames, track, steps("rounds", "rounds"))
    except ValueError as error:
        raise in_file(read.path, str(error)) from None
    refusal = None if result.unestimated is None else f"the delay is unestimated: {result.unestimated}"
    records = () if refusal is not None else (_delay_record(result),)
    return CalibrationStage(result, delay_page(result, read), records, refusal, bad_frames)


def _delay_record(result: PoseDelay) -> CalibrationValues:
    """Return a delay that was estimated, to the microsecond."""
    return CalibrationValues(
        "effects.pose_delay",
        {"delay_s": round(result.delay_s, 6)},
        ("delay_s",),
        np.array([[result.sigma_s**2]]),
        "arctrack calibrate delay",
        {"frames": len(result.observations.timestamps_s)},
        name="pose_delay",
    )
