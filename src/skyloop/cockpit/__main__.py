"""``python -m skyloop.cockpit [NAME …]``: the cockpit in its own process.

The first line of output is the page's address.
"""

from __future__ import annotations

import argparse
import sys
import threading
from pathlib import Path

from skyloop.child_process import handed_over, on_parent_end
from skyloop.cockpit.addresses import DEFAULT_PORT
from skyloop.cockpit.server import RECORDINGS, Access, serve_cockpit
from skyloop.errors import SkyloopError
from skyloop.network.config import choose


def main(arguments: list[str] | None = None) -> int:
    """Run the cockpit.

    ``arguments``: used instead of the command-line arguments. Return the exit code: 0, or 2 after printing an
    explanation if the cockpit could not start.
    """
    parser = argparse.ArgumentParser(prog="python -m skyloop.cockpit", description="A page to watch and fly drones.")
    parser.add_argument("names", metavar="name", nargs="*", help="of running proxies (default: all, as they appear)")
    parser.add_argument("--port", type=int, help=f"0 takes a free one (default: {DEFAULT_PORT}, or the next free one)")
    parser.add_argument("--recordings", type=Path, default=RECORDINGS, help="folder for recordings")
    parser.add_argument("--parent-fd", type=int, help="exit when this descriptor (the reading end of a pipe) is closed")
    given = parser.parse_args(arguments)
    stop = threading.Event()
    if given.parent_fd is not None:
        on_parent_end(stop.set, given.parent_fd)
    try:
        serve_cockpit(
            given.names,
            port=given.port,
            access=Access(observer_token=handed_over()),
            recordings=given.recordings,
            on_ready=lambda address: print(address, flush=True),
            stop=stop,
            network=choose(),
        )
    except SkyloopError as error:
        print(f"cockpit: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
