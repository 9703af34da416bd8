"""One end of a simulated radio: passes what leaves this network namespace on to the air, and back.

station.py ADDRESS OWN_SOCKET AIR_SOCKET, in a namespace of its own, until standard input is closed.
"""
import fcntl
import os
import select
import socket
import struct
import subprocess
import sys

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
LONGEST_PACKET = 2048

address, own, air = sys.argv[1:]


def ip(*words):
    subprocess.run(["ip", *words], check=True)


device = os.open("/dev/net/tun", os.O_RDWR)
fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", b"radio", IFF_TUN | IFF_NO_PI))
ip("link", "set", "lo", "up")
ip("addr", "add", f"{address}/24", "dev", "radio")
ip("link", "set", "radio", "mtu", "1400", "up")
radio = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
radio.bind(own)
print("ready", flush=True)
while True:
    readable, _, _ = select.select([device, radio, sys.stdin], [], [])
    if sys.stdin in readable:
        break
    if device in readable:
        packet = os.read(device, LONGEST_PACKET)
        try:
            radio.sendto(packet, air)
        except OSError:
            # The air is full, or gone: the packet is lost, as on a radio.
            pass
    if radio in readable:
        os.write(device, radio.recv(LONGEST_PACKET))
