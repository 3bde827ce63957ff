"""A run's numbers for Prometheus."""

import math
from collections.abc import Iterable, Iterator

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from arctrack.live.journal.records import BUCKETS_S, Status
from arctrack.live.monitor.feed import Feed
from arctrack.live.monitor.status import indicated
from arctrack.live.monitor.words import Indication
from robot_io import TrackerState


def registry_of(feed: Feed) -> CollectorRegistry:
    """Return a registry of a run's numbers alone."""
    registry = CollectorRegistry()
    registry.register(RunCollector(feed))
    return registry


class RunCollector(Collector):
    """Prometheus collector of a run's figures, read on each scrape; unknown ones are left out."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed

    def describe(self) -> Iterable[Metric]:
        """Return nothing: the numbers' names need no run to be known."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield the numbers."""
        feed = self._feed
        yield _gauge("arctrack_up", "1 while the run's process lives", float(feed.is_alive))
        yield _gauge("arctrack_browsers", "Browsers that show the page", float(feed.browsers))
        status = feed.status
        if status is None:
            return
        yield from _counts(status)
        yield _latencies(status)
        yield _delays(status)
        yield from _processes(status)
        state = GaugeMetricFamily("arctrack_state", "1 for the state of the tracker", labels=["state"])
        for each in TrackerState:
            state.add_metric([each.name], float(each is status.state))
        yield state
        indication = GaugeMetricFamily(
            "arctrack_indication", "1 for what the page's colour and shape indicate", labels=["indication"]
        )
        for shown in Indication:
            indication.add_metric([shown.name], float(shown is indicated(status, feed.offset_age_s)))
        yield indication
        yield _gauge(
            "arctrack_usable_offset_age_seconds",
            "Time since an offset that the robot may use went out",
            feed.offset_age_s,
        )
        yield _gauge(
            "arctrack_status_age_seconds", "Time since the run said how it stands", feed.status_age_s
        )
        yield _gauge("arctrack_frame_age_seconds", "Age of the newest frame", feed.frame_age_s)
        yield _gauge(
            "arctrack_processor_wait_ratio",
            "Share of the time that the loop wants a processor and waits for one",
            status.processor_wait,
        )
        yield _gauge("arctrack_frame_rate_hertz", "Frames tracked a second", feed.rate_hz)
        arc = feed.arc
        if arc is not None and arc.is_on:
            yield _gauge("arctrack_arc_level_ratio", "The arc's output over the expected one", arc.level)
            yield _gauge("arctrack_arc_level_sigma_ratio", "Its 1 sigma", arc.sigma)
            yield _gauge(
                "arctrack_map_misfit_ratio", "The arc map's residual over its uncertainty", arc.misfit
            )
        gap = feed.gap
        if gap is not None:
            yield _gauge("arctrack_gap", "1 while the arc map does not explain the frames", float(gap.is_gap))
            yield _gauge("arctrack_arc_height_millimeters", "The arc's height", gap.arc_height_mm)
            yield _gauge("arctrack_arc_height_sigma_millimeters", "Its 1 sigma", gap.arc_height_sigma_mm)


def _counts(status: Status) -> Iterator[Metric]:
    for name, text, count in (
        ("arctrack_frames", "Frames tracked", status.frames),
        ("arctrack_frames_valid", "Frames tracked validly", status.valid),
        ("arctrack_frames_dropped", "Frames dropped for a newer one", status.dropped),
    ):
        yield CounterMetricFamily(name, text, float(count))
    for name, text, label, counts in (
        ("arctrack_offsets", "Offsets sent, by validity", "validity", status.offsets),
        ("arctrack_gate_reasons", "Offsets not let out as measured", "reason", status.reasons),
        ("arctrack_bus_faults", "Faults of the bus", "fault", status.faults),
    ):
        family = CounterMetricFamily(name, text, labels=[label])
        for key, count in counts.items():
            family.add_metric([key], float(count))
        yield family


def _processes(status: Status) -> Iterator[Metric]:
    running = GaugeMetricFamily(
        "arctrack_process_running", "1 while a process of the run does its work", labels=["process"]
    )
    healthy = GaugeMetricFamily(
        "arctrack_process_healthy", "1 while nothing is wrong with its work", labels=["process"]
    )
    ends = CounterMetricFamily(
        "arctrack_process_ends", "How often it ended by itself and was started again", labels=["process"]
    )
    for name, process in status.processes.items():
        running.add_metric([name], float(process.is_running))
        healthy.add_metric([name], float(not process.problem))
        ends.add_metric([name], float(process.ends))
    yield from (running, healthy, ends)


def _latencies(status: Status) -> Metric:
    latency = GaugeMetricFamily(
        "arctrack_latency_seconds",
        "Time to the sending of an offset, since the start of the run; quantile 1 is the largest",
        labels=["since", "quantile"],
    )
    for since, values_ms in (("mid_exposure", status.capture_ms), ("arrival", status.arrival_ms)):
        # Quantiles of `Status.capture_ms` and `arrival_ms`, in their order.
        for quantile, value_ms in zip(("0.5", "0.99", "1"), values_ms, strict=True):
            if math.isfinite(value_ms):
                latency.add_metric([since, quantile], value_ms / 1000.0)
    return latency


def _delays(status: Status) -> Metric:
    delays = HistogramMetricFamily(
        "arctrack_sending_delay_seconds",
        "Time to the sending of an offset, by how many offsets took at most so long",
        labels=["since"],
    )
    ends = (*map(str, BUCKETS_S), "+Inf")
    for since, counts, sum_s in (
        ("mid_exposure", status.capture_counts, status.capture_sum_s),
        ("arrival", status.arrival_counts, status.arrival_sum_s),
    ):
        if counts:
            delays.add_metric([since], list(zip(ends, map(float, counts), strict=True)), sum_s)
    return delays


def _gauge(name: str, text: str, value: float) -> Metric:
    """Return a gauge, without a value where that is not known."""
    family = GaugeMetricFamily(name, text)
    if math.isfinite(value):
        family.add_metric([], value)
    return family
