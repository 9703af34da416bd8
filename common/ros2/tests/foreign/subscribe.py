"""Subscribes as a ROS node does; prints the first message on each topic and what is listed of it.

subscribe.py ROUTER_PORT DOMAIN TOPIC=TYPE...
"""
import json
import queue
import sys

from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Subscriber, get_topic_info

from messages import plain

# Longer than the test's own patience: the test is what gives up.
PATIENCE_S = 300

port, domain = int(sys.argv[1]), int(sys.argv[2])
topics = dict(argument.split("=") for argument in sys.argv[3:])
store = get_typestore(Stores.ROS2_JAZZY)
heard = queue.Queue()
router = {"router_port": port, "domain_id": domain}
subscribers = [
    ROS2Subscriber(
        topic,
        message_type,
        lambda message, topic=topic: heard.put((topic, message)),
        msg_definition=store.generate_msgdef(message_type, ros_version=2)[0],
        type_hash=store.hash_rihs01(message_type),
        **router,
    )
    for topic, message_type in topics.items()
]
missing = set(topics)
while missing:
    topic, message = heard.get(timeout=PATIENCE_S)
    if topic in missing:
        missing.remove(topic)
        print(json.dumps({"topic": topic, "message": plain(message)}), flush=True)
for topic in topics:
    info = get_topic_info(topic, verbose=True, **router)
    publishers = [
        {"node": f"{publisher.node_namespace}/{publisher.node_name}", "type_hash": publisher.type_hash}
        for publisher in info.publishers
    ]
    listed = {"types": info.topic_types, "publishers": publishers}
    print(json.dumps({"listed": topic, "info": listed}), flush=True)
for subscriber in subscribers:
    subscriber.close()
