"""An autopilot that pymavlink speaks for: hears until it has heard enough, and prints that as JSON.

Its clock began a given number of nanoseconds after CLOCK_MONOTONIC.
"""
import contextlib
import importlib.util
import json
import os
import pathlib
import socket
import sys
import tempfile
import time

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import ardupilotmega as dialect  # noqa: E402
from pymavlink.generator import mavgen  # noqa: E402

SYSTEM, STARTED_NS = int(sys.argv[1]), int(sys.argv[2])


def with_target_relative():
    """Adds TARGET_RELATIVE, generated from its definition."""
    definition = pathlib.Path(__file__).with_name("target_relative.xml")
    with tempfile.TemporaryDirectory() as folder:
        module = os.path.join(folder, "target_relative.py")
        options = mavgen.Opts(module, wire_protocol="2.0", language="Python3")
        with contextlib.redirect_stdout(sys.stderr):
            mavgen.mavgen(options, [str(definition)])
        spec = importlib.util.spec_from_file_location("target_relative", module)
        generated = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(generated)
    dialect.mavlink_map[511] = generated.mavlink_map[511]


def now_ns():
    return time.monotonic_ns() - STARTED_NS


with_target_relative()
line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
line.bind(("127.0.0.1", 0))
line.settimeout(0.02)
print(json.dumps({"port": line.getsockname()[1]}), flush=True)
mav = dialect.MAVLink(None, SYSTEM, 1)
mav.robust_parsing = False
heard = {"HEARTBEAT": [], "TARGET_RELATIVE": [], "OBSTACLE_DISTANCE_3D": [], "TIMESYNC": []}
peer, spoke_ns, answered = None, 0, False


def send(message):
    line.sendto(message.pack(mav), peer)


def has_enough():
    """Obstacles in our time base, targets with our attitude, and an answer to our question."""
    boot_ms = now_ns() // 1_000_000
    obstacles = [o for o in heard["OBSTACLE_DISTANCE_3D"] if abs(boot_ms - o["time_boot_ms"]) < 5000]
    targets = [t for t in heard["TARGET_RELATIVE"] if any(t["q_sensor"])]
    return answered and heard["HEARTBEAT"] and len(obstacles) >= 2 and len(targets) >= 2


while not has_enough():
    try:
        datagram, peer = line.recvfrom(2048)
    except socket.timeout:
        datagram = b""
    for message in mav.parse_buffer(datagram) or []:
        kind = message.get_type()
        if kind == "BAD_DATA":
            sys.exit(f"bad data: {message}")
        fields = {name: getattr(message, name) for name in message.get_fieldnames()}
        fields["sender"] = [message.get_srcSystem(), message.get_srcComponent()]
        fields["version"] = message.get_msgbuf()[0]
        if kind in heard:
            heard[kind].append(fields)
        if kind == "TIMESYNC" and message.tc1 == 0:
            send(dialect.MAVLink_timesync_message(now_ns(), message.ts1))
        answered |= kind == "TIMESYNC" and message.tc1 != 0 and message.ts1 == 4242
    if peer and now_ns() - spoke_ns > 20_000_000:
        spoke_ns = now_ns()
        send(dialect.MAVLink_timesync_message(0, 4242))
        # Three metres north, one east, two up, the nose to the east.
        unknown = [float("nan")] * 21
        send(dialect.MAVLink_odometry_message(
            spoke_ns // 1000, dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_BODY_FRD, 3, 1, -2,
            [0.5 ** 0.5, 0, 0, 0.5 ** 0.5], 5, 0, 0, 0, 0, 0, unknown, unknown))
print(json.dumps({"now_ms": now_ns() // 1_000_000, "heard": heard}), flush=True)
