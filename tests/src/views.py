"""Looks at the pixels of recorded views with OpenCV: the markers that both detectors find are in the same places.

    views.py RECORDING.mcap DICTIONARY
"""

import json
import sys

import cv2
import numpy as np
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore, get_types_from_msg

VIEWS, PIXELS, DETECTIONS = "/flockeye/view", "/flockeye/view/image", "/flockeye/detection"


def read(path):
    """The messages of these channels, each with its number in its channel."""
    store, messages = get_typestore(Stores.EMPTY), {VIEWS: [], PIXELS: [], DETECTIONS: []}
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for schema in reader.get_summary().schemas.values():
            store.register(get_types_from_msg(schema.data.decode(), schema.name))
        for schema, channel, message in reader.iter_messages(topics=list(messages)):
            value = store.deserialize_cdr(message.data, schema.name)
            messages[channel.topic].append((message.sequence, value))
    return messages


def picture(view, image):
    """The pixels of a view."""
    assert (image.width, image.height) == (view.size_px, view.size_px)
    assert image.encoding == "mono8" and image.step == view.stride
    assert len(image.data) == image.step * image.height, len(image.data)
    return np.asarray(image.data).reshape(image.height, image.step)[:, :image.width].copy()


def main():
    messages = read(sys.argv[1])
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, sys.argv[2]))
    detector = cv2.aruco.ArucoDetector(dictionary)
    headers = {number: message.header for number, message in messages[VIEWS]}
    assert sorted(headers) == sorted(number for number, _ in messages[PIXELS])
    seen = {}
    for number, image in messages[PIXELS]:
        view = headers[number]
        corners, ids, _ = detector.detectMarkers(picture(view, image))
        key = (view.stamp.sequence, view.view_index, view.attempt)
        seen[key] = dict(zip([] if ids is None else ids.ravel().tolist(), corners))
    found = off = 0
    distances = []
    for _, message in messages[DETECTIONS]:
        header = message.header
        there = seen[(header.stamp.sequence, header.view_index, header.attempt)]
        for marker in message.items:
            if marker.id not in there:
                off += 1
                continue
            found += 1
            own = np.asarray(marker.corners_in_view).reshape(4, 2)
            other = there[marker.id].reshape(4, 2)
            # OpenCV's corners of small markers are off by some pixels; their middle is not.
            distances.append(float(np.linalg.norm(own.mean(axis=0) - other.mean(axis=0))))
    print(json.dumps({"views": len(seen), "found": found, "missing": off,
                      "median_px": float(np.median(distances)) if distances else None}))


if __name__ == "__main__":
    main()
