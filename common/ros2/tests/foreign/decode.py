"""Prints what rosbags reads in the golden files of a folder, and the hashes of types.

decode.py FOLDER POSE_TYPE TF_TYPE ODOMETRY_TYPE
"""
import json
import pathlib
import sys

from rosbags.typesys import Stores, get_typestore

from messages import plain

folder, *types = sys.argv[1:]
store = get_typestore(Stores.ROS2_JAZZY)
messages = {}
for name, message_type in zip(("pose", "tf", "odometry"), types, strict=True):
    golden = bytes.fromhex((pathlib.Path(folder) / f"{name}.hex").read_text())
    messages[name] = plain(store.deserialize_cdr(golden, message_type))
hashes = {message_type: store.hash_rihs01(message_type) for message_type in types}
json.dump({"messages": messages, "hashes": hashes}, sys.stdout)
