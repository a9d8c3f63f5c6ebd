"""One end in a separate process, controlled by lines on its standard input; it answers on its standard output.

``serve NAME``: publishes a packet and a frame every 5 ms. ``watch NAME``: subscribes, and answers each line with the
newest frame's number, whether every frame was whole, and why the connection ended.
"""

from __future__ import annotations

import sys
import threading

from skyloop.transport.base import FEEDBACK, video
from skyloop.transport.local import LocalServer, dial
from skyloop.transport.testing import FRONT, ClientLog, ServerLog, header, picture


def serve(name: str) -> None:
    server = LocalServer(name)
    server.start(ServerLog())
    ended = threading.Event()

    def wait_for_the_end() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait_for_the_end).start()
    print("ready", flush=True)
    seq = 0
    while not ended.wait(0.005):
        server.publish(FEEDBACK, b"feedback")
        server.publish_frame(header(seq), picture(header(seq)))
        seq += 1
    server.stop()


def watch(name: str) -> None:
    log = ClientLog(keep=False)
    client = dial(name)(log)
    client.subscribe(video(FRONT))
    client.subscribe(FEEDBACK)
    print("ready", flush=True)
    for _ in sys.stdin:
        print(*(log.seen or [-1])[-1:], len(log.torn), *log.closings, flush=True)
    client.close()


if __name__ == "__main__":
    {"serve": serve, "watch": watch}[sys.argv[1]](sys.argv[2])
