"""Figures for Prometheus: what this process has done, and what the job table says at the moment of asking."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from service.jobs.figures import Figures, read_figures
from service.jobs.store import JobStore

log = logging.getLogger(__name__)

_RENDER_BUCKETS = (0.01, 0.02, 0.04, 0.08, 0.15, 0.3, 0.6, 1.2, 2.5, 5.0, 10.0)


class Metrics:
    """The registry of one app."""

    def __init__(self, store: JobStore) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "mass_http_requests", "Answers by route.", ("method", "route", "status"), registry=self.registry
        )
        self.renders = Counter("mass_renders", "Pictures by outcome.", ("outcome",), registry=self.registry)
        self.render_seconds = Histogram(
            "mass_render_seconds",
            "Time of pictures that were drawn.",
            buckets=_RENDER_BUCKETS,
            registry=self.registry,
        )
        self.registry.register(_JobCollector(store))

    def text(self) -> bytes:
        """The exposition."""
        return generate_latest(self.registry)


@contextmanager
def own_port(metrics: Metrics, host: str, port: int) -> Iterator[int]:
    """Serve the figures, and nothing else, on ``port`` (0: a free one; yields which) until the block ends.

    Raises OSError when the port cannot be had.
    """
    try:
        server, thread = start_http_server(port, host, metrics.registry)
    except OSError as error:
        log.error("no figures: port %d on %s cannot be had (%s)", port, host, error.strerror)
        raise
    log.info("figures on %s port %d", host, server.server_port)
    try:
        yield server.server_port
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _JobCollector(Collector):
    """Reads the job table; every API process says the same."""

    def __init__(self, store: JobStore) -> None:
        self._store = store

    def collect(self) -> Iterator[Metric]:
        """One scrape."""
        yield from _families(read_figures(self._store.engine, time.time()))

    def describe(self) -> Iterator[Metric]:
        """The names, without reading the table."""
        yield from _families(Figures())


def _families(figures: Figures) -> Iterator[Metric]:
    jobs = GaugeMetricFamily("mass_jobs", "Jobs by state.", labels=["state"])
    for state, count in figures.jobs.items():
        jobs.add_metric([state], count)
    yield jobs
    yield GaugeMetricFamily(
        "mass_queue_age_seconds", "Age of the job that has waited longest.", value=figures.queue_age
    )
    yield GaugeMetricFamily("mass_uploads_open", "Unfinished uploads.", value=figures.uploads)
    yield GaugeMetricFamily("mass_webhooks_waiting", "Messages not yet delivered.", value=figures.webhooks)
    failures = CounterMetricFamily("mass_job_failures", "Failed jobs by code.", labels=["code"])
    for code, count in figures.failures.items():
        failures.add_metric([code], count)
    yield failures
    seconds = CounterMetricFamily("mass_stage_seconds", "Time spent in stages.", labels=["stage"])
    runs = CounterMetricFamily("mass_stage_runs", "Stages gone through.", labels=["stage"])
    for stage, (count, total) in figures.stages.items():
        seconds.add_metric([stage], total)
        runs.add_metric([stage], count)
    yield seconds
    yield runs
