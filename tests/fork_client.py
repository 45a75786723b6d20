"""Runs a Python file in a fork of the process that listens at a socket (see `forking`).

    python -I -S fork_client.py SOCKET FILE WORDS...

It ends as the file's process ends, and passes signals on. It loads next to nothing.
"""

import json
import os
import signal
import socket
import sys

if __name__ == "__main__":
    place, *words = sys.argv[1:]
    told, tell = os.pipe()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as channel:
        channel.connect(place)
        request = {"words": words, "folder": os.getcwd(), "env": dict(os.environ)}  # noqa: PTH109
        socket.send_fds(channel, [json.dumps(request).encode()], [0, 1, 2, tell])
    os.close(tell)
    with os.fdopen(told) as said:
        process = int(said.readline())
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, _: os.kill(process, number))
        code = int(said.readline())
    if code < 0:
        signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    sys.exit(code)
