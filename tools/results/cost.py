#!/usr/bin/env python3
"""What a frame costs as work grows: processor time of each stage, by neighbours and by resolution.

    cost.py FLOCKEYE_COMMAND [OUT.svg]

Simulated flights in the flow `lossless`, so that every frame is worked on however slow the machine
is, and each searches as many partitions. Prints Markdown; OUT.svg is drawn beside it. Processor time
is that of the stages' processes as Linux counts it, from frame 30 to the last.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

FRAMES = 150
WARM_UP = 30
STAGES = ["rectification", "detection", "fusion"]
TICK = os.sysconf("SC_CLK_TCK")


def children(pid):
    """Name and processor time, seconds, of each stage of a launcher."""
    found = {}
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    for child in listed:
        try:
            command = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")[0].decode()
            fields = Path(f"/proc/{child}/stat").read_text().rsplit(")", 1)[1].split()
        except (OSError, IndexError):
            continue
        stage = Path(command).name.removeprefix("flockeye-")
        found[stage] = found.get(stage, 0.0) + (int(fields[11]) + int(fields[12])) / TICK
    return found


def fly(flockeye, sets):
    """Milliseconds of each stage for a frame, and what was measured of the neighbours."""
    instance = f"cost{os.getpid()}"
    poses = Path(f"/tmp/{instance}.csv")
    settings = [f"instance={instance}", "gateway.enabled=false", f"simulator.frames={FRAMES}", *sets]
    command = [flockeye, "up", "--profile", "repeat", "--poses", str(poses)]
    command += [part for setting in settings for part in ("--set", setting)]
    launcher = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)

    def frames():
        try:
            with poses.open("rb") as file:
                file.seek(max(0, poses.stat().st_size - 4096))
                lines = file.read().decode(errors="replace").rsplit("\n", 1)[0].split("\n")
            return int(lines[-1].split(",", 1)[0]) + 1
        except (OSError, ValueError, IndexError):
            return 0

    begun = ended = None
    while launcher.poll() is None:
        now = frames()
        try:
            if now >= WARM_UP:
                used = children(launcher.pid)
                begun = begun or (now, used)
                if all(stage in used for stage in STAGES):
                    ended = (now, used)
        except OSError:
            pass
        time.sleep(0.05)
    errors = launcher.stderr.read()
    if launcher.returncode != 0 or begun is None or ended is None or ended[0] <= begun[0]:
        sys.exit(f"the flight with {sets[-3:]} did not end well:\n{errors}")
    measured = sum(",aligned," in line or ",decoded," in line for line in poses.open())
    poses.unlink()
    count = ended[0] - begun[0]
    cost = {stage: 1e3 * (ended[1][stage] - begun[1].get(stage, 0.0)) / count for stage in STAGES}
    return {**cost, "all": sum(cost.values()), "measured": measured / FRAMES}


def bodies(count):
    """Settings for so many bodies, with markers of their own each."""
    listed = [
        {"name": f"n{k:02}", "preset": "squares", "edge_m": 0.0625, "marker_m": 0.05, "first_id": 17 * k}
        for k in range(count)
    ]
    return [
        "bodies.dictionary=DICT_5X5_1000",
        f"bodies.list={json.dumps(listed)}",
        f"simulator.neighbours={count}",
    ]


def table(title, rows):
    print(f"| {title} | rectification | detection | fusion | all | neighbours measured in a frame |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, cost in rows:
        columns = [f"{cost[stage]:.1f}" for stage in [*STAGES, "all"]]
        print(f"| {name} | {' | '.join(columns)} | {cost['measured']:.1f} |", flush=True)


def plot(rows, out):
    """Stage by stage, one upon the other."""
    colours = {"rectification": "#4477aa", "detection": "#ccbb44", "fusion": "#aa3377"}
    width, height, left, bottom = 640, 360, 60, 50
    most_x, most_y = rows[-1][0], 1.1 * max(cost["all"] for _, cost in rows)
    x = lambda count: left + (width - left - 20) * count / most_x
    y = lambda ms: height - bottom - (height - bottom - 20) * ms / most_y
    parts = [f'<rect width="{width}" height="{height}" fill="white"/>']
    below = [0.0] * len(rows)
    for stage in STAGES:
        above = [b + cost[stage] for b, (_, cost) in zip(below, rows)]
        points = [f"{x(count):.1f},{y(ms):.1f}" for (count, _), ms in zip(rows, above)]
        points += [f"{x(count):.1f},{y(ms):.1f}" for (count, _), ms in reversed(list(zip(rows, below)))]
        parts.append(f'<polygon points="{" ".join(points)}" fill="{colours[stage]}"/>')
        below = above
    for k in range(5):
        ms = most_y * k / 4
        parts.append(f'<text x="{left - 8}" y="{y(ms) + 4:.1f}" text-anchor="end">{ms:.0f}</text>')
        parts.append(f'<path d="M{left} {y(ms):.1f}H{width - 20}" stroke="#0002"/>')
    for count, _ in rows:
        parts.append(f'<text x="{x(count):.1f}" y="{height - 30}" text-anchor="middle">{count}</text>')
    parts.append(f'<text x="{width / 2}" y="{height - 10}" text-anchor="middle">neighbours</text>')
    parts.append(f'<text x="{left}" y="14">processor time for a frame, ms</text>')
    for k, stage in enumerate(STAGES):
        parts.append(f'<rect x="{left + 20}" y="{30 + 20 * k}" width="12" height="12" fill="{colours[stage]}"/>')
        parts.append(f'<text x="{left + 38}" y="{41 + 20 * k}">{stage}</text>')
    Path(out).write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'font-family="sans-serif" font-size="13">{"".join(parts)}</svg>\n'
    )


def main():
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    flockeye = sys.argv[1]
    apart = "simulator.distance_m=[0.8, 3.0]"
    by_count = [(count, fly(flockeye, [*bodies(count), apart])) for count in [1, 2, 4, 8, 16]]
    table("neighbours", by_count)
    print()
    sizes = [(1920, 960), (3840, 1920), (5760, 2880)]
    near = "simulator.distance_m=[0.6, 1.0]"
    by_size = [
        (f"{w}x{h}", fly(flockeye, [*bodies(1), near, f"camera.width={w}", f"camera.height={h}"]))
        for w, h in sizes
    ]
    table("image", by_size)
    if len(sys.argv) > 2:
        plot(by_count, sys.argv[2])


if __name__ == "__main__":
    main()
