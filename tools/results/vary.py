#!/usr/bin/env python3
"""Varies photographs of markers: stripes of sun, tilts, sizes, exposures, noise and blur.

    target/python/bin/python tools/results/vary.py PHOTOGRAPHS OUT
    flockeye experiment detectors --photographs OUT/stripes-90 --dictionary DICT_6X6_250

Each variant becomes a folder below OUT. Light is changed in linear light, by a gamma of 2.2.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

ENDINGS = {".jpg", ".jpeg", ".png"}


def linear(picture):
    return (picture / 255.0) ** 2.2


def encoded(light):
    return np.round(255 * np.clip(light, 0, 1) ** (1 / 2.2)).astype(np.uint8)


def stripes(picture, dice, shade, width_px):
    """Stripes of sun in any direction, with `shade` of its light between them."""
    height, width = picture.shape[:2]
    y, x = np.mgrid[0:height, 0:width]
    across = dice.uniform(0, np.pi)
    at = (x * np.cos(across) + y * np.sin(across) + dice.uniform(0, width_px)) % width_px
    sun = cv2.GaussianBlur((at < width_px / 2).astype(np.float32), (0, 0), 1.5)
    return encoded(linear(picture) * (shade + (1 - shade) * sun)[..., None])


def tilted(picture, dice, degrees):
    """The photograph as a plane that is turned about any axis through its middle."""
    height, width = picture.shape[:2]
    focal, axis = 0.9 * width, dice.uniform(0, 2 * np.pi)
    turn, _ = cv2.Rodrigues(np.radians(degrees) * np.array([np.cos(axis), np.sin(axis), 0]))
    camera = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    plane = turn @ np.array([[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, 0]])
    plane[2, 2] += 1.25 * focal
    size = (width, height)
    grey = (linear(90),) * 3
    return encoded(cv2.warpPerspective(linear(picture), camera @ plane, size, borderValue=grey))


def smaller(picture, factor):
    small = cv2.resize(linear(picture), None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
    return encoded(small)


def variants(picture, dice):
    """Name and picture of each variant."""
    light = linear(picture)
    for width_px in (40, 90, 200):
        yield f"stripes-{width_px}", stripes(picture, dice, 0.25, width_px)
    yield "stripes-dark", stripes(picture, dice, 0.125, 150)
    for degrees in (50, 60, 65, 70):
        yield f"tilt-{degrees}", tilted(picture, dice, degrees)
    for factor in (2, 3, 4):
        yield f"small-{factor}", smaller(picture, factor)
    for stops in (1, 2, 3):
        yield f"bright-{stops}", encoded(cv2.GaussianBlur(light, (0, 0), 1) * 2**stops)
    yield "dark-4", encoded(light / 16 + dice.normal(0, 0.002, light.shape))
    yield "noise", encoded(light + dice.normal(0, 0.02, light.shape))
    yield "blur", encoded(cv2.GaussianBlur(light, (0, 0), 4))


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    source, out = map(Path, sys.argv[1:])
    files = sorted(file for file in source.iterdir() if file.suffix.lower() in ENDINGS)
    if not files:
        sys.exit(f"{source} holds no photograph. Cure: put .jpg, .jpeg or .png files in it.")
    dice = np.random.default_rng(5)
    for file in files:
        picture = cv2.imread(str(file))
        if picture is None:
            print(f"{file} cannot be read; it is left out", file=sys.stderr)
            continue
        for name, varied in variants(picture, dice):
            (out / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(out / name / f"{file.stem}.png"), varied)


if __name__ == "__main__":
    main()
