#!/usr/bin/env python3
"""The paper's method as one would write it in Python today: a peer to be measured against.

Holter et al., "Relative Visual Localization for UAS": the sphere is cut into views (section III-A),
searched in the order of Algorithm 1 until the first view with a marker of a known body, and each
marker's pose gives one of the body (OpenCV's detectMarkers with subpixel corners, and its square
solver); the body's position is their mean. Written with OpenCV's own functions and NumPy; maps are
made once. Poses go to a CSV that `flockeye eval` reads; what it cost goes to standard output as JSON.

    paper.py --source flight.mp4 --bodies bodies.json --poses poses.csv [--search optimized|exhaustive]
"""

import argparse
import csv
import json
import resource
import sys
import time

import cv2
import numpy as np

COLUMNS = ["frame", "stamp_s", "target", "px", "py", "pz", "qx", "qy", "qz", "qw", "state",
           "markers", "measured_by", "latency_ms"]
VIEW_PX = 921
VIEW_DEG = 74.0


def partition():
    """The twelve vertices of the icosahedron, as rotations camera_from_view (x right, y down, z ahead)."""
    golden = (1 + 5**0.5) / 2
    vertices = [(s * a, t * b, 0.0) for s in (1, -1) for t in (1, -1) for a, b in ((1.0, golden),)]
    directions = [np.roll(v, k) for k in range(3) for v in vertices]
    rotations = []
    for direction in directions:
        ahead = direction / np.linalg.norm(direction)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotations.append(np.column_stack([right, np.cross(ahead, right), ahead]))
    return rotations


def map_of(camera_from_view, focal, width, height):
    """Where each pixel of a view lies in the equirectangular image, as fixed-point maps for remap."""
    middle = (VIEW_PX - 1) / 2
    v, u = np.mgrid[0:VIEW_PX, 0:VIEW_PX].astype(np.float64)
    rays = np.stack([(u - middle) / focal, (v - middle) / focal, np.ones_like(u)], -1) @ camera_from_view.T
    longitude = np.arctan2(rays[..., 1], rays[..., 0])
    latitude = np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))
    x = (0.5 - longitude / (2 * np.pi)) * width - 0.5
    y = (0.5 - latitude / np.pi) * height - 0.5
    return cv2.convertMaps(x.astype(np.float32), y.astype(np.float32), cv2.CV_16SC2)


def quaternion(rotation):
    """x, y, z, w of a rotation matrix."""
    axis_angle = cv2.Rodrigues(rotation)[0].ravel()
    angle = np.linalg.norm(axis_angle)
    if angle < 1e-12:
        return [0.0, 0.0, 0.0, 1.0]
    return [*(axis_angle / angle * np.sin(angle / 2)), np.cos(angle / 2)]


class Markers:
    """Which body carries a marker, and where: body_from_marker of each id."""

    def __init__(self, path):
        described = json.load(open(path))
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, described["dictionary"]))
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self.detector = cv2.aruco.ArucoDetector(dictionary, parameters)
        self.known = {}
        for name, body in described["bodies"].items():
            for marker in body["markers"]:
                corners = np.array(marker["corners"], dtype=np.float64)
                right, up = corners[1] - corners[0], corners[0] - corners[3]
                side = np.linalg.norm(right)
                axes = np.column_stack([right / side, up / side, np.cross(right, up) / side**2])
                self.known[marker["id"]] = (name, axes, corners.mean(axis=0), side)

    def poses(self, view, focal):
        """The bodies' poses that the view's markers give: name -> [(rotation, position, pixels)]."""
        corners, ids, _ = self.detector.detectMarkers(view)
        middle = (VIEW_PX - 1) / 2
        camera = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
        found = {}
        for quad, marker in zip(corners, [] if ids is None else ids.ravel()):
            if int(marker) not in self.known:
                continue
            name, axes, centre, side = self.known[int(marker)]
            half = side / 2
            square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
            quad = quad.reshape(4, 2).astype(np.float64)
            good, turn, shift = cv2.solvePnP(square, quad, camera, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
            if not good:
                continue
            rotation = cv2.Rodrigues(turn)[0] @ axes.T
            position = shift.ravel() - rotation @ centre
            found.setdefault(name, []).append((rotation, position, cv2.contourArea(quad.astype(np.float32))))
        return found


def order(rotations, last, mode):
    """Algorithm 1: the partition of the last detection first, the others by their distance from it."""
    if last is None or mode == "exhaustive":
        return range(len(rotations))
    cosines = [rotations[last][:, 2] @ rotation[:, 2] for rotation in rotations]
    return sorted(range(len(rotations)), key=lambda k: -round(float(cosines[k]), 9))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--source", required=True)
    parser.add_argument("--bodies", required=True)
    parser.add_argument("--poses", required=True)
    parser.add_argument("--search", choices=["optimized", "exhaustive"], default="optimized")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    markers = Markers(arguments.bodies)
    video = cv2.VideoCapture(arguments.source)
    rate = video.get(cv2.CAP_PROP_FPS) or 30.0
    rotations, maps, focal = partition(), None, (VIEW_PX / 2) / np.tan(np.radians(VIEW_DEG / 2))
    last, frames, localizations, decoding_s, work_s = None, 0, 0, 0.0, 0.0
    with open(arguments.poses, "w", newline="") as out:
        table = csv.writer(out)
        table.writerow(COLUMNS)
        while True:
            begun = time.process_time()
            is_there, image = video.read()
            if not is_there:
                break
            luma = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            decoded = time.process_time()
            decoding_s += decoded - begun
            if maps is None:
                height, width = luma.shape
                maps = [map_of(rotation, focal, width, height) for rotation in rotations]
                decoded = time.process_time()
            poses = {}
            for part in order(rotations, last, arguments.search):
                view = cv2.remap(luma, *maps[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
                found = markers.poses(view, focal)
                for name, seen in found.items():
                    turned = [(rotations[part] @ r, rotations[part] @ p, area) for r, p, area in seen]
                    poses.setdefault(name, []).extend(turned)
                if found:
                    last = part
                    if arguments.search == "optimized":
                        break
            worked = time.process_time() - decoded
            work_s += worked
            for name, seen in poses.items():
                position = np.mean([p for _, p, _ in seen], axis=0)
                largest = max(seen, key=lambda pose: pose[2])[0]
                table.writerow([frames, frames / rate, name, *position, *quaternion(largest),
                                "confirmed", len(seen), "decoded", worked * 1e3])
                localizations += 1
            frames += 1
    used = resource.getrusage(resource.RUSAGE_SELF)
    json.dump({"frames": frames, "localizations": localizations, "decoding_s": decoding_s,
               "work_s": work_s, "processor_s": used.ru_utime + used.ru_stime}, sys.stdout)
    print()


if __name__ == "__main__":
    main()
