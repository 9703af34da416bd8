#!/usr/bin/env python3
"""Flies recordings and simulated flights with one build and writes docs/results.

    make results                            every part, with target/release/flockeye
    make results PARTS="flight1 far"        these parts; the others keep their tables
    tools/results/results.py --list         what parts there are
    tools/results/results.py --render       the tables anew from docs/results/results.json

The variable FLOCKEYE names another build, and JOBS says how many lossless simulated flights are
flown at a time. Recordings are read from the folder FLOCKEYE_DATA (or --data; left out:
../shared/data); a part whose recording is absent is left out, and says so. Python's standard
library is enough, but for the part codings.

Each run becomes an entry of docs/results/results.json. The tables of docs/results and the short
table of README.md are written from that file, so nobody types a figure.
"""

import argparse
import csv
import json
import math
import os
import re
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STORE = ROOT / "docs/results/results.json"
WORK = Path("target/results")
DATA = "../shared/data"
JOBS = max(1, int(os.environ.get("JOBS") or 1))
RESULTS_MARKS = ("<!-- results: written by make results -->", "<!-- end of results -->")
BINS = [(0.0, 1.5), (1.5, 2.2), (2.2, 3.0), (3.0, 4.0)]


def quiet(instance):
    """Settings of a flight that nobody else is to hear."""
    return ["--set", "gateway.enabled=false", "--set", f"instance={instance}"]


QUIET = quiet("results")
WAYS = {
    "lossless": "every frame, `--profile repeat`, in the time that flight has by stated costs",
    "real time": "the camera's own rate, `--profile flight`",
}

# Name: what it is, the recording below the data folder, settings, and the ways it is flown.
RECORDINGS = {
    "flight1": ("rendered flight `flight1`, 300 frames", "flight1/flight1.mp4", "flight1/truth.csv",
                [], ["lossless", "real time"]),
    "flight4": ("rendered flight `flight4` in wind, 120 frames", "flight4/flight4.mp4",
                "flight4/truth.csv", [], ["lossless", "real time"]),
    "flight3": ("rendered flight `flight3` in strong wind, 150 frames", "flight3/flight3.mp4",
                "flight3/truth.csv", [], ["lossless", "real time"]),
    "flight4-sensor": ("`flight4` with its inertial sensor", "flight4/flight4.mp4", "flight4/truth.csv",
                       ["inertial.source={data}/flight4/imu.csv"], ["lossless", "real time"]),
    "stills": ("20 rendered stills, each for itself", "stills/images", "stills/truth.csv",
               ["profile=stills"], ["lossless"]),
}
# In gusts the simulator takes several frames' time to draw one: not in real time.
GUSTS = ["simulator.tilt_deg=15", "simulator.yaw_deg_s=30", "simulator.yaw_swing_deg_s=60",
         "simulator.exposure_ms=10", "simulator.distance_m=[0.8,2.6]"]
SIMULATED = {
    "near": ("simulated flights at 0.6 to 2 m", [], range(2001, 2009), 300, list(WAYS)),
    "far": ("simulated flights at 0.6 to 4 m", ["simulator.distance_m=[0.6,4.0]"],
            range(2001, 2009), 300, list(WAYS)),
    "gusts": ("simulated flights in gusts at 0.8 to 2.6 m, 10 ms exposures", GUSTS,
              range(2001, 2021), 100, ["lossless"]),
    "gusts-sensor": ("simulated flights in gusts with an inertial sensor", [*GUSTS, "inertial.source=sim"],
                     range(2001, 2006), 100, ["lossless"]),
}
# The conditions of `flight3`: strong wind, fast neighbours, a low sun from one side, 10 ms exposures, H.264.
WIND = ["simulator.tilt_deg=17", "simulator.yaw_deg_s=30", "simulator.yaw_swing_deg_s=90",
        "simulator.exposure_ms=10", "simulator.distance_m=[0.88,2.6]", "simulator.speed_m_s=2.4",
        "simulator.sun.ratio=4"]
SIMULATED["wind"] = ("simulated flights of fast neighbours in strong wind and a low sun at 0.9 to 2.6 m, H.264",
                     WIND, range(2201, 2213), 150, list(WAYS))
SIMULATED["minutes"] = ("ten minutes of fast neighbours in strong wind and a low sun, H.264",
                        WIND, range(3101, 3221), 150, ["real time"])
# Drawn as videos first, which are flown as recordings.
FILMED = ["wind", "minutes"]
# In the wrong light: single images, half a second apart, and flights.
for name, stops, words in (("bright", 3, "3 stops too much"), ("dark", -4, "4 stops too little")):
    light = f"simulator.exposure_stops={stops}"
    SIMULATED[name] = (f"single images exposed by {words}",
                       ["profile=stills", light, "simulator.distance_m=[0.6,4.0]",
                        "simulator.frames_per_second=2"], range(2101, 2111), 25, ["lossless"])
    SIMULATED[f"{name}flight"] = (f"flights exposed by {words}", [light, "simulator.distance_m=[0.8,2.6]"],
                                  range(2101, 2107), 60, ["lossless"])
SIMULATED["sunflight"] = ("flights in a sun 6 times as bright as its shadows, in stripes of 5 cm",
                          ["simulator.sun.ratio=6", "simulator.sun.stripes_m=0.05", "simulator.distance_m=[0.8,2.6]"],
                          range(2101, 2107), 60, ["lossless"])
SIMULATED["swingflight"] = ("flights whose auto-exposure swings by 2 stops either way",
                            ["simulator.exposure_swing_stops=2", "simulator.distance_m=[0.8,2.6]"],
                            range(2101, 2107), 90, ["lossless"])
# How often a pose is false can only be counted in many.
SIMULATED["hour"] = ("an hour of flights whose auto-exposure swings by 2 stops either way",
                     ["simulator.exposure_swing_stops=2", "simulator.distance_m=[0.6,4.0]"],
                     range(3001, 3025), 4500, ["lossless"])
# Commands whose own words are kept: title, arguments, and which lines.
EXPERIMENTS = {
    "consistency": ("Consistency of covariances", ["experiment", "consistency", "--runs", "50"], ""),
    "search": ("The paper's Table II: searches", ["experiment", "search"], ""),
    "partitions": ("The paper's Table I: partitions", ["experiment", "partitions"], ""),
    "cadence": ("How often a part of the sphere is searched", ["check", "--measure", "20s", *QUIET],
                "search |measured "),
}
# Simulated swarms: title, arguments of `flockeye swarm sim`.
SWARMS = {
    "ring": ("Three drones that see each other, in calm air", ["--drones", "3", "--for", "60s"]),
    "gusty": ("Two drones in gusts",
              ["--drones", "2", "--rate", "12", "--for", "60s", "--set", "simulator.tilt_deg=8",
               "--set", "simulator.yaw_swing_deg_s=20", "--set", "simulator.distance_m=[0.7, 1.0]"]),
    "chain": ("Six drones, of which each sees two",
              ["--drones", "6", "--rate", "4", "--size", "800x400", "--for", "60s",
               "--set", "simulator.distance_m=[0.6, 0.65]"]),
}
# Observers that hear each other through one router: title, arguments of `peer-load`.
LOADS = {"peers": ("Observers on one machine, each hearing all others 30 times a second", ["10"])}
# How soon two drones hear each other again after their radio was cut: title, arguments of `radio-cuts`.
CUTS = {"cuts": ("A radio that is cut", ["20", "30"])}
# What the view and a recorder take from the default pipeline: title, arguments of `onlookers`.
ONLOOKERS = {"onlookers": ("Onlookers of the default pipeline, 30 s each", ["30"])}
# A flight whose rotations are compared with the recording's gyroscope: title, recording, gyroscope.
ROTATIONS = {"gyroscope": ("The visual gyroscope", "flight4/flight4.mp4", "flight4/imu.csv")}
# Benchmarks whose words are kept: what the virtual clock of lossless runs goes by.
# In the profile of the tests, whose computing crates are optimized like the release profile's.
# Built as the tests are, so that nothing is compiled twice.
BENCH = ["cargo", "bench", "--locked", "--profile", "tested", "--workspace", "--features",
         "flockeye-launcher/fault-points", "--bench"]
BENCHES = {"proposals": "Proposals", "costs": "Costs", "decisions": "Decisions about poses",
           "places": "Bodies of which only a rough place is known"}
# Disturbances of a running pipeline: title, what of `flockeye chaos`, how many (another number: COUNT=200).
SWAPPED = "detection,detection.1,rectification,egomotion,fusion"
DISTURBED = {
    "kills": ("SIGKILL to stages at random", ["--only", "kill"], 1000),
    "kills-long": ("SIGKILL to stages at random, for hours", ["--only", "kill"], 10000),
    "swaps": ("Swaps of stages at random", ["--only", "swap", "--workers", SWAPPED], 500),
}
# Flights in which one of two detection workers does not do its work: title, what is wrong with it, flights of each.
FAULTY = {"workers": ("One of two detection workers does not do its work",
                      ["mute", "hold", "spin", "hang", "stopped"], 3)}
# A recording that is flown in real time while it is recorded, in each of these ways.
RECORDED = {"recorder": ("The recorder beside a flight of 3840x1920, in real time or as fast as the machine decodes", "flight1/flight1.mp4",
                         ["none", "camera", "every 30", "views"])}
# How soon the first frame has passed through all stages, and what the pipeline takes with nobody in sight and with one neighbour: title, flights.
STARTS = {"start": ("From `flockeye up` to the first frame's end, and what the default pipeline takes", 10)}
# What the coding of pictures asks of covariances: title, program.
CODINGS = {"codings": ("Pictures that are coded in different ways", "tools/results/codings.py")}
# Real pictures with truth: title, program.
REAL = {"real": ("Real pictures with truth", "tools/results/real.py")}
# These take long, so they are flown by their names alone.
LONG = ["kills-long", "cuts", "hour", "minutes", "codings"]
PARTS = [*REAL, *RECORDINGS, *SIMULATED, *EXPERIMENTS, *SWARMS, *LOADS, *CUTS, *ONLOOKERS, *ROTATIONS, *BENCHES, *DISTURBED, *FAULTY, *RECORDED, *STARTS, *CODINGS]


def flockeye():
    """The program to fly with, as a path relative to the repository where it lies there."""
    program = Path(os.environ.get("FLOCKEYE", "target/release/flockeye"))
    if not (ROOT / program).exists():
        sys.exit(f"results: {program} does not exist. Cure: make build, or set FLOCKEYE")
    return program


def machine():
    """Cores, processor and clock, and how busy the machine was."""
    text = Path("/proc/cpuinfo").read_text()
    clocks = [float(mhz) for mhz in re.findall(r"cpu MHz\s*: ([\d.]+)", text)]
    model = re.search(r"model name\s*: (.+)", text)
    return {
        "cores": os.cpu_count(),
        "processor": model.group(1).strip() if model else "unknown",
        "mhz": round(max(clocks)) if clocks else None,
        "load": round(os.getloadavg()[0], 1),
        # In the words of whoever measures, where it was not alone.
        "beside": os.environ.get("BESIDE"),
    }


def run(arguments, may_fail=False):
    """Runs flockeye in the repository's root. An experiment that does not pass says so, and fails."""
    done = subprocess.run([str(flockeye()), *arguments], cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0 and not (may_fail and done.stdout.strip()):
        sys.exit(f"results: {shown(arguments)} ended with {done.returncode}:\n{done.stderr}")
    return done


def call(arguments, may_fail=False):
    """The same; gives what it wrote to standard output."""
    return run(arguments, may_fail).stdout


def shown(arguments):
    """A command as one would type it, wherever the recordings lie."""
    arguments = [word.replace(os.environ.get("FLOCKEYE_DATA") or DATA, "$FLOCKEYE_DATA") for word in arguments]
    quote = lambda word: f"'{word}'" if re.search(r"[\[\] ]", word) else word
    return " ".join(["flockeye", *map(quote, arguments)])


def rows(path):
    with open(ROOT / path, newline="") as file:
        return list(csv.DictReader(file))


def pooled(flights, name):
    """Poses, truth and rotations of several flights as one, with frames numbered apart. Films have no rotations."""
    paths = []
    tables = [table for table, path in zip(("poses", "truth", "rotations"), flights[0]) if path is not None]
    for kind, table in enumerate(tables):
        path = WORK / f"{name}-{table}.csv"
        with open(ROOT / path, "w", newline="") as file:
            writer = None
            for number, flight in enumerate(flights):
                for row in rows(flight[kind]):
                    row["frame"] = int(row["frame"]) + number * 1_000_000
                    if writer is None:
                        writer = csv.DictWriter(file, row.keys())
                        writer.writeheader()
                    writer.writerow(row)
        paths.append(path)
    return paths


def errors_mm(poses, truth):
    """Distance and position error of each eligible body's own measurement, of the same bodies as
    `flockeye eval` counts. Mounts must be the default."""
    measured = {(row["target"], int(row["frame"])): row for row in poses
                if row["measured_by"] != "nothing"}
    found = []
    for row in truth:
        pose = measured.get((row["body"], int(row["frame"])))
        if pose and int(row["localisable"]) == 1 and int(row["n_markers_vis90"]) >= 2:
            error = math.dist([float(pose[k]) for k in ("mx", "my", "mz")],
                              [float(row[k]) for k in "xyz"])
            found.append((float(row["dist_m"]), 1e3 * error))
    return found


def frames_until_found(poses, truth):
    """For each time that a body without a track can be found (eligible, within 2.2 m, blurred by less than
    4 px): in how many such frames it was not measured before it was. Flights are numbered apart."""
    known = {(row["target"], int(row["frame"])) for row in poses if row["state"] != "lost"}
    measured = {(row["target"], int(row["frame"])) for row in poses
                if row["measured_by"] != "nothing"}
    bodies = {}
    for row in truth:
        frame = int(row["frame"])
        bodies.setdefault((row["body"], frame // 1_000_000), []).append((frame, row))
    waits = []
    for (body, _), frames in bodies.items():
        is_lost, waited = True, None
        for frame, row in sorted(frames, key=lambda of: of[0]):
            can_be_found = (int(row["localisable"]) == 1 and int(row["n_markers_vis90"]) >= 2
                            and float(row["dist_m"]) < 2.2 and float(row["blur_px"]) < 4)
            if (body, frame) in measured:
                if is_lost and (can_be_found or waited is not None):
                    waits.append(waited or 0)
                is_lost, waited = False, None
                continue
            is_lost |= (body, frame) not in known
            if is_lost and can_be_found:
                waited = (waited or 0) + 1
        if waited is not None:
            waits.append(waited)
    if not waits:
        return None
    return {"times": len(waits), "median": quantile(waits, 0.5), "p95": quantile(waits, 0.95),
            "worst": max(waits)}


def quantile(values, share):
    """Nearest rank, as `flockeye eval` counts."""
    values = sorted(values)
    return values[max(math.ceil(share * len(values)), 1) - 1]


def evaluated(poses, truth, rotations=None):
    """What `flockeye eval` says, with the 99 % quantile and the false poses of each bin."""
    # Single images have none.
    turned = ["--rotations", str(rotations)] if rotations and (ROOT / rotations).stat().st_size else []
    said = json.loads(call(["eval", "--poses", str(poses), "--truth", str(truth), *turned, "--json"]))
    truth_rows = rows(truth)
    errors = errors_mm(rows(poses), truth_rows)
    distances = {(row["body"], int(row["frame"])): float(row["dist_m"]) for row in truth_rows}
    bins = []
    for low, high in BINS:
        bin = next(b for b in said["bins"] if (b["from_m"], b["to_m"]) == (low, high))
        inside = [error for distance, error in errors if low <= distance < high]
        of = bin["measurement"]
        if len(inside) != bin["measured"]:
            sys.exit(f"results: {len(inside)} errors where eval has {bin['measured']}")
        false = sum(low <= distances.get((f["target"], f["frame"]), -1.0) < high
                    for f in said["false_at"])
        bins.append({
            "from_m": low, "to_m": high,
            "eligible": bin["eligible"], "measured": bin["measured"], "false": false,
            "median_mm": of and of["position_mm"]["median"],
            "p95_mm": of and of["position_mm"]["p95"],
            "p99_mm": quantile(inside, 0.99) if inside else None,
            "rotation_deg": of and of["rotation_deg"]["median"],
        })
    nees = said["nees"]["measurements"]
    return {"bins": bins, "false": said["false_poses"], "latency": said["latency"],
            "measured": said["measured"], "nees": nees, "predictions": said["predictions"],
            "rotations": said.get("rotations"), "found": frames_until_found(rows(poses), truth_rows)}


def flight_command(arguments, way, name, truth, instance="results"):
    """The command of one flight, and where it writes its poses, its truth and, if it is simulated, its rotations."""
    poses = WORK / f"{name}.csv"
    # A profile among the settings of the flight takes precedence.
    chosen = any(argument.startswith("profile=") for argument in arguments)
    profile = [] if chosen else ["--profile", "repeat" if way == "lossless" else "flight"]
    command = ["up", *arguments, *profile, *quiet(instance), "--poses", str(poses)]
    rotations = None
    if truth is None:
        truth, rotations = (WORK / f"{name}-{table}.csv" for table in ("truth", "rotations"))
        command += ["--truth", str(truth), "--rotations", str(rotations)]
    return command, poses, truth, rotations


def fly(*flight):
    """Flies one; gives its command and files, and how many frames were searched and skipped."""
    command, *files = flight_command(*flight)
    print(f"  {shown(command)}", file=sys.stderr, flush=True)
    done = run(command)
    counted = re.search(r"(\d+) frames searched, (\d+) skipped", done.stdout)
    if not counted:
        sys.exit(f"results: {shown(command)} does not say how many frames it searched")
    late = [line for line in done.stderr.splitlines() if re.search("not waited for any more|not ended in time", line)]
    if late and "flight" not in command:
        # Then its poses depend on how busy the machine is.
        sys.exit(f"results: {shown(command)} gave somebody up:\n{late[0]}\nCure: fewer JOBS, or a less busy machine")
    return command, *files, [int(number) for number in counted.groups()]


def film_command(arguments, part, seed):
    """The command that draws a simulated flight as a video, and where it writes this and its truth."""
    video, truth = (WORK / f"{part}-{seed}{end}" for end in (".mp4", "-truth.csv"))
    return ["film", *arguments, "--out", str(video), "--truth", str(truth)], video, truth


def draw_films(arguments, part, seeds):
    """Draws the flights of a part, JOBS at a time, but not those that the same simulator has drawn."""
    simulator = (ROOT / flockeye()).with_name("flockeye-lab").stat().st_mtime
    def draw(seed):
        command, video, _ = film_command(arguments + ["--set", f"simulator.seed={seed}"], part, seed)
        drawn, by = ROOT / video.with_suffix(".drawn"), f"{shown(command)}\n{simulator}\n"
        if not drawn.exists() or drawn.read_text() != by:
            print(f"  {shown(command)}", file=sys.stderr, flush=True)
            run(command)
            drawn.write_text(by)
    with ThreadPoolExecutor(JOBS) as pool:
        list(pool.map(draw, seeds))


def benched(part):
    """What one benchmark says."""
    before = machine()
    command = [*BENCH, part]
    print(f"  {' '.join(command)}", file=sys.stderr, flush=True)
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"results: {' '.join(command)} ended with {done.returncode}:\n{done.stderr}")
    entry = {"title": BENCHES[part], "command": " ".join(command), "machine": before}
    if part == "costs":
        rows = re.findall(r"\| `(\w+)` \| ([\d.]+) \| ([\d.]+) \|", done.stdout)
        return entry | {"costs": rows}
    return entry | {"output": done.stdout.strip().splitlines()}


def disturbed(part):
    """How a simulated flight takes its disturbances, in the words of `flockeye chaos`."""
    title, what, count = DISTURBED[part]
    count = os.environ.get("COUNT", str(count))
    before = machine()
    flight, chaos = ["up", *QUIET], ["chaos", "--instance", "results", "--for", "24h", "--rate", "2",
                                     "--count", count, *what]
    print(f"  {shown(flight)}\n  {shown(chaos)}", file=sys.stderr, flush=True)
    up = subprocess.Popen([str(flockeye()), *flight], cwd=ROOT, stdout=subprocess.DEVNULL,
                          stderr=subprocess.DEVNULL)
    time.sleep(8)
    done = subprocess.run([str(flockeye()), *chaos], cwd=ROOT, capture_output=True, text=True)
    call(["stop", "--instance", "results"])
    up.wait()
    # Each disturbance has a line of its own, and then comes the table.
    lines = [line for line in done.stdout.splitlines() if "until the next pose" not in line]
    if not lines:
        sys.exit(f"results: {shown(chaos)} ended with {done.returncode}:\n{done.stderr}")
    broken = [line.removeprefix("flockeye: ") for line in done.stderr.splitlines()]
    return {part: {"title": title, "command": f"{shown(flight)}\n{shown(chaos)}", "machine": before,
                   "output": lines + broken}}


def with_second_worker(fault):
    """The setting by which detection worker 1 has a fault, and worker 0 is Flockeye's own."""
    own, bad = (flockeye().with_name(name) for name in ("flockeye-detection", "silent-detector"))
    # Stopped two seconds after each start: until then it works.
    second = f"(sleep 2; kill -STOP $$) & exec {ROOT / own}" if fault == "stopped" else f"exec {ROOT / bad} {fault}"
    script = f"if [ $FLOCKEYE_REPLICA = 1 ]; then {second}; else exec {ROOT / own}; fi"
    return f'stages.detection.command=[sh, -c, "{script}"]'


def processor_s(command):
    """Processor time of a command and of those that it waited for, seconds."""
    before = os.times()
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"results: {shown(command[1:])} ended with {done.returncode}:\n{done.stderr}")
    after = os.times()
    own = sum(getattr(after, kind) - getattr(before, kind) for kind in ("children_user", "children_system"))
    return own, done.stdout


def recorded(part, data):
    """What share of a processor the recorder takes. Its start is left out: two recordings of different length are
    compared."""
    title, recording, choices = RECORDED[part]
    if not (ROOT / data / recording).exists():
        print(f"results: {part} is left out: {data / recording} is absent", file=sys.stderr)
        return {}
    before, short_s, long_s = machine(), 5, 25
    flight = ["up", "--source", str(data / recording), "--bodies", str(data / "bodies.json"), "--set",
              "source.at_end=loop", *QUIET]
    print(f"  {shown(flight)}", file=sys.stderr, flush=True)
    up = subprocess.Popen([str(flockeye()), *flight], cwd=ROOT, stdout=subprocess.DEVNULL,
                          stderr=subprocess.DEVNULL)
    time.sleep(8)
    lines = [f"{'--frames':<10} {'of one processor':>16} {'MB/s':>8}"]
    for choice in choices:
        seconds, sizes = [], []
        for length_s in (short_s, long_s):
            out = ROOT / WORK / "recorder.mcap"
            out.unlink(missing_ok=True)
            record = ["record", str(out), "--frames", choice, "--for", f"{length_s}s", "--instance", "results"]
            seconds.append(processor_s([str(flockeye()), *record])[0])
            sizes.append(out.stat().st_size)
            out.unlink()
        length_s = long_s - short_s
        share = 100 * (seconds[1] - seconds[0]) / length_s
        lines.append(f"{choice:<10} {share:14.1f} % {(sizes[1] - sizes[0]) / length_s / 1e6:8.2f}")
    call(["stop", "--instance", "results"])
    up.wait()
    return {part: {"title": title, "command": f"{shown(flight)}\nflockeye record OUT.mcap --frames CHOICE --for {long_s}s",
                   "machine": before, "output": lines}}


def first_frame_s():
    """Seconds from the command to the end of a pipeline of one frame."""
    flight = ["up", "--frames", "1", *QUIET]
    since = time.monotonic()
    call(flight)
    return time.monotonic() - since


def taken(name, settings):
    """What the processes of a running pipeline take: of processors, and of memory that is theirs alone, MB."""
    up = subprocess.Popen([str(flockeye()), "up", *QUIET, *settings, "--set", f"instance={name}"], cwd=ROOT,
                          stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(10)
    before, since = family(up.pid), time.monotonic()
    time.sleep(20)
    after, length_s = family(up.pid), time.monotonic() - since
    call(["stop", "--instance", name])
    up.wait()
    processors = sum(after[pid][0] - before[pid][0] for pid in after if pid in before) / length_s
    return processors, sum(private for _, private in after.values())


def family(pid):
    """Processor seconds and private memory, MB, of a process and its children, by their numbers."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    found = {}
    for each in [str(pid), *children]:
        stat = Path(f"/proc/{each}/stat").read_text().rpartition(")")[2].split()
        rollup = Path(f"/proc/{each}/smaps_rollup").read_text()
        private_kb = sum(int(kb) for kb in re.findall(r"^Private_\w+: +(\d+) kB", rollup, re.M))
        found[each] = (sum(map(int, stat[11:13])) / os.sysconf("SC_CLK_TCK"), private_kb / 1024)
    return found


def started(part):
    """How soon the first frame has passed through all stages, and what the pipeline takes."""
    title, count = STARTS[part]
    before = machine()
    flight = ["up", "--frames", "1", *QUIET]
    print(f"  {shown(flight)}", file=sys.stderr, flush=True)
    times_s = sorted(first_frame_s() for _ in range(count))
    lines = [f"from the command to the end of the first frame and of all processes: median {times_s[count // 2]:.2f} s, "
             f"worst of {count} {times_s[-1]:.2f} s", "", f"{'in sight':<14} {'processors':>10} {'memory':>10}"]
    for words, settings in (("nobody", ["--set", "simulator.neighbours=0"]), ("one neighbour", [])):
        processors, memory_mb = taken("results", settings)
        lines.append(f"{words:<14} {processors:10.2f} {memory_mb:7.0f} MB")
    lines.append("The simulated camera's process is among them.")
    return {part: {"title": title, "command": shown(flight), "machine": before, "output": lines}}


def faulty(part):
    """How many poses are left of a simulated flight while one of two workers has a fault."""
    title, faults, count = FAULTY[part]
    count = int(os.environ.get("COUNT", count))
    before, poses = machine(), WORK / f"{part}.csv"
    flight = ["up", "--for", "20s", *QUIET, "--poses", str(poses)]
    found = {}
    for fault in [None, *faults]:
        settings = ["--set", with_second_worker(fault)] if fault else []
        print(f"  {fault or 'undisturbed'}: {shown(flight)}", file=sys.stderr, flush=True)
        found[fault] = []
        for _ in range(count):
            call([*flight, *settings])
            measured = [row for row in rows(poses) if row["measured_by"] != "nothing"]
            # The first second is start-up.
            found[fault].append(sum(int(row["frame"]) >= 30 for row in measured))
    undisturbed = sorted(found.pop(None))
    median = undisturbed[len(undisturbed) // 2]
    lines = [f"{'worker 1':<12} poses after the first second, of each flight    share of the median undisturbed"]
    lines.append(f"{'undisturbed':<12} {' '.join(map(str, undisturbed))}")
    for fault, counts in found.items():
        share = 100 * sorted(counts)[len(counts) // 2] / median
        lines.append(f"{fault:<12} {' '.join(map(str, sorted(counts))):<48} {share:.1f} %")
    # The program of worker 1 is a test's: no command of `flockeye` alone prints this.
    return {part: {"title": title, "command": f"make results PARTS={part}", "machine": before, "output": lines}}


def turned(part, data):
    """The rotations of a recording beside its gyroscope, in the words of `flockeye eval`."""
    title, recording, gyroscope = ROTATIONS[part]
    if not (ROOT / data / recording).exists():
        print(f"results: {part} is left out: {data / recording} is absent", file=sys.stderr)
        return {}
    before, rotations = machine(), WORK / f"{part}-rotations.csv"
    flight = ["up", "--source", str(data / recording), "--bodies", str(data / "bodies.json"),
              "--profile", "repeat", *QUIET, "--rotations", str(rotations)]
    judged = ["eval", "--rotations", str(rotations), "--gyro", str(data / gyroscope)]
    print(f"  {shown(flight)}", file=sys.stderr, flush=True)
    call(flight)
    return {part: {"title": title, "command": f"{shown(flight)}\n{shown(judged)}",
                   "machine": before, "output": call(judged).strip().splitlines()}}


def counted(name, title, arguments, first):
    """What a program of the tests counts: its output from the line that begins so."""
    before, program = machine(), str(flockeye().with_name(name))
    print(f"  {program} {' '.join(arguments)}", file=sys.stderr, flush=True)
    done = subprocess.run([program, *arguments], cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"results: {program} ended with {done.returncode}:\n{done.stderr}")
    lines = done.stdout.splitlines()
    lines = lines[next(at for at, line in enumerate(lines) if line.startswith(first)):]
    return {"title": title, "command": " ".join([name, *arguments]), "machine": before, "output": lines}


def told_by(part, title, program):
    """The entry of a Python program of its own, and what it writes."""
    python, before = ROOT / "target/python/bin/python", machine()
    if not python.exists():
        sys.exit(f"results: {part} needs {python.relative_to(ROOT)}. Cure: make python")
    done = subprocess.run([python, ROOT / program], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    if done.returncode != 0:
        sys.exit(f"results: {program} ended with {done.returncode}")
    return {"title": title, "command": f"make results PARTS={part}", "machine": before}, done.stdout.strip()


def recoded(part):
    """What each coding of the same pictures asks of covariances."""
    entry, output = told_by(part, *CODINGS[part])
    return {part: entry | {"output": output.splitlines()}}


def photographed(part, data):
    """What real pictures with truth show."""
    if not (ROOT / data / "real").exists():
        print(f"results: {part} is left out: {data / 'real'} is absent", file=sys.stderr)
        return {}
    entry, output = told_by(part, *REAL[part])
    return {part: entry | json.loads(output)}


def run_part(part, data, wanted_ways):
    """The entries of one part, by their names."""
    if part in REAL:
        return photographed(part, data)
    if part in CODINGS:
        return recoded(part)
    if part in LOADS:
        return {part: counted("peer-load", *LOADS[part], "a report of")}
    if part in CUTS:
        return {part: counted("radio-cuts", *CUTS[part], "radio after")}
    if part in ONLOOKERS:
        return {part: counted("onlookers", *ONLOOKERS[part], "beside the pipeline")}
    if part in SWARMS:
        title, arguments = SWARMS[part]
        arguments = ["swarm", "sim", *arguments]
        print(f"  {shown(arguments)}", file=sys.stderr, flush=True)
        before = machine()
        lines = call(arguments).splitlines()
        lines = lines[next(at for at, line in enumerate(lines) if line.startswith("known")):]
        return {part: {"title": title, "command": shown(arguments), "machine": before, "output": lines}}
    if part in EXPERIMENTS:
        title, arguments, kept = EXPERIMENTS[part]
        print(f"  {shown(arguments)}", file=sys.stderr, flush=True)
        before = machine()
        lines = call(arguments, may_fail=True).splitlines()
        return {part: {"title": title, "command": shown(arguments), "machine": before,
                       "output": [line.rstrip() for line in lines if re.match(kept, line)]}}
    if part in BENCHES:
        return {part: benched(part)}
    if part in ROTATIONS:
        return turned(part, data)
    if part in DISTURBED:
        return disturbed(part)
    if part in FAULTY:
        return faulty(part)
    if part in RECORDED:
        return recorded(part, data)
    if part in STARTS:
        return started(part)
    entries = {}
    if part in RECORDINGS:
        title, recording, truth, settings, ways = RECORDINGS[part]
        if not (ROOT / data / recording).exists():
            print(f"results: {part} is left out: {data / recording} is absent", file=sys.stderr)
            return {}
        source = ["--source", str(data / recording), "--bodies", str(data / "bodies.json")]
        settings = [setting.format(data=data) for setting in settings]
    else:
        title, settings, seeds, frames, ways = SIMULATED[part]
        title += f", seeds {seeds[0]} to {seeds[-1]}, {frames} frames each"
        settings, source, truth = [*settings, f"simulator.frames={frames}"], [], None
    arguments = source + [word for key in settings for word in ("--set", key)]
    if part in FILMED:
        draw_films(arguments, part, seeds)
    for way in [way for way in ways if way in wanted_ways]:
        before = machine()
        name = f"{part}-{way.replace(' ', '-')}"
        if part in RECORDINGS:
            command, *files, frames = fly(arguments, way, name, data / truth)
        else:
            def flight_of(seed):
                seeded, truth = arguments + ["--set", f"simulator.seed={seed}"], None
                if part in FILMED:
                    _, video, truth = film_command(seeded, part, seed)
                    seeded = ["--source", str(video)]
                return seeded, way, f"{name}-{seed}", truth, f"results-{part}-{seed}"

            # Poses of a lossless flight do not depend on what runs beside it, as long as nobody is given up.
            if way == "lossless" and JOBS > 1:
                before["jobs"] = JOBS
            with ThreadPoolExecutor(before.get("jobs", 1)) as pool:
                flights = [flight for _, *flight in pool.map(lambda seed: fly(*flight_of(seed)), seeds)]
            command, *_ = flight_command(*flight_of("SEED"))
            files = pooled(flights, name)
            frames = [sum(flight[-1][kind] for flight in flights) for kind in (0, 1)]
        commands = [command]
        if part in FILMED:
            commands.insert(0, film_command(arguments + ["--set", "simulator.seed=SEED"], part, "SEED")[0])
        entries[name] = {"title": title, "way": way, "command": "\n".join(map(shown, commands)), "machine": before,
                         "searched": frames[0], "skipped": frames[1],
                         **evaluated(*files)}
    return entries


def number(value, digits):
    return "" if value is None else f"{value:.{digits}f}"


def share(bin):
    return f"{100 * bin['measured'] / bin['eligible']:.1f} %" if bin["eligible"] else ""


def measured_on(entry):
    facts = entry["machine"]
    clock = f" at {facts['mhz']} MHz" if facts["mhz"] else ""
    beside = f" Beside it: {facts['beside']}." if facts.get("beside") else ""
    jobs = f" {facts['jobs']} flights at a time." if facts.get("jobs") else ""
    return (f"{facts['cores']} cores, {facts['processor']}{clock}, load average {facts['load']} "
            f"before the run.{jobs}{beside}")


def spread(found, unit, digits):
    return (f"median {found['median']:.{digits}f}{unit}, 95 % {found['p95']:.{digits}f}, "
            f"99 % {found['p99']:.{digits}f}")


def rotation_lines(found):
    """What is said of the camera's own rotation."""
    if not found or not found["error_deg"]:
        return []
    rates = found["rate_error_deg_s"]
    return [f"- The camera's rotation: known in {found['known']} frames, not known in "
            f"{found['not_known']}; error {spread(found['error_deg'], '°', 3)}; NEES mean "
            f"{found['nees']['mean']:.2f}, median {found['nees']['median']:.2f}, "
            f"{100 * found['nees']['inside_99']:.1f} % inside 99 %.",
            *([f"- Its rate: error {spread(rates, ' degrees/s', 2)}; NEES mean "
               f"{found['rate_nees']['mean']:.2f}, median {found['rate_nees']['median']:.2f}, "
               f"{100 * found['rate_nees']['inside_99']:.1f} % inside 99 %."] if rates else [])]


def prediction_lines(found):
    """What is said of poses predicted for the time of sending, measured in their frame."""
    found = found and found["measured"]
    if not found or not found["position_mm"]:
        return []
    inside = lambda part: f"{100 * found['nees'][part]['inside_99']:.1f} %"
    return [f"- Predicted for the time of sending, {found['ahead_ms']['median']:.0f} ms (median) after "
            f"the exposure: position error {spread(found['position_mm'], ' mm', 1)}, "
            f"{inside('position')} inside 99 %. Rotation error {spread(found['rotation_deg'], '°', 2)}, "
            f"{inside('rotation')} inside 99 %. The exposure's own pose taken for it would be off by "
            f"{spread(found['held_position_mm'], ' mm', 1)}."]


def flight_section(entry):
    lines = [f"## {entry['title'][0].upper()}{entry['title'][1:]}: {entry['way']}", "", "```sh", entry["command"], "```", ""]
    lines += ["| distance m | eligible | measured | share | median mm | 95 % | 99 % | "
              "rotation, median ° | false |", "| --- " * 9 + "|"]
    for bin in entry["bins"]:
        if bin["eligible"] or bin["measured"]:
            lines.append(
                f"| {bin['from_m']:g} to {bin['to_m']:g} | {bin['eligible']} | {bin['measured']} | "
                f"{share(bin)} | {number(bin['median_mm'], 1)} | {number(bin['p95_mm'], 1)} | "
                f"{number(bin['p99_mm'], 1)} | {number(bin['rotation_deg'], 2)} | {bin['false']} |")
    lines.append("")
    if "searched" in entry:
        lines.append(f"- {entry['searched']} frames searched, {entry['skipped']} skipped.")
    found = entry.get("found")
    if found:
        lines.append(f"- Frames until a body without a track was found, of those within 2.2 m with less than "
                     f"4 px of blur: median {found['median']}, 95 % {found['p95']}, worst {found['worst']}, "
                     f"of {found['times']} times.")
    lines += [f"- False poses in all: {entry['false']} of {entry['measured']} measured."]
    if entry["latency"]:
        since = "frame published" if entry["way"] == "lossless" else "exposure"
        latency = entry["latency"]
        lines.append(f"- Latency from {since} to pose: median {latency['median_ms']:.1f} ms, "
                     f"95 % {latency['p95_ms']:.1f} ms, 99 % {latency['p99_ms']:.1f} ms.")
    for what in ("position", "rotation"):
        nees = entry["nees"] and entry["nees"][what]
        if nees:
            lines.append(f"- NEES, {what}: mean {nees['mean']:.2f}, median {nees['median']:.2f}, "
                         f"95 % bounds of the mean {nees['low']:.2f} to {nees['high']:.2f}.")
    lines += rotation_lines(entry.get("rotations")) + prediction_lines(entry.get("predictions"))
    return lines + [f"- {measured_on(entry)}", ""]


def flights_page(title, intro, entries):
    lines = [f"# {title}", "", *intro, ""]
    for entry in entries:
        lines += flight_section(entry)
    return "\n".join(lines).rstrip() + "\n"


def experiments_page(title, explained, entries):
    lines = [f"# Results: {title}", "", "Written by `make results`; do not edit.", explained, ""]
    for entry in entries:
        lines += [f"## {entry['title']}", "", "```sh", entry["command"], "```", "", "```",
                  *entry["output"], "```", "", measured_on(entry), ""]
    return "\n".join(lines).rstrip() + "\n"


def real_page(entry):
    wrapped = [line if line.startswith("|") else textwrap.fill(line, 120) for line in entry["lines"]]
    lines = ["# Results: real pictures", "", "Written by `make results PARTS=real`; do not edit. Licences and sources of the "
             "pictures stand beside them.", "", *wrapped, "",
             "These commands measure the poses, each in the folder of its pictures:", "",
             "```sh", *entry["commands"], "```", "",
             measured_on(entry)]
    return "\n".join(lines) + "\n"


def costs_page(entry):
    stated = (ROOT / "common/config/src/types/costs.rs").read_text()
    lines = ["# Results: costs", "", "Written by `make results PARTS=costs`; do not edit.",
             "Each piece of work alone on one processor, in milliseconds, beside what `profile: repeat`",
             "goes by. [FUSION.md](../FUSION.md#profiles-and-time) says what they are for.", "",
             "| cost | stated | median | most |", "| --- " * 4 + "|"]
    for name, median, most in entry["costs"]:
        default = re.search(rf"^            {name}: ([\d.]+)", stated, re.MULTILINE)
        lines.append(f"| `{name}` | {default.group(1) if default else ''} | {median} | {most} |")
    lines += ["", "`source_ms` was measured on the simulator; decoding a recording costs more.",
              measured_on(entry)]
    return "\n".join(lines) + "\n"


def peers_figure(table):
    """What each further observer costs, from the table of `peer-load`: processors of each observer and of the
    router's part for it."""
    rows = [line.replace("%", "").split() for line in table]
    rows = [row for row in rows if row and row[0].isdigit()]
    lines = {}
    for name, column in (("an observer", 6), ("the router, for each observer", 7)):
        lines[name] = [(int(row[0]), 100 * float(row[column]) / int(row[0])) for row in rows]
    heard = [(int(row[0]), float(row[2])) for row in rows]
    most_x = max(x for x, _ in heard)
    most_y = max(y for line in lines.values() for _, y in line) * 1.1
    at = lambda x, y: f"{70 + 560 * x / most_x:.1f},{330 - 290 * y / most_y:.1f}"
    parts = ['<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 660 400" font-family="sans-serif" font-size="14">',
             '<rect width="660" height="400" fill="white"/>',
             '<text x="70" y="22">percent of a processor, for each observer</text>',
             '<text x="350" y="388" text-anchor="middle">observers, each hearing all others 30 times a second</text>',
             '<polyline points="70,40 70,330 630,330" fill="none" stroke="#888"/>']
    for tick in range(5):
        y = most_y / 1.1 * tick / 4
        parts.append(f'<text x="62" y="{335 - 290 * y / most_y:.1f}" text-anchor="end">{y:.1f}</text>')
    for x, share in heard:
        place = 70 + 560 * x / most_x
        parts.append(f'<text x="{place:.1f}" y="348" text-anchor="middle" font-size="12">{x}</text>')
        if share < 95:
            parts.append(f'<text x="{place:.1f}" y="366" text-anchor="middle" font-size="12" fill="#c33">'
                         f'{share:.0f} % heard</text>')
    for (name, line), colour, y in zip(lines.items(), ("#1668b0", "#d2691e"), (44, 64)):
        points = " ".join(at(*point) for point in line)
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/>')
        parts.append(f'<text x="90" y="{y}" fill="{colour}">{name}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def decisions_figure(output):
    """How many poses of nobody have log odds above x, beside what x says, from the table of the bench."""
    start = next(at for at, line in enumerate(output) if line.startswith("log odds above   of nobody"))
    rows = [[float(word) for word in line.split()] for line in output[start + 1:start + 10]]
    most = math.log10(rows[0][1])
    at = lambda x, y: f"{70 + 70 * x:.1f},{330 - 290 * max(0.0, math.log10(max(y, 1.0))) / most:.1f}"
    parts = ['<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 660 400" font-family="sans-serif" font-size="14">',
             '<rect width="660" height="400" fill="white"/>',
             '<text x="70" y="22">poses of nobody with log odds above x</text>',
             '<text x="350" y="388" text-anchor="middle">x</text>',
             '<polyline points="70,40 70,330 630,330" fill="none" stroke="#888"/>']
    for decade in range(int(most) + 1):
        y = 330 - 290 * decade / most
        parts.append(f'<text x="62" y="{y + 5:.1f}" text-anchor="end">{10 ** decade}</text>')
    for x, *_ in rows:
        parts.append(f'<text x="{70 + 70 * x:.1f}" y="350" text-anchor="middle">{x:.0f}</text>')
    for name, column, colour, y in (("found", 1, "#1668b0", 60), ("stated: e^-x of those above 0", 2, "#d2691e", 80)):
        shown = [row for row in rows if row[column] >= 1]
        points = " ".join(at(row[0], row[column]) for row in shown)
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/>')
        parts.append(f'<text x="400" y="{y}" fill="{colour}">{name}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


# The rows of README.md, with words of its own; the worst ones are among them.
README_ROWS = {
    "far-real-time": "simulated, 0.6 to 4 m",
    "minutes-real-time": "simulated, strong wind, H.264",
    "flight1-real-time": "rendered flight, H.264",
    "flight4-sensor-real-time": "rendered flight in wind, H.264, inertial sensor",
    "sunflight-lossless": "low sun, shadows in stripes of 5 cm",
    "hour-lossless": "an hour, exposure swinging by 2 stops",
}


def cells_of(entry):
    """What a flight measured in each bin of distance, its false poses and its latency."""
    cells = []
    for bin in entry["bins"]:
        median = f", {number(bin['median_mm'], 1)} mm" if bin["measured"] else ""
        cells.append(f"{bin['measured']}/{bin['eligible']}{median}" if bin["eligible"] else "")
    latency = entry["latency"] if entry["way"] == "real time" else None
    cells.append(str(entry["false"]))
    cells.append(f"{latency['median_ms']:.0f}, {latency['p99_ms']:.0f} ms" if latency else "")
    return " | ".join(cells)


def short_table(rows):
    """A table of flights: title, way and entry each."""
    lines = ["| flight | flown | within 1.5 m | 1.5 to 2.2 m | 2.2 to 3 m | 3 to 4 m | false | "
             "latency median, 99 % |", "| --- " * 8 + "|"]
    lines += [f"| {title} | {entry['way']} | {cells_of(entry)} |" for title, entry in rows]
    return "\n".join(lines)


def readme_table(store):
    table = short_table([(title, store[name]) for name, title in README_ROWS.items() if name in store])
    head, rule, *rest = table.splitlines()
    real = [store["real"]["row"]] if "real" in store else []
    return "\n".join([head, rule, *real, *rest])


def overview_table(store):
    flights = [entry for entry in store.values() if "bins" in entry]
    return short_table([(entry["title"].split(", seeds")[0], entry) for entry in flights])


def write_between_marks(page, table):
    """Puts a table between the marks of a page."""
    begin, end = RESULTS_MARKS
    text = page.read_text()
    before, mark, rest = text.partition(begin)
    _, other_mark, after = rest.partition(end)
    if not mark or not other_mark:
        sys.exit(f"results: {page.relative_to(ROOT)} lacks the marks {begin} and {end}")
    page.write_text(f"{before}{begin}\n{table}\n{end}{after}")


def render(store):
    """Writes the tables of docs/results and the short ones of the README.md there and of the project."""
    intro = [
        "Written by `make results`; do not edit. [EVALUATION.md](../EVALUATION.md) defines the words.",
        "Errors are those of each frame's own measurement, before the filter.",
    ]
    of = lambda parts: [e for name, e in store.items() if name.split("-")[0] in parts]
    folder = STORE.parent
    folder.mkdir(parents=True, exist_ok=True)
    STORE.write_text(json.dumps(store, indent=1) + "\n")
    recordings = flights_page("Results: recordings", intro, of(RECORDINGS))
    (folder / "recordings.md").write_text(recordings)
    chosen = [
        "Replace `SEED` by each of the seeds. One bound was chosen on the parts gusts, far, darkflight and brightflight "
        "([constants](constants.md#precision)), and how many places are looked at on one seed of gusts; nothing else was "
        "chosen on these seeds.",
        "A frame that was skipped in real time has no truth, so its bodies are not counted.",
    ]
    simulated = flights_page("Results: simulated flights", intro + chosen, of(SIMULATED))
    (folder / "simulated.md").write_text(simulated)
    (folder / "experiments.md").write_text(experiments_page(
        "experiments", "[EVALUATION.md](../EVALUATION.md#experiments) says what each column means.",
        of([*EXPERIMENTS, *ROTATIONS, "proposals"])))
    disturbances = [*DISTURBED, *FAULTY]
    if any(name in store for name in disturbances):
        (folder / "disturbances.md").write_text(experiments_page(
            "disturbances", "[OPERATING.md](../OPERATING.md#chaos) says what is counted.", of(disturbances)))
    if any(name in store for name in RECORDED):
        (folder / "recorder.md").write_text(experiments_page(
            "the recorder", "[RECORDING.md](../RECORDING.md) says what is recorded.", of(RECORDED)))
    if any(name in store for name in STARTS):
        (folder / "start.md").write_text(experiments_page(
            "start and cost", "[deploy/README.md](../../deploy/README.md) says how the pipeline is run as a service.",
            of(STARTS)))
    if any(name in store for name in SWARMS):
        (folder / "swarms.md").write_text(experiments_page(
            "simulated swarms", "[EVALUATION.md](../EVALUATION.md#a-swarm-in-one-world) says what the words mean.",
            of(SWARMS)))
    if any(name in store for name in [*LOADS, *CUTS]):
        (folder / "peers.md").write_text(experiments_page(
            "how many peers", "[PEERS.md](../PEERS.md#how-many-drones) says what follows.", of([*LOADS, *CUTS])))
        figure = peers_figure(store["peers"]["output"]) if "peers" in store else None
        if figure:
            (ROOT / "docs/figures/peers.svg").write_text(figure)
    if any(name in store for name in ONLOOKERS):
        (folder / "onlookers.md").write_text(experiments_page(
            "onlookers", "[RECORDING.md](../RECORDING.md#the-view) says what looks on, and how. Nobody waits for it. The "
            "processor's share is that of the onlooker's process; frames are those of the whole flight.",
            of(ONLOOKERS)))
    if "decisions" in store:
        (folder / "decisions.md").write_text(experiments_page(
            "decisions", "[FUSION.md](../FUSION.md#what-is-accepted) says what the words mean.\n\n"
            "![How often log odds are exceeded where nobody is](../figures/decisions.svg)", of(["decisions"])))
        (ROOT / "docs/figures/decisions.svg").write_text(decisions_figure(store["decisions"]["output"]))
    if "places" in store:
        (folder / "places.md").write_text(experiments_page(
            "places", "[FUSION.md](../FUSION.md#a-body-in-any-attitude) says how they are searched.",
            of(["places"])))
    if any(name in store for name in CODINGS):
        (folder / "codings.md").write_text(experiments_page(
            "codings", "[FUSION.md](../FUSION.md#video) says what follows. NEES is 3 where covariances are right; in "
            "brackets are the 95 % bounds of its mean.", of(CODINGS)))
    if "real" in store:
        (folder / "real.md").write_text(real_page(store["real"]))
    if "costs" in store:
        (folder / "costs.md").write_text(costs_page(store["costs"]))
    write_between_marks(ROOT / "README.md", readme_table(store))
    write_between_marks(folder / "README.md", overview_table(store))


def stored():
    """What was measured before, by the names of the runs."""
    return json.loads(STORE.read_text()) if STORE.exists() else {}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", help="what to fly; everything if none is named")
    parser.add_argument("--way", choices=WAYS, action="append", help="only flown this way")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("FLOCKEYE_DATA") or DATA),
                        help="the folder of recordings, in place of FLOCKEYE_DATA")
    parser.add_argument("--list", action="store_true", help="list the parts")
    parser.add_argument("--render", action="store_true", help="only write the tables anew")
    arguments = parser.parse_args()
    os.environ["FLOCKEYE_DATA"] = str(arguments.data)
    if arguments.list:
        print("\n".join(PARTS))
        return
    unknown = set(arguments.parts) - set(PARTS)
    if unknown:
        sys.exit(f"results: no part {', '.join(sorted(unknown))}: there are {', '.join(PARTS)}")
    parts = [] if arguments.render else arguments.parts or [part for part in PARTS if part not in LONG]
    (ROOT / WORK).mkdir(parents=True, exist_ok=True)
    for part in parts:
        print(part, file=sys.stderr, flush=True)
        entries = run_part(part, arguments.data, arguments.way or list(WAYS))
        # Read again: another run may have added to it meanwhile.
        store = stored() | entries
        # In the order of PARTS, whatever was flown first.
        render(dict(sorted(store.items(), key=lambda e: PARTS.index(e[0].split("-")[0]))))
    if not parts:
        render(stored())


if __name__ == "__main__":
    main()
