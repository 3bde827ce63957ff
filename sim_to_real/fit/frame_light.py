"""Light of a frame's bins: the predicted bins, their rendering, and the light after effects."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from noise_model.instrument.camera import neighbours
from noise_model.instrument.sensor import Sensor, respond_moments
from noise_model.view import View
from sim_to_real.data.binned import ObservedFrame

CHARGE_STEP_E = 1.0
"""Step of the derivative with charge."""


@dataclass(frozen=True, eq=False)
class PredictedBins:
    """The bins of a frame that are predicted: all of it (h, w), or those that count and about these (m,).

    `places` are their indices in the flattened frame, `rendered` (r,) those of the rendered bins, `nearest`
    the nearest rendered bin of each. `kept` (k,) are the bins that count, as indices into `places`; `is_kept`
    (r,) is their mask among the rendered ones. `inner` is that of a `View`, None for a whole frame.
    """

    frame: ObservedFrame
    places: Int64
    rendered: Int64
    nearest: npt.NDArray[np.intp]
    kept: Int64
    is_kept: Bool
    inner: tuple[Int64, Int64] | None

    @classmethod
    def whole(cls, frame: ObservedFrame) -> "PredictedBins":
        """Return all bins: what spreads over the image comes from all of them."""
        every, rendered = np.arange(frame.keep.size), np.flatnonzero(frame.rendered)
        nearest = nearest_rendered(frame.rendered)
        return cls(frame, every, rendered, nearest, frame.bins, frame.keep[frame.rendered], None)

    @classmethod
    def near(cls, frame: ObservedFrame) -> "PredictedBins":
        """Return the bins that count and their neighbours, which the lens blurs into them."""
        around = neighbours(frame.bins, (frame.keep.shape[0], frame.keep.shape[1]))
        places = np.unique(around)
        is_near = np.zeros_like(frame.keep)
        is_near.reshape(-1)[places] = True
        shown = is_near & frame.rendered
        kept = np.searchsorted(places, frame.bins)
        return cls(
            frame,
            places,
            np.flatnonzero(shown),
            nearest_rendered(shown)[is_near] if len(places) else np.zeros(0, dtype=np.intp),
            kept,
            frame.keep[shown],
            (kept, np.searchsorted(places, around)),
        )


def joined_inner(frames: Sequence[PredictedBins]) -> tuple[Int64, Int64]:
    """Return the `inner` of bins near those that count, of all frames one after another."""
    starts = np.cumsum([0, *(len(bins.places) for bins in frames)])
    parts = [(bins.inner, start) for bins, start in zip(frames, starts[:-1].tolist(), strict=True)]
    inner, around = zip(
        *((inner[0] + start, inner[1] + start) for inner, start in parts if inner is not None), strict=True
    )
    return np.concatenate(inner), np.concatenate(around)


@dataclass(frozen=True, eq=False)
class Rendering:
    """Light of a pose (...,), e- for the nominal exposure and output, before any effect on the image.

    The laser's light is rendered in `ObservedFrame.rendered`; other bins take that of the nearest. The arc's
    is smooth but at edges: it is rendered in the bins that count, and others change from the stated light by
    the factor of the nearest.
    """

    view: View
    arc_e: Float32
    laser_e: Float32


@dataclass(frozen=True, eq=False)
class FrameLight:
    """The light of a frame's bins that count (n,), e-, that has passed effects, lens and exposure.

    `arc_factor` and `laser_factor` (n,) are the factors by which the rendered light has changed; `black_dn`
    adds to the sensor's black level.
    """

    sensor: Sensor
    arc_e: Float32
    laser_e: Float32
    other_e: Float32
    arc_factor: Float32
    laser_factor: Float32
    black_dn: float = 0.0

    def mean_dn(self, more_e: float = 0.0) -> Float64:
        """Return the mean DN (n,), of somewhat more light if that is asked for."""
        mean_e = self.arc_e + self.laser_e + self.other_e + np.float32(more_e)
        return expected_dn(mean_e, self.sensor) + self.black_dn

    def dn_per_e(self) -> Float64:
        """Return the derivatives of the mean with charge (n,), DN/e-."""
        return (self.mean_dn(CHARGE_STEP_E) - self.mean_dn()) / CHARGE_STEP_E


def expected_dn(mean_e: Float32, sensor: Sensor) -> Float64:
    """Return the mean DN (n,) of bins with mean charges (n,)."""
    # A bin is a mean of pixels: each of them rounds and is cut with a pixel's noise.
    noise_e2 = np.maximum(mean_e, 0.0) + sensor.read_noise_e**2
    return respond_moments(mean_e, noise_e2, sensor)[0]


def nearest_rendered(rendered: Bool) -> npt.NDArray[np.intp]:
    """Return for each bin (h, w) which of those that are rendered is nearest; its own if it is."""
    number = np.cumsum(rendered).reshape(rendered.shape) - 1
    _, (rows, columns) = distance_transform_edt(~rendered, return_indices=True)
    return np.asarray(number[rows, columns])


def light_factor(passed_e: Float32, rendered_e: Float32, known: float) -> Float32:
    """Return the factor by which rendered light (n,) has changed; 0 where none was rendered.

    `known` is the factor of exposure and level alone.
    """
    factor = np.zeros_like(passed_e)
    with np.errstate(over="ignore"):
        np.divide(passed_e, rendered_e, out=factor, where=rendered_e > 0.0)
    # No effect makes light more than four times as bright.
    return np.clip(factor, np.float32(0.0), np.float32(4.0 * known))
