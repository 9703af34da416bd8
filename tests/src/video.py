"""Reads the video of a recording as others do, with `mcap` and `rosbags`.

    video.py RECORDING.mcap FORMAT
"""

import json
import sys
from pathlib import Path

from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore, get_types_from_msg

CHANNEL = "/flockeye/frame/video"
# The parameter set that comes first, by its unit's type.
FIRST_SET = {"h264": lambda byte: byte & 0x1F == 7, "h265": lambda byte: byte >> 1 & 0x3F == 32}


def units(packet):
    """The units between the start codes."""
    return [unit for unit in packet.split(b"\0\0\1")[1:] if unit]


def main():
    path, wanted = Path(sys.argv[1]), sys.argv[2]
    store = get_typestore(Stores.EMPTY)
    packets = []
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages(topics=[CHANNEL]):
            assert schema.name == "foxglove_msgs/msg/CompressedVideo", schema.name
            if not packets:
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
            packets.append(store.deserialize_cdr(message.data, schema.name))
    assert all(packet.format == wanted for packet in packets)
    data = [packet.data.tobytes() for packet in packets]
    assert all(packet.startswith(b"\0\0\0\1") for packet in data)
    begins = [any(map(lambda unit: FIRST_SET[wanted](unit[0]), units(packet))) for packet in data]
    assert begins[0], "it begins with parameter sets"
    with AnyReader([path]) as bag:
        video = [connection for connection in bag.connections if connection.topic == CHANNEL]
        read = [bag.deserialize(raw, one.msgtype) for one, _, raw in bag.messages(connections=video)]
    assert [packet.data.tobytes() for packet in read] == data
    print(json.dumps({"packets": len(data), "key": sum(begins), "bytes": sum(map(len, data))}))


if __name__ == "__main__":
    main()
