"""Hear a swarm of Flockeye drones: typed reports, who is alive, and the last word on each neighbour.

It needs nothing but `eclipse-zenoh`. docs/PEERS.md says what is sent.

    from flockeye_peers import Swarm

    with Swarm(["tcp/10.0.0.7:7447"], "swarm") as swarm:
        for report in swarm.reports():
            print(report.observer, "sees", report.target, "at", report.position)

Of a secure swarm (docs/SECURITY.md) it hears what is signed alone; that needs `cryptography` too:

    from flockeye_trust import Security

    Swarm(["tls/10.0.0.7:7447"], "swarm", security=Security.of_folder("ground"))
"""

import json
import math
import queue
import re
import secrets
import threading
import time
from dataclasses import dataclass, field

import zenoh

FRAME_SCHEMA = "flockeye.frame/2"
MAX_TARGETS = 64
MAX_OBSERVERS = 64
MAX_FRAME_REPORT_BYTES = MAX_TARGETS * 1200 + 8192
NAME = re.compile(r"[A-Za-z0-9._-]{1,31}")
STATES = {"tentative", "confirmed", "coasting", "lost", "measured"}


class Refused(ValueError):
    """A message that is no report of the observer that its key names; it says why."""


@dataclass(frozen=True)
class Report:
    """Where one drone sees another. Metres and radians, x forward, y left, z up."""

    observer: str
    target: str
    frame: int
    epoch: int
    state: str
    position: tuple
    # Observer from target, quaternion x y z w.
    orientation: tuple
    # Upper triangle of the 6x6 covariance of position and rotation vector, row by row.
    covariance: tuple
    linear_velocity: tuple
    angular_velocity: tuple
    # Each as in the JSON; None where it is not said. First this frame's own measurement.
    measured: dict | None
    # Another pose that is possible: the track is ambiguous.
    rival: dict | None
    # The pose predicted to the sending, and the directions in which next to nothing is known.
    predicted: dict | None
    degenerate: dict | None
    stamp_utc_ns: int
    clock_synchronised: bool
    latency_ms: float
    # time.monotonic() of the arrival.
    arrived: float = field(compare=False)

    def age(self):
        """Seconds since the middle of the exposure, but for the time on the air."""
        return time.monotonic() - self.arrived + self.latency_ms * 1e-3

    def covariance_matrix(self):
        """The whole 6x6 covariance, as six rows."""
        whole = [[0.0] * 6 for _ in range(6)]
        cells = iter(self.covariance)
        for row in range(6):
            for column in range(row, 6):
                whole[row][column] = whole[column][row] = next(cells)
        return whole


def read(key, payload, arrived=None):
    """The reports in a message; raises Refused for one that is none."""
    parts = key.split("/")
    if len(parts) != 4 or parts[0] != "flockeye" or parts[3] != "sees" or not NAME.fullmatch(parts[2]):
        raise Refused(f"no key of a frame report: {key[:80]!r}")
    if len(payload) > MAX_FRAME_REPORT_BYTES:
        raise Refused(f"{len(payload)} bytes (at most {MAX_FRAME_REPORT_BYTES})")
    try:
        frame = json.loads(payload)
        if frame["schema"] != FRAME_SCHEMA:
            raise Refused(f"schema {str(frame['schema'])[:40]!r} instead of {FRAME_SCHEMA!r}")
        if frame["observer"] != parts[2]:
            raise Refused(f"of {str(frame['observer'])[:40]!r}, its key is not")
        targets = frame["targets"]
        if len(targets) > MAX_TARGETS:
            raise Refused(f"{len(targets)} targets (at most {MAX_TARGETS})")
        arrived = time.monotonic() if arrived is None else arrived
        return [_report(frame, target, arrived) for target in targets]
    except Refused:
        raise
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise Refused(f"not a report: {error!r:.80}") from None


def _report(frame, target, arrived):
    if not NAME.fullmatch(target["target"]) or target["state"] not in STATES:
        raise Refused("a name or a state that is none")
    orientation = _numbers(target, "orientation", 4)
    if abs(math.hypot(*orientation) - 1) > 1e-3:
        raise Refused("orientation is not a rotation")
    (latency_ms,) = _numbers({"latency_ms": [frame["latency_ms"]]}, "latency_ms", 1)
    return Report(
        observer=frame["observer"],
        target=target["target"],
        frame=int(frame["frame"]),
        epoch=int(frame["epoch"]),
        state=target["state"],
        position=_numbers(target, "position", 3),
        orientation=orientation,
        covariance=_numbers(target, "covariance", 21),
        linear_velocity=_numbers(target, "linear_velocity", 3),
        angular_velocity=_numbers(target, "angular_velocity", 3),
        measured=target.get("measured"),
        rival=target.get("rival"),
        predicted=target.get("predicted"),
        degenerate=target.get("degenerate"),
        stamp_utc_ns=int(frame["stamp_utc_ns"]),
        clock_synchronised=bool(frame["clock_synchronised"]),
        latency_ms=latency_ms,
        arrived=arrived,
    )


def _numbers(of, name, count):
    numbers = tuple(float(number) for number in of[name])
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise Refused(f"{name} is not {count} finite numbers")
    return numbers


class Swarm:
    """A link to a swarm, which hears and says nothing."""

    def __init__(self, endpoints, swarm, waiting=1024, security=None):
        """Links with drones or routers (`tcp/10.0.0.7:7447`); links that break are made again. With `security`, a
        `flockeye_trust.Security`, what is not signed is refused."""
        self.refused = 0
        self.alive = set()
        self._last = {}
        # Its `put` is reentrant, unlike that of `queue.Queue`.
        self._waiting = queue.SimpleQueue()
        self._room = waiting
        config = zenoh.Config()
        config.insert_json5("connect/endpoints", json.dumps(list(endpoints)))
        config.insert_json5("listen/endpoints", "[]")
        config.insert_json5("scouting/multicast/enabled", "false")
        self._trust = None
        if security is not None:
            from flockeye_trust import Presence, Trust

            self._trust = Trust(security)
            if self._trust.roster["swarm"] != swarm:
                raise ValueError(f"the roster is of {self._trust.roster['swarm']!r}, not {swarm!r}")
            self._presence = Presence()
            config.insert_json5("transport/link/tls", json.dumps(security.tls()))
            # Whoever it is linked with tells it of others' endpoints.
            config.insert_json5("transport/link/protocols", '["tls"]')
        self._swarm = swarm
        self._to_ask = queue.SimpleQueue()
        self._session = zenoh.open(config)
        # Not on Zenoh's own thread, which calls `_hear`.
        threading.Thread(target=self._ask, daemon=True).start()
        frames = f"flockeye/{swarm}/*/sees"
        self._frames = self._session.declare_subscriber(frames, self._hear)
        tokens = f"flockeye/{swarm}/*/alive"
        self._tokens = self._session.liveliness().declare_subscriber(tokens, self._see, history=True)
        # What was said before.
        self._to_ask.put("*")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Ends the link, and every loop over `reports`."""
        self._to_ask.put(None)
        self._session.close()

    def reports(self, patience=None):
        """Reports as they come, until none comes for `patience` seconds or the link is closed. A reader that falls
        behind loses the oldest."""
        while not self._session.is_closed():
            try:
                yield self._waiting.get(timeout=0.1 if patience is None else patience)
            except queue.Empty:
                if patience is not None:
                    return

    def last_known(self, observer, target):
        """The last report of `observer` on `target`, or None."""
        return self._last.get((observer, target))

    def _ask(self):
        """Asks observers for their last report, until the link is closed."""
        while (observer := self._to_ask.get()) is not None:
            challenge = secrets.token_bytes(16)

            def hear(reply, challenge=challenge):
                if reply.ok:
                    self._hear(reply.ok, challenge)

            try:
                key = f"flockeye/{self._swarm}/{observer}/sees"
                self._session.get(key, hear, attachment=challenge, timeout=2.0)
            except zenoh.ZError:
                return

    def _believe(self, sample, challenge):
        """Whether its observer has said this, now; raises Refused where somebody else has."""
        key, payload = str(sample.key_expr), sample.payload.to_bytes()
        seal = None if sample.attachment is None else sample.attachment.to_bytes()
        observer = key.split("/")[2]
        try:
            self._trust.check(key, payload, seal, challenge or bytes(16))
        except ValueError as untrusted:
            if self._trust.knows(observer) and self._presence.needs_question(observer):
                self._to_ask.put(observer)
            raise Refused(str(untrusted)) from None
        frame = json.loads(payload)
        sent_ns = int(frame["stamp_utc_ns"]) + int(frame["latency_ms"] * 1e6)
        if challenge is not None:
            self._presence.answered(observer, sent_ns)
            return True
        if self._presence.believes(observer, sent_ns):
            return True
        if self._presence.needs_question(observer):
            self._to_ask.put(observer)
        return False

    def _hear(self, sample, challenge=None):
        if sample.kind != zenoh.SampleKind.PUT:
            return
        try:
            if len(sample.payload) > MAX_FRAME_REPORT_BYTES:
                raise Refused("too long")
            reports = read(str(sample.key_expr), sample.payload.to_bytes())
            if self._trust is not None and not self._believe(sample, challenge):
                return
        except Refused:
            self.refused += 1
            return
        for report in reports:
            key = (report.observer, report.target)
            last = self._last.get(key)
            if last is not None and (report.epoch, report.frame) == (last.epoch, last.frame) and report == last:
                continue
            if last is None and len(self._last) == MAX_OBSERVERS * MAX_TARGETS:
                self.refused += 1
                continue
            self._last[key] = report
            if self._waiting.qsize() >= self._room:
                try:
                    self._waiting.get_nowait()
                except queue.Empty:
                    pass
            self._waiting.put(report)

    def _see(self, token):
        observer = str(token.key_expr).split("/")[2]
        if token.kind == zenoh.SampleKind.PUT:
            if self._trust is not None and not self._trust.knows(observer):
                self.refused += 1
            elif len(self.alive) < MAX_OBSERVERS:
                self.alive.add(observer)
        else:
            self.alive.discard(observer)
