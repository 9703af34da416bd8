"""A detector in place of Flockeye's own: OpenCV's stock ArUco, in Python.

    flockeye up --set 'stages.detection.command=[python3, examples/detector.py]'

Needs `pip install iceoryx2==0.10.0 numpy opencv-contrib-python-headless`. It shows what a detection
stage owes the others: one record for each view, in order, whether there is anything in it or not;
health four times a second; an end on SIGTERM. Its corners are OpenCV's, which lie inside the true
ones: expect worse poses than with Flockeye's own detector.
"""

import json
import signal
import time
from pathlib import Path

import cv2
import numpy as np

from flockeye_contract import (
    DETECTION, DRAINING, READY, SEARCH_NOTHING, STARTING,
    DetectedMarker, DetectionHeader, HealthReporter, Instance, view,
)  # fmt: skip

# Room in one record.
MAX_MARKERS = 64
# Assumed standard deviation of OpenCV's corners.
DEVIATION_PX = 0.5


def own_ids(bodies):
    """Ids of the configured bodies' markers: a view that holds one is a hit."""
    if bodies["file"]:
        file = json.loads(Path(bodies["file"]).read_text())
        return file["dictionary"], {
            marker["id"] for body in file["bodies"].values() for marker in body["markers"]
        }
    firsts = [body["first_id"] for body in bodies["list"]]
    return bodies["dictionary"], {first + k for first in firsts for k in range(17)}


def rotation(x, y, z, w):
    """A unit quaternion as a matrix."""
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def marker(header, corners, marker_id):
    """A decoded marker: corners in the view, and their rays in the camera frame."""
    # What is stored, rounded to float, is what the rays must belong to.
    corners = corners.astype(np.float32)
    centre = (header.size_px - 1) / 2
    rays = np.column_stack([
        (corners[:, 0] - centre) / header.focal_px,
        (corners[:, 1] - centre) / header.focal_px,
        np.ones(4),
    ])  # fmt: skip
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays = rays @ rotation(*header.camera_from_view).T
    found = DetectedMarker(id=int(marker_id))
    for k in range(4):
        found.rays_in_camera[k][:] = rays[k]
        found.corners_in_view[k][:] = corners[k]
        found.deviations[k] = DEVIATION_PX / header.focal_px
    return found


def search(detector, header, pixels):
    """The markers in a view, read in place."""
    # OpenCV has windows of its own; only views whose pixels alone are wanted are left out.
    if header.search == SEARCH_NOTHING:
        return []
    rows = np.frombuffer(pixels, np.uint8)[: header.size_px * header.stride]
    image = rows.reshape(header.size_px, header.stride)[:, : header.size_px]
    corners, ids, _ = detector.detectMarkers(image)
    if ids is None:
        return []
    found = zip(corners, ids.flatten())
    return [marker(header, quad.reshape(4, 2), number) for quad, number in found][:MAX_MARKERS]


def main():
    stopping = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopping.append(True))
    instance = Instance.join("detection")
    health = HealthReporter(instance, "OpenCV's ArUco, in Python")
    health.send(STARTING)
    dictionary, owned = own_ids(instance.pipeline["bodies"])
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)), parameters
    )
    views = instance.subscriber(view(instance.replica))
    detections = instance.publisher(DETECTION, MAX_MARKERS)
    health.send(READY)
    while not stopping:
        views.wait(0.1)
        for header, pixels in views.messages():
            health.report.taken += 1
            # A view left over from another worker of this lane is not ours to answer.
            if header.worker != instance.replica:
                continue
            received_ns = time.monotonic_ns()
            markers = search(detector, header, pixels)
            record = DetectionHeader(
                stamp=header.stamp,
                plan_id=header.plan_id,
                taken_ns=header.taken_ns,
                issued_ns=header.issued_ns,
                received_ns=received_ns,
                sent_ns=time.monotonic_ns(),
                generation=instance.generation,
                view_index=header.view_index,
                attempt=header.attempt,
                worker=instance.replica,
                hits=sum(found.id in owned for found in markers),
                view_generation=header.generation,
            )
            detections.send(record, markers)
            health.report.published += 1
            health.send_if_due(READY)
        health.send_if_due(READY)
    health.send(DRAINING)


if __name__ == "__main__":
    main()
