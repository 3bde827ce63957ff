"""A filter's measured curve from a CSV file: wavelength and transmission or optical density."""

from pathlib import Path

import numpy as np

from arctrack.errors import in_file
from arctrack.recording.csv_file import number, read_csv
from noise_model.instrument.spectrum import CurveError, FilterCurve

TRANSMISSION = "transmission"
DENSITY = "optical_density"


def read_filter_curve(path: Path, effective_index: float) -> FilterCurve:
    """Read a curve measured at normal incidence; `effective_index` is the maker's, for what happens off axis.

    The file's header names `wavelength_nm` and either `transmission` (0 to 1) or `optical_density`
    (-log10 of it); other columns have no meaning here. Wavelengths must rise and the curve must cover the
    band: fall to 1 % of its peak at both ends.

    Raises ArctrackError with the file, and the line if one is to blame.
    """
    table = read_csv(path, {"wavelength_nm": number}, {TRANSMISSION: number, DENSITY: number})
    given = table.columns[1:]
    if len(given) != 1:
        present = "both" if given else "neither"
        raise in_file(
            path, f"has {present} of the columns {TRANSMISSION} and {DENSITY}; one is needed", line=1
        )
    wavelength_nm, transmission = table.values.T
    if given == (DENSITY,):
        with np.errstate(over="ignore"):
            transmission = 10.0**-transmission
    try:
        return FilterCurve(wavelength_nm, transmission, effective_index)
    except CurveError as error:
        line = None if error.sample is None else int(table.lines[error.sample])
        raise in_file(path, str(error), line=line) from None
