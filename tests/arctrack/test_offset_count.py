from arctrack.offset_count import OffsetCount, faults

REASONS = {"arc_off": 6, "not_measured": 2, "HOLD_COMMANDED": 1, "NOT_ARMED": 3}


def test_what_the_robot_commands_is_no_offset_that_it_wanted() -> None:
    count = OffsetCount.of(12, 24, REASONS)
    assert (count.sent, count.wanted, str(count)) == (12, 15, "12 of 15 offsets sent")
    assert faults(REASONS) == {"not_measured": 2, "HOLD_COMMANDED": 1}


def test_none_sent_is_told_from_none_wanted() -> None:
    assert OffsetCount.of(0, 3, {"not_measured": 3}).none_sent
    idle = OffsetCount.of(0, 3, {"arc_off": 3})
    assert (idle.none_sent, str(idle)) == (False, "no offset was wanted")
