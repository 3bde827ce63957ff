"""The arc as a setup states it, and how its output goes with the current."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Arc:
    """The arc as stated: a hemisphere of uniform radiance of which only the upper half shines.

    With `on_surface` its centre lies below the tool's origin (`center_in_tool_mm` turned with the tool, its z
    included, says where), at the joint's reference surface, raised by a corrugation's height there, plus
    `center_in_tool_mm[2]`. `radiance_e` is the charge that a pixel on the optical axis receives per unit of
    the integral of f_r cos(phi) cos(theta_i) / r^2 dA at `current_a`; it scales with
    (I / current_a)^current_exponent.
    """

    radius_mm: float
    center_in_tool_mm: tuple[float, float, float]
    radiance_e: float
    current_a: float
    current_exponent: float
    shape: str = "hemisphere"
    on_surface: bool = True

    def __post_init__(self) -> None:
        if self.shape != "hemisphere":
            raise ValueError(f"[arc] shape = {self.shape!r}: only 'hemisphere' is known")
        for name in ("radius_mm", "radiance_e", "current_a"):
            if not getattr(self, name) > 0:
                raise ValueError(f"[arc] {name} = {getattr(self, name)}: must be > 0")

    def __str__(self) -> str:
        return (
            f"{self.shape} of {self.radius_mm:g} mm, radiance {self.radiance_e:.3g} e- at "
            f"{self.current_a:g} A, ~ current^{self.current_exponent:g}"
        )


def level(arc: Arc, current_a: float) -> float:
    """Return the arc's output relative to that at `arc.current_a`: (I / I_0)^n; 0 at no current."""
    return float((current_a / arc.current_a) ** arc.current_exponent) if current_a > 0 else 0.0
