"""Prints where a running pipeline sees its neighbours.

    flockeye up                                     # in another terminal
    python3 examples/tracks.py /tmp/flockeye-$(id -u)/flockeye

Needs `pip install iceoryx2==0.10.0`. The folder is that of the instance; `flockeye check` prints it.
"""

import sys
import time

from flockeye_contract import TRACK, TRACK_STATES, Instance, text


def main():
    instance = Instance.join("tracks", *sys.argv[1:])
    tracks = instance.subscriber(TRACK)
    # The launcher removes the folder when the pipeline ends.
    while instance.folder.exists():
        tracks.wait(1.0)
        for header, items in tracks.messages():
            for track in items:
                x, y, z = track.observer_from_target.position
                age_ms = (time.monotonic_ns() - header.stamp.exposure_ns) * 1e-6
                state = TRACK_STATES[track.state] if track.state < len(TRACK_STATES) else "unknown"
                print(
                    f"frame {header.stamp.sequence}: {text(track.name)} {state} at "
                    f"{x:.3f} {y:.3f} {z:.3f} m, {track.markers} markers, {age_ms:.0f} ms old",
                    flush=True,
                )


if __name__ == "__main__":
    main()
