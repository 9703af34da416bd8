"""Speaks Foxglove's WebSocket protocol as Foxglove does, without its code, and prints what comes as JSON.

    python foxglove.py ws://127.0.0.1:8765 TOPIC... TOPIC=WORD...

    python foxglove.py ws://127.0.0.1:8765 --seek SHARE

For each topic a line: its schema and its first message (that has the word in it), which is decoded by the schema
that came with it. What does not come in time is an error.
"""

import asyncio
import base64
import json
import struct
import sys

import websockets
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory

PROTOCOLS = ["foxglove.sdk.v1"]
MESSAGE_DATA = 1


def decoder(channel):
    """A function from a message's bytes to plain values."""
    if channel["encoding"] == "json":
        return json.loads
    assert (channel["encoding"], channel["schemaEncoding"]) == ("protobuf", "protobuf"), channel
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    waiting = list(files.file)
    while waiting:
        # A file can be added once those that it imports are there.
        known = [file for file in waiting if not {name for name in file.dependency} & {w.name for w in waiting}]
        assert known, "files import each other"
        for file in known:
            pool.Add(file)
            waiting.remove(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
    return lambda data: json_format.MessageToDict(kind.FromString(data), preserving_proto_field_name=True)


async def listen(address, words, missing):
    """Prints the first message of each topic, and takes the topic out of those that are missing."""
    async with websockets.connect(address, subprotocols=PROTOCOLS, max_size=None) as socket:
        assert socket.subprotocol == PROTOCOLS[0], socket.subprotocol
        subscribed = {}
        while missing:
            message = await socket.recv()
            if isinstance(message, str):
                message = json.loads(message)
                if message["op"] == "advertise":
                    new = [channel for channel in message["channels"] if channel["topic"] in missing]
                    numbers = {len(subscribed) + k: channel for k, channel in enumerate(new)}
                    subscribed.update(numbers)
                    asked = [{"id": number, "channelId": channel["id"]} for number, channel in numbers.items()]
                    await socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
                continue
            kind, number, stamp = struct.unpack_from("<BIQ", message)
            channel = subscribed[number]
            if kind != MESSAGE_DATA or channel["topic"] not in missing:
                continue
            content = decoder(channel)(message[13:])
            if words[channel["topic"]] not in json.dumps(content):
                continue
            missing.remove(channel["topic"])
            line = {"topic": channel["topic"], "schema": channel.get("schemaName"), "stamp": stamp, "message": content}
            print(json.dumps(line), flush=True)


async def seek(address, share):
    """Has a recording show the time at that share of it, paused; prints the range, that time, and the frame."""
    async with websockets.connect(address, subprotocols=PROTOCOLS, max_size=None) as socket:
        last, is_answered = None, False
        while True:
            message = await socket.recv()
            if isinstance(message, str):
                message = json.loads(message)
                if message["op"] == "serverInfo":
                    assert "playbackControl" in message["capabilities"], message
                    nanoseconds = lambda time: time["sec"] * 10**9 + time["nsec"]
                    begin, end = (nanoseconds(message[f"data{which}Time"]) for which in ("Start", "End"))
                if message["op"] == "advertise":
                    frames = next(c for c in message["channels"] if c["topic"] == "/frames")
                    asked = [{"id": 1, "channelId": frames["id"]}]
                    await socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
                    sought = begin + int(share * (end - begin))
                    await socket.send(struct.pack("<BBfBQI", 3, 1, 1.0, 1, sought, 1) + b"a")
                continue
            if message[0] == 5:
                status, at, speed, did_seek, length = struct.unpack_from("<BQfBI", message, 1)
                if message[19:19 + length] == b"a":
                    assert (status, at, bool(did_seek)) == (1, sought, True), (status, at, did_seek)
                    is_answered = True
            # One that was under way may come first; while it is paused, the frame comes again and again.
            if message[0] == MESSAGE_DATA and is_answered:
                content, (stamp,) = json.loads(message[13:]), struct.unpack_from("<Q", message, 5)
                if stamp == last:
                    line = {"begin": begin, "end": end, "sought": sought, "stamp": stamp, "key": content["key"]}
                    return print(json.dumps(line), flush=True)
                last = stamp


def main(address, *wanted):
    if wanted[0] == "--seek":
        return asyncio.run(asyncio.wait_for(seek(address, float(wanted[1])), timeout=60))
    words = dict((topic + "=").split("=")[:2] for topic in wanted)
    missing = set(words)
    try:
        asyncio.run(asyncio.wait_for(listen(address, words, missing), timeout=60))
    except TimeoutError:
        sys.exit(f"did not come: {missing}")


main(*sys.argv[1:])
