"""The interference filter in front of the CCD."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Filter:
    """An interference filter as stated: centre, full width at half maximum, effective refractive index."""

    center_nm: float
    fwhm_nm: float
    effective_index: float

    def __post_init__(self) -> None:
        for name in ("center_nm", "fwhm_nm"):
            if not getattr(self, name) > 0:
                raise ValueError(f"[filter] {name} = {getattr(self, name)}: must be > 0")
        if not self.effective_index >= 1:
            raise ValueError(f"[filter] effective_index = {self.effective_index}: must be >= 1")
