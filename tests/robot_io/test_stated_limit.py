import math
from dataclasses import fields
from typing import Any

import pytest

from robot_io.clocks.lag import LagLimits
from robot_io.clocks.sync import SyncLimits
from robot_io.gate_limits import GateLimits
from robot_io.poses.plausibility_limits import MAY_BE_ZERO, PlausibilityLimits

NUMBERS = [
    (record, limit.name)
    for record in (GateLimits, PlausibilityLimits, SyncLimits, LagLimits)
    for limit in fields(record)
    if not isinstance(limit.default, bool)
]


@pytest.mark.parametrize("wrong", [-1.0, 0.0, math.nan, math.inf])
@pytest.mark.parametrize(("record", "name"), NUMBERS)
def test_a_limit_is_positive_and_finite(record: Any, name: str, wrong: float) -> None:
    if wrong == 0.0 and name in MAY_BE_ZERO:
        assert getattr(record(**{name: wrong}), name) == 0.0
        return
    with pytest.raises(ValueError, match=rf"limit {name}: is {wrong}; it must be positive and finite"):
        record(**{name: wrong})


def test_a_switch_may_be_off() -> None:
    assert not GateLimits(arc_required=False).arc_required
