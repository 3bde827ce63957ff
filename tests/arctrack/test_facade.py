import pytest

import arctrack
from arctrack.recording import read_recording


def test_every_name_of_the_facade_is_there() -> None:
    assert arctrack.read_recording is read_recording
    for name in arctrack.__all__:
        assert getattr(arctrack, name) is not None
        assert name in dir(arctrack)


def test_other_names_are_not() -> None:
    with pytest.raises(AttributeError, match="nonsense"):
        arctrack.nonsense  # noqa: B018
