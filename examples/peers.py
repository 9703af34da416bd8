"""Prints who sees whom where, and how old that is.

    python3 examples/peers.py tcp/127.0.0.1:7447 swarm

Endpoint and swarm as in the drone's pipeline.yaml. It needs `pip install clients/python eclipse-zenoh`.
"""

import sys

from flockeye_peers import Swarm


def main():
    endpoint, name = sys.argv[1:]
    with Swarm([endpoint], name) as swarm:
        for report in swarm.reports():
            x, y, z = report.position
            print(
                f"{report.observer} sees {report.target} at {x:.3f} {y:.3f} {z:.3f} m, {report.state}, "
                f"{report.age() * 1e3:.0f} ms old",
                flush=True,
            )


if __name__ == "__main__":
    main()
