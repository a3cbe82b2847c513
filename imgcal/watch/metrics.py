"""Metrics of a running rig in Prometheus' format, computed on request: the loop does nothing for them."""

from __future__ import annotations

import bisect
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

from imgcal.errors import InputError
from imgcal.live_page import Address, Gate
from imgcal.online import EVENT_KINDS, RigState
from imgcal.watch.hook import Hook
from imgcal.watch.source_reader import SourceReader

if TYPE_CHECKING:
    from prometheus_client import Metric

Application = Callable[[dict[str, Any], Callable[..., Any]], Iterable[bytes]]
"""Of WSGI."""
BUCKETS = (0.001, 0.002, 0.003, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 5.0)
"""Upper bounds (s) of the buckets of update times."""


STAMPS = 100
"""Number of time stamps in the running mean."""


class Tally:
    """Counters of the loop; one thread writes them, others may read them."""

    def __init__(self) -> None:
        self.snapshots = self.refused = self.unusable = self.paused = 0
        """Snapshots processed; those that taught nothing; those that were unusable; those that came while paused."""
        self.events: Counter[str] = Counter()
        self.problems: Counter[str] = Counter()
        """Write failures, by output."""
        self.unwritten = 0
        """Events that could not be written yet."""
        self.latest: RigState | None = None
        self.stamps: dict[str, float] = {}
        """By camera: mean delay of its latest time stamps after those of their snapshots; seconds."""
        self.seconds = 0.0
        """Total time of updates."""
        self.took = [0] * (len(BUCKETS) + 1)
        """Numbers of updates that took up to each of `BUCKETS`, and longer."""

    @property
    def learnt(self) -> int:
        """Number of snapshots that taught something."""
        return self.snapshots - self.refused - self.unusable

    def count_time_stamp(self, camera: str, offset: float) -> None:
        """Count a time stamp."""
        before = self.stamps.get(camera, offset)
        self.stamps[camera] = before + (offset - before) / STAMPS

    def update_took(self, seconds: float) -> None:
        """Count an update's time."""
        self.seconds += seconds
        self.took[bisect.bisect_left(BUCKETS, seconds)] += 1


class Metrics:
    """Serves the metrics by HTTP. A context manager: leaving it stops the server."""

    def __init__(self, tally: Tally, intake: SourceReader, hook: Hook | None, address: Address) -> None:
        """Prepare to serve; the address should be 127.0.0.1 unless other machines are to read the metrics."""
        self._tally, self._intake, self._hook, self._address = tally, intake, hook, address

    def __enter__(self) -> Metrics:
        """Start the server.

        Raises:
            InputError: the address is in use, or not one of this machine's.
        """
        from prometheus_client import CollectorRegistry, make_wsgi_app, start_http_server  # not in the core

        registry = CollectorRegistry()
        registry.register(self)
        host, port = self._address.host, self._address.port
        try:
            self._server, self._thread = start_http_server(port, host, registry)
            self._server.set_app(_guard(make_wsgi_app(registry), Gate(self._address, "")))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"--metrics: {host}:{port} cannot be used: {reason}") from error
        return self

    def __exit__(self, *error: object) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    @property
    def port(self) -> int:
        """The port; of port 0, the one that was chosen."""
        return int(self._server.server_port)

    def collect(self) -> Iterator[Metric]:
        """Return the current metrics."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily

        tally, intake = self._tally, self._intake
        yield _counter("snapshots", "Snapshots processed", tally.snapshots)
        yield _counter("snapshots_refused", "Snapshots that taught nothing", tally.refused)
        yield _counter("snapshots_unusable", "Unusable snapshots", tally.unusable)
        yield _counter("snapshots_dropped", "Snapshots dropped because processing was too slow", intake.dropped)
        yield _counter("snapshots_paused", "Snapshots that came while paused", tally.paused)
        yield _gauge("snapshots_waiting", "Snapshots waiting to be processed", intake.waiting)
        yield _counter("clock_leaps", "Joint jumps of all cameras' clocks", intake.synchronizer.leaps)
        for kind, counts in intake.synchronizer.counts.items():
            family = CounterMetricFamily(f"imgcal_exposures_{kind}", f"Exposures {kind}", labels=["camera"])
            for camera, count in list(counts.items()):
                family.add_metric([camera], count)
            yield family
        unreadable = CounterMetricFamily("imgcal_exposures_unreadable", "Unreadable exposures", labels=["camera"])
        for camera, count in list(intake.unreadable.items()):
            unreadable.add_metric([camera], count)
        yield unreadable
        events = CounterMetricFamily("imgcal_events", "Events", labels=["event"])
        for kind in EVENT_KINDS:
            events.add_metric([kind], tally.events[kind])
        yield events
        problems = CounterMetricFamily("imgcal_write_failures", "Write failures", labels=["output"])
        for output, count in list(tally.problems.items()):
            problems.add_metric([output], count)
        yield problems
        if self._hook is not None:
            yield _counter("hook_dropped", "Events dropped before the hook command got them", self._hook.dropped)
            yield _counter("hook_failed", "Runs of the hook command that failed", self._hook.failed)
        took = HistogramMetricFamily("imgcal_update_seconds", "Time of an update")
        total, buckets = 0, []
        for limit, count in zip((*BUCKETS, math.inf), tally.took, strict=True):
            total += count
            buckets.append(("+Inf" if math.isinf(limit) else str(limit), total))
        took.add_metric([], buckets, tally.seconds)
        yield took
        stamps = GaugeMetricFamily(
            "imgcal_stamp_offset_seconds", "Time stamps of each camera against their snapshots'", labels=["camera"]
        )
        for camera, offset in list(tally.stamps.items()):
            stamps.add_metric([camera], offset)
        yield stamps
        if tally.latest is not None:
            yield from _camera_values(tally.latest)


def _camera_values(state: RigState) -> Iterator[Metric]:
    """Values of each camera."""
    from prometheus_client.core import GaugeMetricFamily

    names = state.factory.camera_names
    yield _gauge("snapshot_time_seconds", "Time of the latest snapshot", state.time)
    health = GaugeMetricFamily("imgcal_camera", "Health of each camera: 1", labels=["camera", "state"])
    for camera, found in state.cameras.items():
        health.add_metric([camera, found], 1)
    yield health
    columns: tuple[tuple[str, str, Any], ...] = (
        ("residual_pixels", "RMS residual of the latest snapshot", state.residual),
        ("clock_offset_seconds", "Delay of each camera relative to most, from the motion", state.clock_offset),
        ("clock_offset_sigma_seconds", "One standard deviation of the delay", state.clock_offset_sigma),
        ("noise_pixels", "Noise of each camera's blobs beyond their own sigmas", state.noise),
        ("shake_pixels", "Shake of each camera, one standard deviation", state.shake),
        ("rotation_radians", "Rotation of each camera since the factory calibration", state.moved[:, :3].norm(dim=1)),
        ("position_millimetres", "Shift of each camera", state.moved[:, 3:6].norm(dim=1)),
        ("focal_length_pixels", "Change of the focal length", state.moved[:, 6:8].abs().amax(1)),
    )
    for name, words, values in columns:
        family = GaugeMetricFamily(f"imgcal_{name}", words, labels=["camera"])
        for camera, value in zip(names, values.tolist(), strict=True):
            if math.isfinite(value):
                family.add_metric([camera], value)
        yield family


def _guard(serve: Application, gate: Gate) -> Application:
    """Serve only requests that use this machine's own name; other names may be pointed here (DNS rebinding)."""

    def answer(environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        if gate.knows(environ.get("HTTP_HOST", "")):
            return serve(environ, start_response)
        start_response("421 Misdirected Request", [("Content-Type", "text/plain")])
        return [b"this is not the server of that name; ask by its address\n"]

    return answer


def _counter(name: str, words: str, value: float) -> Metric:
    from prometheus_client.core import CounterMetricFamily

    return CounterMetricFamily(f"imgcal_{name}", words, value)


def _gauge(name: str, words: str, value: float) -> Metric:
    from prometheus_client.core import GaugeMetricFamily

    return GaugeMetricFamily(f"imgcal_{name}", words, value)
