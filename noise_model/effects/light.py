"""The light of a frame on its way from the source to the pixel, kept apart by where it came from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from noise_model.compiled.arrays import Float32


@dataclass(eq=False)
class Light:
    """Charges (...,), e-, of the view's pixels.

    `arc` is proportional to the arc's output, `laser` to the laser's, `other` to neither. `variance_e2` is
    what scatters independently from pixel to pixel beyond shot noise, zero at first. `modes` are the charges
    (...,) that go up and down together by one unit-variance number a frame: the arc's flicker.
    """

    arc: Float32
    laser: Float32
    other: Float32
    variance_e2: Float32
    modes: dict[str, Float32] = field(default_factory=dict)

    @classmethod
    def of(cls, arc: Float32, laser: Float32) -> Light:
        """Start from the arc's and the laser's own charge."""
        return cls(arc, laser, np.zeros_like(arc), np.zeros_like(arc))

    @property
    def total(self) -> Float32:
        """All of it."""
        return self.arc + self.laser + self.other

    def pass_through(self, operator: Callable[[Float32], Float32]) -> None:
        """Apply a linear operator on images to the light of every source."""

        def passed(image: Float32) -> Float32:
            # A source that is off stays dark.
            return operator(image) if image.any() else image

        self.arc, self.laser, self.other = passed(self.arc), passed(self.laser), passed(self.other)
        self.modes = {name: passed(mode) for name, mode in self.modes.items()}

    def scale(self, factor: float | Float32) -> None:
        """Multiply the light of every source; what scatters goes with the square."""
        self.pass_through(lambda image: np.asarray(image * factor, dtype=np.float32))
        self.variance_e2 = np.asarray(self.variance_e2 * factor**2, dtype=np.float32)

    def scale_arc(self, factor: Float32) -> None:
        """Multiply the arc's light, and what goes up and down with it."""
        self.arc = self.arc * factor
        self.modes = {name: mode * factor for name, mode in self.modes.items()}

    def spread(
        self,
        passed: np.float32 | Float32,
        spread: np.float32 | Float32,
        mean: Callable[[Float32], np.float32 | Float32],
    ) -> None:
        """Pass a share of the light of every source and spread a share of its mean over the image.

        What scatters from pixel to pixel is lost in a mean, a wide one about each pixel too.
        """
        self.pass_through(lambda image: np.asarray(passed * image + spread * mean(image), dtype=np.float32))
        self.variance_e2 = np.asarray(self.variance_e2 * passed**2, dtype=np.float32)
