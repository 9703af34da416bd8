#!/usr/bin/env python3
"""Finds markers and bodies in real pictures with truth, and compares stated deviations with errors.

    make results PARTS=real

Prints one JSON object: the tables of docs/results/real.md, and the row for README.md. The pictures are those of the
folder `real` below FLOCKEYE_DATA. Needs `make python`.
"""

import json
import os
import sys
from pathlib import Path

import numpy as np

from results import DATA, QUIET, ROOT, WORK, call, rows, shown

REAL = Path(os.environ.get("FLOCKEYE_DATA") or DATA) / "real"
# The tag of the turntable, as its authors describe it.
TAG_ID, TAG_SIDE_M = 76, 0.065
# A pose that is off by more is false.
FALSE_MM, FALSE_DEG = 100, 10
# Photographs: folder, dictionary.
PHOTOGRAPHS = {
    "outdoor cubes (AprilRobotics)": ("photographs", "DICT_APRILTAG_36h11"),
    "single tags (Duckietown)": ("turntable/multiple/images", "DICT_APRILTAG_36h11"),
    "tag on a turntable (Duckietown)": ("turntable/rotation/images", "DICT_APRILTAG_36h11"),
}


def matrix(quaternion):
    """Rotation matrix of a quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                     [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                     [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])


def turn(rotation):
    """Rotation vector of a matrix, radians."""
    angle = np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return axis / 2 if angle < 1e-6 else axis * angle / (2 * np.sin(angle))


def numbers(row, names):
    """These columns of a row."""
    return np.array([float(row[name]) for name in names])


def covariance(row):
    """Covariance of a measured pose: position, then rotation vector."""
    return np.array([[float(row[f"m{min(i, j)}{max(i, j)}"]) for j in range(6)] for i in range(6)])


def measured(lens, images, bodies, name, settings):
    """Measured poses of a folder of pictures, each for itself, and the command."""
    poses = WORK / f"{name}.csv"
    command = ["up", str(lens), "--source", str(images), "--bodies", str(bodies), "--profile", "stills", *QUIET,
               *[word for setting in settings for word in ("--set", setting)], "--poses", str(poses)]
    print(f"  {shown(command)}", file=sys.stderr, flush=True)
    call(command)
    told = " ".join(f"--set {setting}" for setting in settings)
    typed = f"flockeye up {Path(lens).name} --source {Path(images).name} --bodies {Path(bodies).name} --profile stills {told}"
    return [row for row in rows(poses) if row["measured_by"] != "nothing"], typed.strip()


def board(settings):
    """Errors and NEES of the board's pose behind the fisheye: millimetres, degrees, two NEES, markers."""
    folder = REAL / "tumvi"
    truth = {row["frame"]: row for row in rows(folder / "truth.csv")}
    poses, command = measured(folder / "lens.yaml", folder / "images", folder / "bodies.json", "real-board", settings)
    found = []
    for row in poses:
        true = truth[row["frame"]]
        position = numbers(row, ("mx", "my", "mz")) - numbers(true, "xyz")
        rotation = turn(matrix(numbers(row, ("mqw", "mqx", "mqy", "mqz"))) @ matrix(numbers(true, ("qw", "qx", "qy", "qz"))).T)
        stated = covariance(row)
        found.append((1e3 * np.linalg.norm(position), np.degrees(np.linalg.norm(rotation)),
                      position @ np.linalg.solve(stated[:3, :3], position),
                      rotation @ np.linalg.solve(stated[3:, 3:], rotation), int(row["markers"])))
    if not found:
        sys.exit("real: the board has no pose in any picture")
    return np.array(found), len(truth), command


def turntable(settings):
    """Errors of the tag's angle about the turntable's axis, degrees, and in stated deviations."""
    folder = REAL / "turntable/rotation"
    side = TAG_SIDE_M / 2
    corners = [[-side, side, 0], [side, side, 0], [side, -side, 0], [-side, -side, 0]]
    bodies = WORK / "real-tag.json"
    marker = {"id": TAG_ID, "corners": corners, "normal": [0, 0, 1]}
    (ROOT / bodies).write_text(json.dumps({"dictionary": "DICT_APRILTAG_36h11", "bodies": {"tag": {"markers": [marker]}}}))
    true = {row["frame"]: np.radians(float(row["angle_deg"])) for row in rows(folder / "truth_angle.csv")}
    poses, command = measured(folder / "lens.yaml", folder / "images", bodies, "real-tag", settings)
    if len(poses) < 3:
        return np.zeros((0, 2)), len(true), command
    turned = [(true[row["frame"]], matrix(numbers(row, ("mqw", "mqx", "mqy", "mqz"))), covariance(row)[3:, 3:])
              for row in poses]
    at, first, _ = turned[len(turned) // 2]
    axis = sum(turn(rotation @ first.T) * np.sign(angle - at) for angle, rotation, _ in turned)
    axis /= np.linalg.norm(axis)
    errors = np.array([turn(rotation @ first.T) @ axis - (angle - at) for angle, rotation, _ in turned])
    deviations = np.array([np.sqrt(axis @ stated @ axis) for *_, stated in turned])
    # One offset is free.
    errors -= np.median(errors)
    return np.column_stack([np.degrees(errors), errors / deviations]), len(true), command


def photographs(folder, dictionary):
    """Number of photographs, markers that ours finds, OpenCV's, and both."""
    command = ["experiment", "detectors", "--photographs", str(REAL / folder), "--dictionary", dictionary, "--json"]
    found = json.loads(call(command))["photographs"]
    both, ours, theirs = (sum(size[kind] for size in found["by_size"].values())
                          for kind in ("both", "ours_alone", "opencv_alone"))
    return found["photographs"], both + ours, both + theirs, both


def main():
    lines = ["**A board of 36 AprilTags before a 195-degree fisheye** (TUM-VI, a linear camera), six pictures at 0.7 to 1 m. NEES is "
             "3 where stated deviations are right.", "",
             "| told | poses | markers | median mm | worst mm | median degrees | NEES, position | NEES, rotation |",
             "| --- | --- | --- | --- | --- | --- | --- | --- |"]
    row, commands = "", []
    for told, settings in [("nothing", []), ("`response: linear`", ["camera.response=linear"]),
                           ("`lens_error_px: 0`", ["camera.lens_error_px=0"])]:
        found, count, command = board(settings)
        commands.append(command)
        position, rotation = found[:, 2].mean(), found[:, 3].mean()
        lines.append(f"| {told} | {len(found)} of {count} | {found[:, 4].sum():.0f} | {np.median(found[:, 0]):.2f} | "
                     f"{found[:, 0].max():.2f} | {np.median(found[:, 1]):.2f} | {position:.1f} | {rotation:.1f} |")
        false = np.count_nonzero((found[:, 0] > FALSE_MM) | (found[:, 1] > FALSE_DEG))
        row = row or (f"| real fisheye (TUM-VI), NEES {position:.1f}, {rotation:.1f}; 3 is right | lossless | "
                      f"{len(found)}/{count}, {np.median(found[:, 0]):.1f} mm |  |  |  | {false} |  |")
    lines += ["", "**One AprilTag on a turntable**, 15 pictures at 0.2 m, turned by -70 to 70 degrees. The pictures were rectified "
              "with a lens model that is off by 0.3 to 1 px. `real-tag.json` has marker 76 with a side of 65 mm.", "",
              "| told | poses | turn, median degrees | worst | rms in stated deviations |", "| --- | --- | --- | --- | --- |"]
    for told, settings in [("nothing", []), ("`lens_error_px: 1`", ["camera.lens_error_px=1"])]:
        found, count, command = turntable(settings)
        commands.append(command)
        sizes = np.abs(found) if len(found) else np.full((1, 2), np.nan)
        lines.append(f"| {told} | {len(found)} of {count} | {np.median(sizes[:, 0]):.2f} | {sizes[:, 0].max():.2f} | "
                     f"{np.sqrt((sizes[:, 1] ** 2).mean()):.1f} |")
    lines += ["", "**Photographs.** Markers found; OpenCV's are those of its own detector on the same pictures.", "",
              "| photographs | number | ours | OpenCV | both |", "| --- | --- | --- | --- | --- |"]
    for name, (folder, dictionary) in PHOTOGRAPHS.items():
        number, ours, theirs, both = photographs(folder, dictionary)
        lines.append(f"| {name} | {number} | {ours} | {theirs} | {both} |")
    print(json.dumps({"lines": lines, "row": row, "commands": commands}))


if __name__ == "__main__":
    main()
