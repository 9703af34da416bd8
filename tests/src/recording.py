"""Reads a recording as others do, with `mcap` and `rosbags`, and compares its poses with those that
`flockeye up --poses` wrote.

    recording.py RECORDING.mcap POSES.csv
"""

import csv
import json
import sys
from pathlib import Path

from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore, get_types_from_msg

ROS_TYPES = {
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "tf2_msgs/msg/TFMessage",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
}
POSE = ["px", "py", "pz", "qx", "qy", "qz", "qw"]


def poses_by_frame(path):
    """(frame, neighbour) to the pose as numbers, and the whole row."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    return {(int(row["frame"]), row["target"]): row for row in rows}


def numbers(pose):
    at, turn = pose.position, pose.orientation
    return [at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w]


def read_with_mcap(path):
    """Every message, by its channel, deserialized by the definitions in the file."""
    store = get_typestore(Stores.EMPTY)
    messages = {}
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 0
        for schema in summary.schemas.values():
            assert schema.encoding == "ros2msg", schema
            store.register(get_types_from_msg(schema.data.decode(), schema.name))
        for schema, channel, message in reader.iter_messages():
            assert channel.message_encoding == "cdr"
            value = store.deserialize_cdr(message.data, schema.name)
            messages.setdefault(channel.topic, []).append((message, value))
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attachments = {record.name: json.loads(record.data) for record in reader.iter_attachments()}
    counted = summary.statistics.message_count
    assert counted == sum(map(len, messages.values())), counted
    return messages, metadata, attachments, store


def text(value):
    return value.rstrip("\0")


def compare(messages, rows, observer):
    """Poses in all three forms are those of the table. Returns how many were compared."""
    compared = 0
    by_stamp = {}
    for _, message in messages["/flockeye/track"]:
        for track in message.items:
            row = rows.get((message.header.stamp.sequence, text(track.name)))
            assert row is not None, (message.header.stamp.sequence, track.name)
            at, turn = track.observer_from_target.position, track.observer_from_target.orientation
            wanted = [float(row[name]) for name in POSE]
            assert [*at] == wanted[:3], row
            # The table's are normalized.
            assert all(abs(one - other) < 1e-12 for one, other in zip(turn, wanted[3:])), row
            by_stamp[(text(track.name), compared)] = [*at, *turn], list(track.covariance)
            compared += 1
    for name in {key[0] for key in by_stamp}:
        published = messages[f"/{observer}/neighbours/{name}/pose"]
        tracked = [value for key, value in by_stamp.items() if key[0] == name]
        assert len(published) == len(tracked), (len(published), len(tracked))
        for (_, message), (pose, covariance) in zip(published, tracked):
            assert numbers(message.pose.pose) == pose
            assert list(message.pose.covariance) == covariance
            assert message.header.frame_id == f"{observer}/base_link"
    transforms = [one for _, message in messages["/tf"] for one in message.transforms]
    assert len(transforms) == compared, (len(transforms), compared)
    return compared


def main():
    path, table = Path(sys.argv[1]), sys.argv[2]
    messages, metadata, attachments, store = read_with_mcap(path)
    about = metadata["flockeye"]
    assert attachments["pipeline.json"]["instance"] == about["instance"]
    assert attachments["pipeline.json"]["fusion"]["coding"] != "auto", "files that it depends on may be gone later"
    assert "alpha" in attachments["bodies.json"]["bodies"]
    compared = compare(messages, poses_by_frame(table), about["observer"])

    # The bag of ROS has the same.
    poses = transforms = 0
    with AnyReader([path]) as bag:
        topics = {connection.topic for connection in bag.connections}
        assert topics == set(messages), topics ^ set(messages)
        assert {"/tf", "/flockeye/track", "/flockeye/health"} <= topics
        for connection, _, data in bag.messages():
            value = bag.deserialize(data, connection.msgtype)
            if connection.topic.endswith("/pose"):
                poses += 1
            elif connection.topic == "/tf":
                transforms += len(value.transforms)
    assert (poses, transforms) == (compared, compared), (poses, transforms, compared)

    # The definitions of ROS's own types are ROS's.
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    for name in ROS_TYPES & set(store.fielddefs):
        assert store.fielddefs[name] == jazzy.fielddefs[name], name
    print(json.dumps({
        "compared": compared,
        "topics": {topic: len(found) for topic, found in messages.items()},
    }))


if __name__ == "__main__":
    main()
