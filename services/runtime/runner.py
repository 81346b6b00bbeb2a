"""Runs one service as a process: inputs to steps, steps to outputs, and a status once a second."""

from __future__ import annotations

import gc
import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import Any, Final

from endo3d.schemas import topics
from endo3d.schemas.messages import Message, ServiceState, Status
from endo3d.services.runtime import log as logs
from endo3d.services.runtime import priority
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.meter import Meter
from endo3d.services.runtime.service import Exhausted, Gateway, Sample, Service, Source, Tap
from endo3d.services.runtime.turn import Turn

log = logging.getLogger(__name__)

_STATUS_S: Final = 1.0
_POLL_S: Final = 0.02
"""How long a source may keep its turn when nothing comes: what a command waits at most."""
_FAILURES: Final = 10
"""Steps that fail in a row before the service counts as failed and its process ends, to be started anew."""
_SWITCH_S: Final = 5e-4
"""A thread that computes in Python hands over after this long: samples wait less."""


def run(
    service: Service[Any], *, rig: str, name: str, port: int | None = None, shm_mb: int = 512, host: str = ""
) -> int:
    """Run ``service`` until SIGTERM, SIGINT, the end of its source, or repeated failure; the exit code.

    host: this host's name in the stack file, if it has one.
    To be called in the main thread. Raises ``UserError`` when the bus or the service can't be opened.
    """
    logs.to_stderr()
    sys.setswitchinterval(_SWITCH_S)
    priority.settle(service.nice)
    with Bus.open(rig, name=name, port=port, shm_mb=shm_mb) as bus:
        runner = Runner(service, bus, host, when_ready=_settle_memory)

        def stop(number: int, frame: FrameType | None) -> None:
            runner.stop()

        before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            return runner.run()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _settle_memory() -> None:
    """What is there when the work begins stays: the collector need not go through it again."""
    gc.collect()
    gc.freeze()


class Runner:
    """One service on a bus. Its step, poll and command never run at the same time."""

    def __init__(
        self, service: Service[Any], bus: Bus, host: str = "", when_ready: Callable[[], None] = lambda: None
    ) -> None:
        self._service = service
        self._bus = bus
        self._when_ready = when_ready
        self._turn = Turn()
        self._meter = Meter(host)
        self._stopped = threading.Event()
        self._closed = threading.Event()
        self._state = ServiceState.STARTING
        self._failures_in_a_row = 0
        self._failures_named: set[str] = set()
        self._last_failure = ""
        self._is_open = False
        self._answer: tuple[dict[str, int], str, dict[str, float]] = ({}, "", {})
        self._lost_before = 0

    def stop(self) -> None:
        """Ask ``run`` to return; may be called from a signal handler or another thread."""
        self._stopped.set()

    def run(self) -> int:
        """Open, warm, work, close. 0 when stopped or finished, 1 after repeated failures."""
        handler = logs.BusHandler(self._bus.name, self._bus.publish)
        logging.getLogger().addHandler(handler)
        status = threading.Thread(target=self._report, name="status", daemon=True)
        status.start()
        self._service.loan = self._bus.loan
        try:
            self._service.open()
            self._is_open = True
            self._service.warm()
            self._when_ready()
            self._connect()
            self._state = ServiceState.READY
            self._work()
        except Exception as error:
            self._state, self._last_failure = ServiceState.FAILED, str(error)
            raise
        finally:
            self._bus.stop_reading()
            self._ask()
            self._is_open = False
            self._close()
            self._closed.set()
            status.join()
            logging.getLogger().removeHandler(handler)
        return int(self._state is ServiceState.FAILED)

    def _connect(self) -> None:
        service, bus = self._service, self._bus
        for topic in service.reads:
            newest_hz = service.newest_hz(topic)
            if newest_hz == 0:
                continue
            if isinstance(service, Tap):
                bus.subscribe_encoded(topic, self._take, newest_hz=newest_hz)
            else:
                bus.subscribe(topic, self._step, newest_hz=newest_hz)
        if isinstance(service, Gateway):
            service.connect(bus)
        bus.serve(self._command)
        bus.declare_alive()
        log.info("ready")

    def _close(self) -> None:
        try:
            self._service.close()
        except Exception as error:
            log.exception("closing failed")
            self._state, self._last_failure = ServiceState.FAILED, f"close: {error!r}"
        if self._state is not ServiceState.FAILED:
            self._state = ServiceState.STOPPED

    def _work(self) -> None:
        service = self._service
        if not isinstance(service, Source):
            self._stopped.wait()
            return
        while not self._stopped.is_set() and not service.finished:
            with self._turn:
                self._publish("poll", service.poll(_POLL_S))

    def _step(self, message: Message) -> None:
        with self._turn:
            topic = topics.of(message)
            done = self._publish(topic.name, self._service.step(message))
            if done and topic is self._service.reads[0] and not isinstance(self._service, Source):
                self._meter.step(time.time_ns() - _newest_ns(message))

    def _take(self, sample: Sample) -> None:
        service = self._service
        assert isinstance(service, Tap)
        with self._turn:
            if self._publish(sample.topic.name, service.take(sample)):
                self._meter.step(time.time_ns() - sample.received_ns)

    def _command(self, verb: str, parameters: Mapping[str, Any]) -> Mapping[str, Any]:
        reply: Mapping[str, Any] = {}
        with self._turn:
            for output in self._service.command(verb, parameters, time.time_ns()):
                if isinstance(output, Mapping):
                    reply = output
                else:
                    self._bus.publish(output)
        return reply

    def _publish(self, work: str, outputs: Iterator[Message]) -> bool:
        """Publish what a turn yields, as it comes. True when it came to its end, on intact memory."""
        intact = True
        try:
            for message in outputs:
                intact = intact and self._bus.intact()
                if intact:
                    self._bus.publish(message)
                    if isinstance(self._service, Source) and topics.of(message) is self._service.writes[0]:
                        self._meter.step(time.time_ns() - message.stamp_ns)
        except Exhausted:
            return False  # the loan counted it
        except Exception as error:
            self._fail(work, error)
            return False
        self._failures_in_a_row = 0
        if not (intact and self._bus.intact()):
            self._bus.tally.drop(work, "invalidated")
            self._service.void()
            return False
        return True

    def _fail(self, work: str, error: Exception) -> None:
        self._bus.tally.drop(work, "failed")
        self._failures_in_a_row += 1
        self._last_failure = f"{work}: {error}" if isinstance(error, UserError) else f"{work}: {error!r}"
        kind = f"{work} {type(error).__name__}"
        if kind not in self._failures_named:
            self._failures_named.add(kind)
            log.error("%s; further ones of this kind are only counted", self._last_failure, exc_info=error)
        if self._failures_in_a_row >= _FAILURES:
            log.critical("%d failures in a row, the last: %s", _FAILURES, self._last_failure)
            self._state = ServiceState.FAILED
            self._stopped.set()

    def _report(self) -> None:
        """A status a second, and one at the end."""
        while not self._closed.wait(_STATUS_S):
            self._bus.publish(self._status())
        self._bus.publish(self._status())

    def _status(self) -> Status:
        received, published, dropped = self._bus.tally.snapshot()
        losses, trouble, values = self._ask()
        for cause, count in losses.items():
            dropped[cause] = dropped.get(cause, 0) + count
        lost = sum(dropped.values())
        notes = [self._bus.note, trouble]
        if lost > self._lost_before:
            notes.append(f"lost {lost - self._lost_before} in the last second")
        self._lost_before = lost
        if self._state is ServiceState.FAILED:
            notes.insert(0, self._last_failure)
        note = "; ".join(filter(None, notes))
        rate_hz = self._meter.rate_hz()
        latency_p50_ms, latency_p99_ms = self._meter.latency_ms()
        return Status(
            stamp_ns=time.time_ns(),
            service=self._bus.name,
            host=self._meter.host,
            pid=self._meter.pid,
            state=self._shown_state(rate_hz, note),
            note=note,
            rate_hz=rate_hz,
            latency_p50_ms=latency_p50_ms,
            latency_p99_ms=latency_p99_ms,
            cpu_share=self._meter.cpu_share(),
            memory_mb=self._meter.memory_mb(),
            received=received,
            published=published,
            dropped=dropped,
            values=values,
        )

    def _ask(self) -> tuple[dict[str, int], str, dict[str, float]]:
        """The service's own losses, trouble and values; while it is not open, its last answer.

        Asked between its steps or beside them: a service that hangs still has a status.
        """
        if self._is_open:
            try:
                service = self._service
                self._answer = dict(service.losses()), service.trouble(), dict(service.values())
            except Exception as error:
                self._fail("status", error)
        return self._answer

    def _shown_state(self, rate_hz: float, note: str) -> ServiceState:
        if self._state is not ServiceState.READY:
            return self._state
        if note:
            return ServiceState.DEGRADED
        return ServiceState.RUNNING if rate_hz > 0 else ServiceState.READY


def _newest_ns(message: Message) -> int:
    """Mid-exposure of the newest frame a message goes back to."""
    return getattr(message, "newest_stamp_ns", 0) or message.stamp_ns
