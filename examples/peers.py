"""Prints who sees whom where, and how old that is.

    python3 examples/peers.py tcp/127.0.0.1:7447 swarm
    python3 examples/peers.py tls/10.0.0.7:7447 swarm ground

Endpoint and swarm as in the drone's pipeline.yaml; the folder is one that `flockeye keys issue` has written. It needs
`pip install clients/python eclipse-zenoh`, with a folder `cryptography` too.
"""

import sys

from flockeye_peers import Swarm


def main():
    endpoint, name, *folder = sys.argv[1:]
    security = None
    if folder:
        from flockeye_trust import Security

        security = Security.of_folder(folder[0])
    with Swarm([endpoint], name, security=security) as swarm:
        for report in swarm.reports():
            x, y, z = report.position
            print(
                f"{report.observer} sees {report.target} at {x:.3f} {y:.3f} {z:.3f} m, {report.state}, "
                f"{report.age() * 1e3:.0f} ms old",
                flush=True,
            )


if __name__ == "__main__":
    main()
