"""What every stage owes: readiness, health, hand-overs, a clean end."""

import os
import signal
import sys
import time
import traceback
from pathlib import Path

from .contract import HANDOVER, HEALTH, DetectionHeader, Health, StageState
from .instance import Instance, set_text
from .listening import Listening
from .ports import Waker

# Exit status of a stage that cannot start, where trying again does not help.
CANNOT_START = 2

HEALTH_PERIOD_S = 0.25


class Stage:
    """A stage of the pipeline that the launcher's environment names. Use it in a `with` block, and `messages` as its
    loop: health is sent from there, so that a hung stage goes silent."""

    def __init__(self, name):
        self.name = os.environ.get("FLOCKEYE_STAGE", name)
        self.replica = int(os.environ.get("FLOCKEYE_REPLICA", 0))
        self.generation = int(os.environ.get("FLOCKEYE_GENERATION", 0))
        self._is_stopping = False
        self._publishers = []
        self._wake_s = None
        self._state = StageState.STARTING
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._stop)
        try:
            self._join()
        except Exception as error:
            print(f"cannot start: {error}", file=sys.stderr, flush=True)
            raise SystemExit(CANNOT_START) from error

    def _join(self):
        self.instance = Instance.join(f"{self.name}-{self.replica}")
        self.pipeline = self.instance.pipeline
        self._health = self.instance.publisher(HEALTH)
        self._report = Health(
            latency_median_ns=-1,
            latency_p99_ns=-1,
            replica=self.replica,
            generation=self.generation,
            pid=os.getpid(),
        )
        set_text(self._report.stage, self.name)
        self._next_health_s = 0.0
        self._send_health(StageState.STARTING)
        own = (self.name, self.replica, self.generation)
        self._listening = Listening(self.instance.subscriber(HANDOVER), own)

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        if kind is None:
            self._send_health(StageState.DRAINING)
        elif self._state == StageState.STARTING and issubclass(kind, Exception):
            traceback.print_exception(error, limit=-1, file=sys.stderr)
            raise SystemExit(CANNOT_START)

    @property
    def is_lossless(self):
        """Whether every frame is worked on, however long that takes."""
        return self.pipeline["flow"] == "lossless"

    def subscriber(self, topic):
        """Receives a topic, without messages of a process that does not count."""
        return self.instance.subscriber(topic, self._listening)

    def publisher(self, topic, max_items=0, max_loans=1):
        """Publishes a topic; see `Instance.publisher`. View lanes of a lossless run wait for their readers."""
        waits = self.is_lossless and topic.service.startswith("flockeye/view/")
        publisher = self.instance.publisher(topic, max_items, max_loans, waits)
        self._publishers.append(publisher)
        return publisher

    def ready(self, detail):
        """Says that everything is open; `detail` tells people what the stage works with."""
        set_text(self._report.detail, detail)
        self._send_health(StageState.READY)

    def record(self, view, received_ns, **fields):
        """The header that a detection owes for a view, its fields copied: `hits` and `failed` are given as `fields`."""
        return DetectionHeader(
            stamp=view.stamp,
            plan_id=view.plan_id,
            taken_ns=view.taken_ns,
            issued_ns=view.issued_ns,
            received_ns=received_ns,
            sent_ns=time.monotonic_ns(),
            generation=self.generation,
            view_index=view.view_index,
            attempt=view.attempt,
            worker=self.replica,
            view_generation=view.generation,
            **fields,
        )

    def refuse(self, what):
        """Counts a message that breaks the contract."""
        self._report.failed += 1
        if self._report.failed in (1, 10, 100, 1000):
            print(f"a message is refused: {what}", file=sys.stderr, flush=True)

    def published(self, count=1):
        """Counts messages of the stage's own."""
        self._report.published += count

    def queued(self, count):
        """Says how many messages are not done with."""
        self._report.queued = count

    def due(self, seconds):
        """Asks for the next of `turns` after so many seconds at the latest."""
        self._wake_s = time.monotonic() + seconds

    def messages(self, *subscribers):
        """Messages of these topics as they come, in the order of the arguments, until SIGTERM. A message is valid
        until the next one is asked for."""
        for _ in self.turns(*subscribers):
            for subscriber in subscribers:
                for message in subscriber.waiting():
                    self._report.taken += 1
                    yield message
                    self._health_if_due()
                    if self._is_stopping:
                        return

    def turns(self, *subscribers):
        """A turn of the stage's loop whenever one of these topics has something, or the time of `due` has come, until
        SIGTERM. For stages that do not work message by message; they read their subscribers themselves."""
        waker = Waker(subscribers)
        try:
            while not self._is_stopping:
                self._wake_s = None
                # Whoever has joined since gets what is kept for late ones: the last plan.
                for publisher in self._publishers:
                    publisher.update_connections()
                yield
                self._health_if_due()
                until_s = min(self._next_health_s, self._wake_s or self._next_health_s)
                waker.wait(until_s - time.monotonic())
        finally:
            waker.close()

    def _stop(self, *_):
        self._is_stopping = True

    def _health_if_due(self):
        if time.monotonic() >= self._next_health_s:
            self._send_health(self._state)

    def _send_health(self, state):
        self._state = state
        resident_pages = int(Path("/proc/self/statm").read_text().split()[1])
        self._report.sent_ns = time.monotonic_ns()
        self._report.processor_ns = time.process_time_ns()
        self._report.resident_bytes = resident_pages * os.sysconf("SC_PAGE_SIZE")
        self._report.state = state
        self._health.send(self._report)
        self._next_health_s = time.monotonic() + HEALTH_PERIOD_S
