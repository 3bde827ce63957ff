"""The arc as a setup states it, and how its output goes with the current."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Arc:
    """The arc as stated: a hemisphere of uniform radiance of which only the upper half shines.

    Parameters
    ----------
    radius_mm : float
        The hemisphere's radius, mm.
    center_in_tool_mm : tuple (3,)
        The hemisphere's centre, mm, tool frame. See `on_surface` for its z.
    radiance_e : float
        The arc's brightness, e-: the charge that a pixel on the optical axis receives at `current_a`, per
        unit of the integral of f_r cos(phi) cos(theta_i) / r^2 dA. 0 for no arc.
    current_a : float
        The current at which `radiance_e` is stated, A.
    current_exponent : float
        The brightness scales with (I / current_a)^current_exponent.
    shape : str
        "hemisphere", the one shape there is.
    on_surface : bool
        True puts the centre at the height of the workpiece below the tool's origin, plus
        `center_in_tool_mm[2]`. The workpiece is the joint's reference surface, raised by a corrugation's
        height there. `center_in_tool_mm`, turned with the tool, says below which point.

    Raises
    ------
    ValueError
        For a value out of its range; it names the key.
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
        for name in ("radius_mm", "current_a"):
            if not getattr(self, name) > 0:
                raise ValueError(f"[arc] {name} = {getattr(self, name)}: must be > 0")
        if not self.radiance_e >= 0:
            raise ValueError(f"[arc] radiance_e = {self.radiance_e}: must be >= 0")

    @property
    def shines(self) -> bool:
        """True if there is an arc at all."""
        return self.radiance_e > 0.0

    def __str__(self) -> str:
        if not self.shines:
            return "none"
        return (
            f"{self.shape} of {self.radius_mm:g} mm, radiance {self.radiance_e:.3g} e- at "
            f"{self.current_a:g} A, ~ current^{self.current_exponent:g}"
        )


NO_ARC = Arc(
    radius_mm=1.0, center_in_tool_mm=(0.0, 0.0, 0.0), radiance_e=0.0, current_a=1.0, current_exponent=1.0
)
"""The arc of a setup that states none: it gives no light."""


def level(arc: Arc, current_a: float) -> float:
    """Return the arc's output relative to that at `arc.current_a`: (I / I_0)^n; 0 at no current."""
    return float((current_a / arc.current_a) ** arc.current_exponent) if current_a > 0 else 0.0
