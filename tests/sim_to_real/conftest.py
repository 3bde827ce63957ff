"""Where Mitsuba cannot start, what needs it is skipped and says so."""

import pytest

from sim_to_real.check.path_traced import load_mitsuba


@pytest.fixture(scope="session")
def mitsuba():
    try:
        return load_mitsuba()
    except ImportError as error:
        pytest.skip(f"no Mitsuba to cast rays or trace paths with: {error}")
