from __future__ import annotations

import numpy as np

from arctrack.simulation.cell.bus import Bus
from arctrack.simulation.cell.scheduler import Scheduler
from validation.fault_schedules.faulty_bus import BusTrouble, FaultyBus

DATA = bytes(range(8))


def sent(trouble=(), count=400, sender="robot"):
    """Return (number, time of its sending, time, data) of what arrives of frames that come every 10 ms."""
    scheduler = Scheduler()
    bus, came = FaultyBus(scheduler, np.random.default_rng(1), list(trouble)), []
    bus.join("robot", lambda frame: came.append(("echo", frame)))

    def hear(frame):
        came.append((frame.arbitration_id, frame.sent_s, scheduler.now_s, frame.data))

    bus.join("tracker", hear)
    for n in range(count):
        scheduler.at(0.01 * n, lambda n=n: bus.send(sender, n, DATA))
    scheduler.run(100.0)
    return came


def test_each_frame_comes_once_in_order_to_all_others():
    came = sent()
    assert [number for number, *_ in came] == list(range(400))
    assert all(0.0002 < came_s - sent_s < 0.005 for _, sent_s, came_s, _ in came)
    assert {data for *_, data in came} == {DATA}


def test_frames_of_a_moment_do_not_overtake():
    scheduler, came = Scheduler(), []
    bus = Bus(scheduler, np.random.default_rng(2))
    bus.join("tracker", lambda frame: came.append(frame.arbitration_id))
    for n in range(300):
        bus.send("robot", n, DATA)
    scheduler.run(10.0)
    assert came == list(range(300))


def test_trouble_does_what_it_says():
    assert sent([BusTrouble(lost=1.0)]) == []
    assert 280 < len(sent([BusTrouble(lost=0.2)])) < 360
    assert 460 < len(sent([BusTrouble(doubled=0.3)])) < 580
    assert all(0.15 < came_s - sent_s < 0.16 for _, sent_s, came_s, _ in sent([BusTrouble(late_s=0.15)]))
    shuffled = [number for number, *_ in sent([BusTrouble(shuffled_s=0.03)])]
    assert shuffled != sorted(shuffled)
    assert sorted(shuffled) == list(range(400))


def test_bits_flip_as_often_as_stated():
    came = sent([BusTrouble(flipped=0.01)], count=2000)
    flipped = sum((a ^ b).bit_count() for *_, data in came for a, b in zip(data, DATA, strict=True))
    assert abs(flipped / (64 * 2000) - 0.01) < 0.001


def test_trouble_concerns_whom_it_names():
    assert len(sent([BusTrouble(("tracker",), lost=1.0)])) == 400
    assert len(sent([BusTrouble(("robot",), lost=1.0)])) == 0
    assert [number for number, *_ in sent([BusTrouble(lost=1.0, ids=(3, 5))], count=8)] == [0, 1, 2, 4, 6, 7]
