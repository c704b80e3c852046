"""What an operator sees of requests: an id, a line of the log, and metrics for Prometheus."""

from __future__ import annotations

import logging
import re
import secrets
from collections.abc import Iterator
from time import perf_counter
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from spheremark.service.logs import REQUEST

if TYPE_CHECKING:
    from spheremark.service.http.state import Service

HEADER = "X-Request-Id"
_ID = re.compile(r"[\w.-]{1,64}", re.ASCII)  # of a proxy in front
_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")

logger = logging.getLogger(__name__)


class Observation:
    """Wraps an application: every request has an id, is counted, and can be logged."""

    def __init__(self, app: ASGIApp, registry: CollectorRegistry, level: int) -> None:
        self.app, self.level = app, level
        self.responses = Counter(
            "spheremark_responses",
            "Responses that have begun.",
            ("method", "route", "status"),
            registry=registry,
        )
        self.seconds = Histogram(
            "spheremark_response_seconds",
            "Time until the response began [s].",
            ("route",),
            registry=registry,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        given = Headers(scope=scope).get(HEADER, "")
        request = given if _ID.fullmatch(given) else secrets.token_hex(8)
        begin = perf_counter()

        async def send_with_id(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)[HEADER] = request
                self._note(scope, message["status"], perf_counter() - begin)
            await send(message)

        before = REQUEST.set(request)
        try:
            await self.app(scope, receive, send_with_id)
        finally:
            REQUEST.reset(before)

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        """Count and log a response by the name of its route, ``none`` where no route matches."""
        route = getattr(scope.get("route"), "name", "") or "none"
        method = scope["method"] if scope["method"] in _METHODS else "other"
        self.responses.labels(method, route, str(status)).inc()
        self.seconds.labels(route).observe(seconds)
        about = {
            "method": scope["method"],
            "path": scope["path"],  # without the query, which may hold what is private
            "status": status,
            "seconds": round(seconds, 4),
            "client": (scope.get("client") or ("",))[0],
        }
        logger.log(self.level, "%s %s: %d", scope["method"], scope["path"], status, extra=about)


class ServiceCollector:
    """Metrics of the parts of a service, read from memory when they are asked for."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics."""
        jobs = self._service.jobs
        yield GaugeMetricFamily("spheremark_workers", "Ready workers.", jobs.n_workers())
        live = GaugeMetricFamily("spheremark_jobs", "Jobs that wait or run.", labels=("state",))
        for state, n in jobs.count_live().items():
            live.add_metric((state,), n)
        yield live
        ended = CounterMetricFamily(
            "spheremark_jobs_ended", "Jobs that have ended.", labels=("kind", "status")
        )
        for labels, n in jobs.n_ended.items():
            ended.add_metric(labels, n)
        yield ended
        taken = GaugeMetricFamily(
            "spheremark_requests_in_place", "Requests of a kind that run or wait.", labels=("kind",)
        )
        service = self._service
        for kind, places in (
            ("files", service.readers),
            ("queries", service.queries),
            ("plans", service.plans),
        ):
            taken.add_metric((kind,), places.n_taken)
        yield taken


def new_registry() -> CollectorRegistry:
    """Return the metrics of one application, with those of its process."""
    registry = CollectorRegistry()
    ProcessCollector(registry=registry)
    return registry
