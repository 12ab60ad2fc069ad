"""The booth's health as Prometheus metrics on a local endpoint; no label identifies a person."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from station.booth.health import BoothHealth, booth_health, scans_by_outcome
from station.core.config import BoothConfig

_LOCAL = "127.0.0.1"


class BoothCollector(Collector):
    """Reads the booth's state whenever metrics are requested."""

    def __init__(self, config: BoothConfig, path: Path) -> None:
        self._config, self._path = config, path

    def collect(self) -> Iterator[Metric]:
        health = booth_health(self._config, self._path)
        yield from _processes(health)
        yield from _cameras(health)
        yield from _spool(health)


def _processes(health: BoothHealth) -> Iterator[Metric]:
    age = GaugeMetricFamily(
        "booth_process_age_seconds", "time since the last report of a process", labels=["process"]
    )
    for name, content in health.processes.items():
        age.add_metric([name], content.get("age_s", float("inf")))
    yield age
    yield GaugeMetricFamily(
        "booth_problems", "number of current problems", value=len(health.problems)
    )


def _cameras(health: BoothHealth) -> Iterator[Metric]:
    frames, lost, unmatched = (
        CounterMetricFamily(f"booth_frames_{what}", f"frames {what}", labels=["camera"])
        for what in ("received", "lost", "unmatched")
    )
    rate = GaugeMetricFamily(
        "booth_frame_rate_hertz", "frame rate by the device's clock", labels=["camera"]
    )
    age = GaugeMetricFamily(
        "booth_frame_age_seconds", "time since the last frame arrived", labels=["camera"]
    )
    for name, camera in health.sync.get("cameras", {}).items():
        frames.add_metric([name], camera["frames"])
        lost.add_metric([name], camera["lost"])
        unmatched.add_metric([name], camera["unmatched"])
        age.add_metric([name], camera["last_frame_age_s"])
        if camera["rate_hz"] is not None:
            rate.add_metric([name], camera["rate_hz"])
    yield from (frames, lost, unmatched, rate, age)
    sets = CounterMetricFamily("booth_framesets", "framesets matched")
    sets.add_metric([], health.sync.get("framesets", 0))
    yield sets


def _spool(health: BoothHealth) -> Iterator[Metric]:
    scans = GaugeMetricFamily("booth_scans", "scans in the spool", labels=["state"])
    for state, count in scans_by_outcome(health.spool, health.cancelled).items():
        scans.add_metric([state], count)
    yield scans
    yield GaugeMetricFamily(
        "booth_oldest_waiting_seconds", "age of the oldest waiting scan",
        value=health.oldest_waiting_s,
    )  # fmt: skip
    yield GaugeMetricFamily(
        "booth_stuck_scans", "claimed scans that should have ended", value=len(health.stuck)
    )
    yield GaugeMetricFamily(
        "booth_spool_free_bytes", "free space of the spool's disk", value=health.free_bytes
    )


def serve_metrics(config: BoothConfig, path: Path, log: logging.Logger) -> None:
    """Serve the metrics on this machine, if a port is configured."""
    if not config.metrics.port:
        return
    registry = CollectorRegistry(auto_describe=False)
    registry.register(BoothCollector(config, path))
    try:
        start_http_server(config.metrics.port, addr=_LOCAL, registry=registry)
    except OSError as error:
        log.error("no metrics on port %d: %s", config.metrics.port, error)
