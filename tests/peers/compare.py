#!/usr/bin/env python3
"""Flockeye beside the paper's method in Python, on one recording with truth and one machine.

    compare.py FLOCKEYE_COMMAND RECORDING_FOLDER

The folder holds NAME.mp4 and truth.csv, the one above it bodies.json. Both work on every frame, one
after the other; what is compared is processor time, decoding included, and what came of it.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def run(command, **more):
    """Runs a command; its standard output, processor time and duration, seconds."""
    def used():
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
        return children.ru_utime + children.ru_stime

    before, start = used(), time.monotonic()
    done = subprocess.run(command, check=True, capture_output=True, text=True, **more)
    return done.stdout, used() - before, time.monotonic() - start


def evaluate(flockeye, poses, truth):
    """`flockeye eval` of recorded poses."""
    output, _, _ = run([flockeye, "eval", "--poses", poses, "--truth", truth, "--json"])
    return json.loads(output)


def row(name, evaluation, processor_s, duration_s):
    """What one of them came to."""
    near = next(part for part in evaluation["bins"] if (part["from_m"], part["to_m"]) == (0.0, 1.5))
    error = near["published"]["position_mm"]
    return {
        "name": name,
        "localizations": near["measured"],
        "eligible": near["eligible"],
        "median_mm": error["median"],
        "mean_mm": error["mean"],
        "processor_ms": 1e3 * processor_s / max(1, near["measured"]),
        "per_s": near["measured"] / duration_s,
    }


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    flockeye, folder = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
    video, truth, bodies = next(folder.glob("*.mp4")), folder / "truth.csv", folder.parent / "bodies.json"
    peer = Path(__file__).with_name("paper.py")
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        poses = os.path.join(scratch, "poses.csv")
        for search in ["optimized", "exhaustive"]:
            _, processor_s, duration_s = run(
                [sys.executable, peer, "--source", video, "--bodies", bodies, "--poses", poses,
                 "--search", search])
            name = f"Python, {search}"
            rows.append(row(name, evaluate(flockeye, poses, truth), processor_s, duration_s))
        _, processor_s, duration_s = run(
            [flockeye, "up", "--source", video, "--bodies", bodies, "--profile", "repeat",
             "--set", f"instance=peer-{os.getpid()}", "--poses", poses], cwd=scratch)
        rows.append(row("Flockeye", evaluate(flockeye, poses, truth), processor_s, duration_s))
    print("within 1.5 m          localized  of eligible  median mm   mean mm  CPU ms each  each s")
    for each in rows:
        print(f"{each['name']:<22}{each['localizations']:>9}{each['eligible']:>13}{each['median_mm']:>11.2f}"
              f"{each['mean_mm']:>10.2f}{each['processor_ms']:>13.1f}{each['per_s']:>8.1f}")
    ours = rows[-1]
    for peer_row in rows[:-1]:
        print(f"Flockeye against {peer_row['name']}: "
              f"{ours['localizations'] / max(1, peer_row['localizations']):.2f} times the localizations, "
              f"{ours['median_mm'] / peer_row['median_mm']:.3f} of the median error, "
              f"{ours['processor_ms'] / peer_row['processor_ms']:.2f} of the processor time for each, "
              f"{ours['per_s'] / peer_row['per_s']:.2f} times as many a second")


if __name__ == "__main__":
    main()
