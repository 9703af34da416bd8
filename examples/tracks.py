"""Prints where a running pipeline sees its neighbours.

    flockeye up                                     # in another terminal
    python3 examples/tracks.py /tmp/flockeye-$(id -u)/flockeye

Needs `pip install clients/python`. The folder is that of the instance; `flockeye check` prints it.
"""

import sys
import time

from flockeye import Instance, text
from flockeye.contract import TRACK, TrackState

STATES = {state.value: state.name.lower() for state in TrackState}


def main():
    instance = Instance.join("tracks", *sys.argv[1:])
    tracks = instance.subscriber(TRACK)
    while instance.runs():
        for message in instance.messages(tracks, seconds=1.0):
            stamp = message.header.stamp
            age_ms = (time.monotonic_ns() - stamp.exposure_ns) * 1e-6
            for track in message.items:
                state = STATES.get(track.state, "unknown")
                x, y, z = track.observer_from_target.position
                print(
                    f"frame {stamp.sequence}: {text(track.name)} {state} at "
                    f"{x:.3f} {y:.3f} {z:.3f} m, {track.markers} markers, {age_ms:.0f} ms old",
                    flush=True,
                )


if __name__ == "__main__":
    main()
