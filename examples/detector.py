"""A detector in place of Flockeye's own: OpenCV's stock ArUco, in Python.

    flockeye swap detection -- python3 examples/detector.py

Needs `pip install clients/python numpy opencv-contrib-python-headless`. Its corners are OpenCV's, which lie inside
the true ones: expect worse poses than with Flockeye's own detector.
"""

import time

import cv2
import numpy as np

from flockeye import Stage
from flockeye.contract import DETECTION, VIEW, DetectedMarker, Search

# Room in one record.
MAX_MARKERS = 64
# Assumed standard deviation of OpenCV's corners.
DEVIATION_PX = 0.5


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
    if header.search == Search.NOTHING:
        return []
    norm = np.linalg.norm(np.array(header.camera_from_view))
    if not (1 <= header.focal_px <= 262144 and abs(norm - 1) < 1e-3 and header.size_px > 0):
        raise ValueError(f"focal_px {header.focal_px}, a rotation of length {norm}, {header.size_px} px")
    rows = np.frombuffer(pixels, np.uint8)[: header.size_px * header.stride]
    image = rows.reshape(header.size_px, header.stride)[:, : header.size_px]
    corners, ids, _ = detector.detectMarkers(image)
    if ids is None:
        return []
    found = zip(corners, ids.flatten())
    return [marker(header, quad.reshape(4, 2), number) for quad, number in found][:MAX_MARKERS]


def main():
    with Stage("detection") as stage:
        bodies = stage.pipeline["resolved"]["bodies"]
        owned = {marker["id"] for body in bodies["bodies"].values() for marker in body["markers"]}
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, bodies["dictionary"]))
        detector = cv2.aruco.ArucoDetector(dictionary, parameters)
        views = stage.subscriber(VIEW.lane(stage.replica))
        detections = stage.publisher(DETECTION, MAX_MARKERS)
        stage.ready("OpenCV's ArUco, in Python")
        for view in stage.messages(views):
            header, received_ns = view.header, time.monotonic_ns()
            # A view left over from another worker of this lane is not ours to answer.
            if header.worker != stage.replica:
                continue
            try:
                markers = search(detector, header, view.pixels())
            except (ValueError, ZeroDivisionError, cv2.error) as error:
                stage.refuse(f"view {header.view_index}: {error}")
                markers = None
            hits = sum(found.id in owned for found in markers or [])
            record = stage.record(header, received_ns, hits=hits, failed=markers is None)
            detections.send(record, markers or [])
            stage.published()


if __name__ == "__main__":
    main()
