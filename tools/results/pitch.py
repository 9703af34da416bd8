#!/usr/bin/env python3
"""How wide markers come out on photographs of a printed grid, and whether stated deviations hold.

    flockeye experiment detectors --photographs FOLDER --dictionary DICT_6X6_250 --corners corners.csv
    target/python/bin/python tools/results/pitch.py corners.csv --columns 4 --rows 5 --side 3.75 --gap 0.5

The grid is OpenCV's GridBoard: ids count along rows from the top left. In each photograph a homography and the markers'
side are fitted to all corners, by least squares of what is seen. The side's ratio to the pitch is compared with the printed
one. Cubic terms of the picture stand for the lens. Residuals are compared with the stated deviations.
"""

import argparse
import csv
from collections import defaultdict

import numpy as np

LEAST_MARKERS = 8


def read(path):
    """For each engine and photograph the corners: {(id, corner): (x, y, sigma)}."""
    found = defaultdict(lambda: defaultdict(dict))
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            at = tuple(float(row[name]) for name in ("x", "y", "sigma_px"))
            found[row["engine"]][row["photograph"]][int(row["id"]), int(row["corner"])] = at
    return found


def board(keys, side, columns):
    """Places of corners on the board in pitches, where a marker's side is `side` pitches."""
    ids, corners = np.array(keys).T
    middle = np.stack([ids % columns, ids // columns], axis=1).astype(float)
    offset = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])[corners]
    return middle + side * offset


def project(unknowns, keys, columns, scale):
    side, homography, lens = unknowns[0], np.append(unknowns[1:9], 1).reshape(3, 3), unknowns[9:11]
    points = np.column_stack([board(keys, side, columns), np.ones(len(keys))]) @ homography.T
    points = points[:, :2] / points[:, 2:]
    squared = (points**2).sum(axis=1, keepdims=True)
    return scale * points * (1 + lens[0] * squared + lens[1] * squared**2)


def fit(corners, columns, ratio):
    """The side in pitches, and the residuals in pixels, by Gauss-Newton with numeric derivatives."""
    keys = sorted(corners)
    seen = np.array([corners[key][:2] for key in keys])
    middle, scale = seen.mean(axis=0), np.abs(seen - seen.mean(axis=0)).max()
    seen = seen - middle
    # A linear start.
    rows = []
    for (u, v), (x, y) in zip(board(keys, ratio, columns), seen / scale):
        rows += [[u, v, 1, 0, 0, 0, -x * u, -x * v, -x], [0, 0, 0, u, v, 1, -y * u, -y * v, -y]]
    homography = np.linalg.svd(np.array(rows))[2][-1]
    unknowns = np.concatenate([[ratio], homography[:8] / homography[8], [0.0, 0.0]])
    for _ in range(20):
        residuals = (seen - project(unknowns, keys, columns, scale)).ravel()
        jacobian = np.empty((len(residuals), len(unknowns)))
        for k in range(len(unknowns)):
            step = np.zeros(len(unknowns))
            step[k] = 1e-6
            ahead, behind = (project(unknowns + sign * step, keys, columns, scale) for sign in (1, -1))
            jacobian[:, k] = (ahead - behind).ravel() / 2e-6
        change = np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
        unknowns = unknowns + change
        if np.abs(change).max() < 1e-9:
            break
    residuals = (seen - project(unknowns, keys, columns, scale)).ravel()
    sigmas = np.repeat([corners[key][2] for key in keys], 2)
    return unknowns[0], residuals * np.sqrt(len(residuals) / (len(residuals) - len(unknowns))), sigmas


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("corners")
    for name, of in (("columns", int), ("rows", int), ("side", float), ("gap", float)):
        parser.add_argument(f"--{name}", type=of, required=True)
    arguments = parser.parse_args()
    ratio = arguments.side / (arguments.side + arguments.gap)
    count = arguments.columns * arguments.rows
    print("engine  photographs  side over pitch, % off: median  95 % of photographs  residual px  residuals beyond 2 and 3 sigma")
    for engine, photographs in sorted(read(arguments.corners).items()):
        sides, all_residuals, all_sigmas = [], [], []
        for corners in photographs.values():
            corners = {key: at for key, at in corners.items() if key[0] < count}
            if len(corners) < 4 * LEAST_MARKERS:
                continue
            side, residuals, sigmas = fit(corners, arguments.columns, ratio)
            sides.append(100 * (side / ratio - 1))
            all_residuals.append(residuals)
            all_sigmas.append(sigmas)
        if not sides:
            print(f"{engine}: no photograph with {LEAST_MARKERS} markers of the grid")
            continue
        residuals, sigmas = np.concatenate(all_residuals), np.concatenate(all_sigmas)
        beyond = [100 * np.mean(np.abs(residuals) > times * sigmas) for times in (2, 3)]
        print(f"{engine:7} {len(sides):11}  {np.median(sides):+30.2f}  {np.percentile(np.abs(sides), 95):20.2f}"
              f"  {np.median(np.abs(residuals)) / 0.6745:11.3f}  {beyond[0]:.1f} % and {beyond[1]:.1f} %")


if __name__ == "__main__":
    main()
