"""The shared-memory contract of Flockeye in Python: what docs/CONTRACT.md describes.

Needs `pip install iceoryx2==0.10.0`. A stage or a tool imports this file, joins the instance, and
opens the topics it needs:

    instance = Instance.join("my_tool")
    tracks = instance.subscriber(TRACK)

`python3 flockeye_contract.py ../docs/CONTRACT.md` compares the types below with the documented
layout.
"""

import ctypes
import json
import os
import sys
import time
from ctypes import c_double, c_float, c_int64, c_uint8, c_uint32, c_uint64
from pathlib import Path

import iceoryx2 as iox2

CONTRACT_VERSION = "6"
VERSION_ATTRIBUTE = "flockeye.contract"
NONE = 0xFFFFFFFF

TRACK_STATES = ["tentative", "confirmed", "coasting", "lost", "measured"]
ALL_WINDOWS, FINE_WINDOW, COARSE_WINDOW, SEARCH_NOTHING = range(4)
STARTING, READY, DRAINING, FINISHED, DEGRADED = range(5)
HEALTH_PERIOD_S = 0.25


class Contract(ctypes.Structure):
    """A type of the contract; its name in iceoryx2 is flockeye/NAME."""

    @classmethod
    def type_name(cls):
        return f"flockeye/{cls.__name__}"


def text(field):
    """A name: UTF-8, filled up with zero bytes."""
    return bytes(field).split(b"\0", 1)[0].decode(errors="replace")


def set_text(field, value):
    """Writes a name; what does not fit is cut at a character's border."""
    cut = value.encode()[: len(field)].decode(errors="ignore").encode()
    ctypes.memset(field, 0, len(field))
    ctypes.memmove(field, cut, len(cut))


class FrameStamp(Contract):
    _fields_ = [
        ("sequence", c_uint64),
        ("exposure_ns", c_int64),
        ("stream_ns", c_int64),
        ("published_ns", c_int64),
        ("epoch", c_uint32),
        ("source_generation", c_uint32),
    ]


class Pose(Contract):
    _fields_ = [("position", c_double * 3), ("orientation", c_double * 4)]


class FrameHeader(Contract):
    _fields_ = [
        ("stamp", FrameStamp),
        ("exposure_time_ns", c_uint64),
        ("readout_ns", c_uint64),
        ("width", c_uint32),
        ("height", c_uint32),
        ("stride", c_uint32),
        ("pixel_format", c_uint32),
        ("transfer", c_uint32),
        ("gamma", c_float),
        ("range", c_uint32),
        ("projection", c_uint32),
    ]


class ImuHeader(Contract):
    _fields_ = [("sent_ns", c_int64), ("epoch", c_uint32), ("generation", c_uint32)]


class ImuSample(Contract):
    _fields_ = [
        ("at_ns", c_int64),
        ("rate", c_double * 3),
        ("specific_force", c_double * 3),
    ]


class Rotation(Contract):
    _fields_ = [
        ("stamp", FrameStamp),
        ("earlier_exposure_ns", c_int64),
        ("later_from_earlier", c_double * 4),
        ("covariance", c_double * 9),
        ("rate_in_camera", c_double * 3),
        ("rate_covariance", c_double * 9),
        ("ahead_ns", c_int64),
        ("ahead_from_later", c_double * 4),
        ("ahead_covariance", c_double * 9),
        ("ahead_rate_in_camera", c_double * 3),
        ("ahead_rate_covariance", c_double * 9),
        ("source", c_uint32),
        ("generation", c_uint32),
    ]


class PlanHeader(Contract):
    _fields_ = [
        ("after", FrameStamp),
        ("plan_id", c_uint64),
        ("made_ns", c_int64),
        ("has_after", c_uint32),
        ("generation", c_uint32),
        ("stop_rule", c_uint32),
        ("mode", c_uint32),
        ("view_budget", c_uint32),
        ("reserved", c_uint32),
    ]


class PlannedView(Contract):
    _fields_ = [
        ("camera_from_view", c_double * 4),
        ("rate_in_camera", c_double * 3),
        ("reference_ns", c_int64),
        ("focal_px", c_double),
        ("predicted_camera_from_markers", Pose),
        ("size_px", c_uint32),
        ("kind", c_uint32),
        ("tile", c_uint32),
        ("target", c_uint32),
        ("has_prediction", c_uint32),
        ("search", c_uint32),
    ]


class ViewHeader(Contract):
    _fields_ = [
        ("stamp", FrameStamp),
        ("plan_id", c_uint64),
        ("taken_ns", c_int64),
        ("issued_ns", c_int64),
        ("camera_from_view", c_double * 4),
        ("focal_px", c_double),
        ("predicted_camera_from_markers", Pose),
        ("readout_ns", c_uint64),
        ("generation", c_uint32),
        ("view_index", c_uint32),
        ("attempt", c_uint32),
        ("worker", c_uint32),
        ("size_px", c_uint32),
        ("stride", c_uint32),
        ("kind", c_uint32),
        ("tile", c_uint32),
        ("target", c_uint32),
        ("has_prediction", c_uint32),
        ("transfer", c_uint32),
        ("gamma", c_float),
        ("range", c_uint32),
        ("search", c_uint32),
    ]


class DetectionHeader(Contract):
    _fields_ = [
        ("stamp", FrameStamp),
        ("plan_id", c_uint64),
        ("taken_ns", c_int64),
        ("issued_ns", c_int64),
        ("received_ns", c_int64),
        ("sent_ns", c_int64),
        ("generation", c_uint32),
        ("view_index", c_uint32),
        ("attempt", c_uint32),
        ("worker", c_uint32),
        ("hits", c_uint32),
        ("failed", c_uint32),
        ("view_generation", c_uint32),
        ("reserved", c_uint32),
    ]


class DetectedMarker(Contract):
    _fields_ = [
        ("rays_in_camera", c_double * 3 * 4),
        ("deviations", c_double * 4),
        ("corners_in_view", c_float * 2 * 4),
        ("id", c_uint32),
        ("doubtful", c_uint32),
    ]


class FrameEnd(Contract):
    _fields_ = [
        ("stamp", FrameStamp),
        ("plan_id", c_uint64),
        ("taken_ns", c_int64),
        ("ended_ns", c_int64),
        ("views_issued", c_uint32),
        ("views_abandoned", c_uint32),
        ("reason", c_uint32),
        ("generation", c_uint32),
    ]


class TrackHeader(Contract):
    _fields_ = [("stamp", FrameStamp), ("generation", c_uint32), ("is_last", c_uint32)]


class StageLatency(Contract):
    _fields_ = [
        ("capture_ns", c_int64),
        ("rectification_ns", c_int64),
        ("detection_ns", c_int64),
        ("fusion_ns", c_int64),
        ("total_ns", c_int64),
    ]


class Track(Contract):
    _fields_ = [
        ("observer_from_target", Pose),
        ("covariance", c_double * 36),
        ("linear_velocity", c_double * 3),
        ("angular_velocity", c_double * 3),
        ("measured_observer_from_target", Pose),
        ("measured_covariance", c_double * 36),
        ("predicted_observer_from_target", Pose),
        ("predicted_covariance", c_double * 36),
        ("predicted_ns", c_int64),
        ("age_ns", c_int64),
        ("unseen_ns", c_int64),
        ("latency", StageLatency),
        ("name", c_uint8 * 32),
        ("target", c_uint32),
        ("track_id", c_uint32),
        ("state", c_uint32),
        ("measured_by", c_uint32),
        ("markers", c_uint32),
        ("reserved", c_uint32),
    ]


class Health(Contract):
    _fields_ = [
        ("sent_ns", c_int64),
        ("taken", c_uint64),
        ("published", c_uint64),
        ("dropped", c_uint64),
        ("failed", c_uint64),
        ("queued", c_uint64),
        ("processor_ns", c_uint64),
        ("resident_bytes", c_uint64),
        ("latency_median_ns", c_int64),
        ("latency_p99_ns", c_int64),
        ("stage", c_uint8 * 32),
        ("detail", c_uint8 * 96),
        ("replica", c_uint32),
        ("generation", c_uint32),
        ("pid", c_uint32),
        ("state", c_uint32),
    ]


class TruthHeader(Contract):
    _fields_ = [
        ("stamp", FrameStamp),
        ("world_from_camera", c_double * 4),
        ("observer_yaw", c_double),
        ("exposure_s", c_double),
    ]


class BodyTruth(Contract):
    _fields_ = [
        ("camera_from_markers", Pose),
        ("observer_from_target", Pose),
        ("best_side_px", c_double),
        ("blur_px", c_double),
        ("name", c_uint8 * 32),
        ("target", c_uint32),
        ("markers_visible_50", c_uint32),
        ("markers_visible_90", c_uint32),
        ("localisable", c_uint32),
    ]


class HandOver(Contract):
    _fields_ = [
        ("first", FrameStamp),
        ("sent_ns", c_int64),
        ("stage", c_uint8 * 32),
        ("replica", c_uint32),
        ("old_generation", c_uint32),
        ("new_generation", c_uint32),
        ("state", c_uint32),
    ]


class Complaint(Contract):
    _fields_ = [
        ("sent_ns", c_int64),
        ("count", c_uint64),
        ("stage", c_uint8 * 32),
        ("detail", c_uint8 * 96),
        ("replica", c_uint32),
        ("pid", c_uint32),
        ("kind", c_uint32),
        ("reserved", c_uint32),
    ]


# Name of the service, type of the user header, type of the payload's items.
FRAME = ("flockeye/frame", FrameHeader, c_uint8)
ROTATION = ("flockeye/rotation", Rotation, c_uint8)
PLAN = ("flockeye/plan", PlanHeader, PlannedView)
DETECTION = ("flockeye/detection", DetectionHeader, DetectedMarker)
FRAME_END = ("flockeye/frame_end", FrameEnd, c_uint8)
TRACK = ("flockeye/track", TrackHeader, Track)
HEALTH = ("flockeye/health", Health, c_uint8)
TRUTH = ("flockeye/truth", TruthHeader, BodyTruth)
HANDOVER = ("flockeye/handover", HandOver, c_uint8)
COMPLAINT = ("flockeye/complaint", Complaint, c_uint8)


def view(worker):
    """The lane of the view topic that is meant for one detection worker."""
    return (f"flockeye/view/{worker}", ViewHeader, c_uint8)


class Instance:
    """A running pipeline, joined by one process."""

    def __init__(self, folder, name):
        self.folder = Path(folder)
        self.stage = os.environ.get("FLOCKEYE_STAGE", name)
        self.replica = int(os.environ.get("FLOCKEYE_REPLICA", 0))
        self.generation = int(os.environ.get("FLOCKEYE_GENERATION", 0))
        self.pipeline = json.loads((self.folder / "pipeline.json").read_text())
        # Nothing but errors of iceoryx2's own on standard error.
        iox2.set_log_level(iox2.LogLevel.Fatal)
        config = iox2.config.from_file(iox2.FilePath.new(str(self.folder / "iceoryx2.toml")))
        self.node = (
            iox2.NodeBuilder.new()
            .name(iox2.NodeName.new(f"{name}-{self.replica}"))
            .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
            .config(config)
            .create(iox2.ServiceType.Ipc)
        )

    @classmethod
    def join(cls, name, folder=None):
        """Joins the instance in `folder`, or the one that FLOCKEYE_INSTANCE_DIR names."""
        folder = folder or os.environ.get("FLOCKEYE_INSTANCE_DIR")
        if not folder:
            raise SystemExit("FLOCKEYE_INSTANCE_DIR is not set: name the folder of a running instance")
        return cls(folder, name)

    def _open(self, topic):
        name, header, item = topic
        name = iox2.ServiceName.new(name)
        version = iox2.AttributeVerifier.new().require(
            iox2.AttributeKey.new(VERSION_ATTRIBUTE), iox2.AttributeValue.new(CONTRACT_VERSION)
        )
        data = (
            self.node.service_builder(name)
            .publish_subscribe(iox2.Slice[item])
            .user_header(header)
            .open_with_attributes(version)
        )
        return data, self.node.service_builder(name).event().open()

    def subscriber(self, topic):
        """Receives a topic."""
        data, wake = self._open(topic)
        return Subscriber(data.subscriber_builder().create(), wake.listener_builder().create(), topic)

    def publisher(self, topic, max_items):
        """Publishes a topic, in messages of at most `max_items` items."""
        data, wake = self._open(topic)
        publisher = data.publisher_builder().initial_max_slice_len(max(max_items, 1)).create()
        return Publisher(publisher, wake.notifier_builder().create(), topic)


class Subscriber:
    """Messages of one topic."""

    def __init__(self, port, listener, topic):
        self.port, self.listener, self.topic = port, listener, topic

    def wait(self, seconds):
        """Returns when something was published, or after `seconds`."""
        self.listener.timed_wait(iox2.Duration.from_secs_f64(seconds))

    def messages(self):
        """Everything that waits: (header, items), both valid until the next one is asked for."""
        while (sample := self.port.receive()) is not None:
            # Not payload().len(): version 0.10.0 of the bindings counts bytes there.
            count = sample.header.number_of_elements
            array = (self.topic[2] * count).from_address(sample.payload_ptr)
            yield sample.user_header().contents, array
            sample.delete()


class Publisher:
    """Publishes on one topic, and wakes its subscribers."""

    def __init__(self, port, notifier, topic):
        self.port, self.notifier, self.topic = port, notifier, topic

    def send(self, header, items=()):
        """Sends one message."""
        loan = self.port.loan_slice_uninit(len(items))
        loan.user_header().contents = header
        ctypes.memmove(loan.user_header(), ctypes.byref(header), ctypes.sizeof(header))
        payload = loan.payload()
        for index, item in enumerate(items):
            payload[index] = item
        loan.assume_init().send()
        self.notifier.notify()


class HealthReporter:
    """Says every 250 ms that the stage lives. To be called from the stage's own loop, so that a hung
    stage goes silent."""

    def __init__(self, instance, detail):
        self.instance = instance
        self.publisher = instance.publisher(HEALTH, 0)
        self.report = Health(
            latency_median_ns=-1,
            latency_p99_ns=-1,
            replica=instance.replica,
            generation=instance.generation,
            pid=os.getpid(),
        )
        set_text(self.report.stage, instance.stage)
        set_text(self.report.detail, detail)
        self.next_s = 0.0

    def send(self, state):
        """Reports at once: for a change of state."""
        resident_pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.report.sent_ns = time.monotonic_ns()
        self.report.processor_ns = time.process_time_ns()
        self.report.resident_bytes = resident_pages * os.sysconf("SC_PAGE_SIZE")
        self.report.state = state
        self.publisher.send(self.report)
        self.next_s = time.monotonic() + HEALTH_PERIOD_S

    def send_if_due(self, state):
        """Reports if the last report is 250 ms old."""
        if time.monotonic() >= self.next_s:
            self.send(state)


TYPES = [
    FrameStamp, Pose, FrameHeader, ImuHeader, ImuSample, Rotation, PlanHeader, PlannedView,
    ViewHeader, DetectionHeader, DetectedMarker, FrameEnd, TrackHeader, StageLatency, Track, Health,
    TruthHeader, BodyTruth, HandOver, Complaint,
]  # fmt: skip


def layout():
    """The types as the block in docs/CONTRACT.md lists them."""
    lines = []
    for kind in TYPES:
        lines.append(f"{kind.__name__} {ctypes.sizeof(kind)} {ctypes.alignment(kind)}")
        lines += [f"  {name} {getattr(kind, name).offset}" for name, *_ in kind._fields_]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    documented = Path(sys.argv[1]).read_text().split("```layout\n")[1].split("```")[0]
    if documented != layout():
        raise SystemExit("the types in this file are not those of the documented layout")
    print("the types in this file are those of the documented layout")
