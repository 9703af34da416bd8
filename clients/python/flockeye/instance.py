"""A running pipeline, joined by one process."""

import ctypes
import json
import os
from pathlib import Path

import iceoryx2 as iox2

from .contract import CONTRACT_VERSION, VERSION_ATTRIBUTE
from .ports import Publisher, Subscriber, wait_any

FOLDER_VARIABLE = "FLOCKEYE_INSTANCE_DIR"


class Instance:
    """A running pipeline."""

    def __init__(self, folder, node_name):
        self.folder = Path(folder)
        # The resolved configuration: the keys of pipeline.yaml, and `resolved` with what follows from them.
        self.pipeline = json.loads((self.folder / "pipeline.json").read_text())
        # Nothing but errors of iceoryx2's own on standard error.
        iox2.set_log_level(iox2.LogLevel.Fatal)
        config = iox2.config.from_file(iox2.FilePath.new(str(self.folder / "iceoryx2.toml")))
        self._node = (
            iox2.NodeBuilder.new()
            .name(iox2.NodeName.new(node_name))
            .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
            .config(config)
            .create(iox2.ServiceType.Ipc)
        )

    @classmethod
    def join(cls, node_name, folder=None):
        """Joins the instance in `folder`, or the one that FLOCKEYE_INSTANCE_DIR names."""
        folder = folder or os.environ.get(FOLDER_VARIABLE)
        if not folder:
            raise SystemExit(f"{FOLDER_VARIABLE} is not set. Cure: name the folder of a running instance")
        if not (Path(folder) / "pipeline.json").exists():
            raise SystemExit(f"{folder} is not the folder of a running instance: it has no pipeline.json")
        return cls(folder, node_name)

    def runs(self):
        """Whether the pipeline runs: the launcher removes the folder at its end."""
        return self.folder.exists()

    def subscriber(self, topic, listening=None):
        """Receives a topic; of one with lanes, name the lane: `VIEW.lane(0)`."""
        data, wake = self._open(topic)
        port = data.subscriber_builder().create()
        return Subscriber(port, wake.listener_builder().create(), topic, listening)

    def publisher(self, topic, max_items=0, max_loans=1, waits_for_readers=False):
        """Publishes a topic in messages of at most `max_items` items, of which `max_loans` are filled at once. With
        `waits_for_readers` a full reader of a lossless run is waited for."""
        data, wake = self._open(topic)
        full = iox2.BackpressureStrategy
        strategy = full.RetryUntilDelivered if waits_for_readers else full.DiscardData
        port = (
            data.publisher_builder()
            .initial_max_slice_len(max(max_items, 1))
            .max_loaned_samples(max_loans)
            .backpressure_strategy(strategy)
            .create()
        )
        return Publisher(port, wake.notifier_builder().create(), data, topic)

    def messages(self, *subscribers, seconds):
        """What waits on these topics, or comes within so many seconds."""
        wait_any(subscribers, seconds)
        for subscriber in subscribers:
            yield from subscriber.waiting()

    def _open(self, topic):
        if topic.has_lanes:
            raise ValueError(f"{topic.service} has a lane for each worker: use .lane(worker)")
        name = iox2.ServiceName.new(topic.service)
        version = iox2.AttributeVerifier.new().require(
            iox2.AttributeKey.new(VERSION_ATTRIBUTE), iox2.AttributeValue.new(CONTRACT_VERSION)
        )
        data = (
            self._node.service_builder(name)
            .publish_subscribe(iox2.Slice[topic.item])
            .user_header(topic.header)
            .open_with_attributes(version)
        )
        return data, self._node.service_builder(name).event().open()


def text(field):
    """A name in a message: UTF-8, filled up with zero bytes."""
    return bytes(field).split(b"\0", 1)[0].decode(errors="replace")


def set_text(field, value):
    """Writes a name; what does not fit is cut at a character's border."""
    cut = value.encode()[: len(field)].decode(errors="ignore").encode()
    ctypes.memset(field, 0, len(field))
    ctypes.memmove(field, cut, len(cut))
