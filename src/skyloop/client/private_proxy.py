"""A private proxy: a child process for one vehicle that never outlives its parent."""

from __future__ import annotations

import itertools
import os
import re
import sys
import threading
import time
from collections.abc import Sequence
from functools import partial
from typing import Final

from skyloop.address import shown_address
from skyloop.child_process import GRACE_S, ChildProcess
from skyloop.client.connection import Scheduler
from skyloop.errors import LinkError, NoAnswerError, UsageError
from skyloop.files import wait_readable
from skyloop.transport.base import ClientHandler, Dialer, TransportClient

_USAGE_ERROR: Final = 2  #: exit code of a child that rejects its address; it prints why in one line
_LOOK_S: Final = 0.05
ORPHAN_LANDS_WITHIN_S: Final = 180.0  #: as long as the child waits for its vehicle to land
_numbers = itertools.count(1)


class PrivateProxy:
    """Runs ``python -m skyloop proxy URI`` as a child process.

    The child ends with :meth:`close`, and with this process, however that ends; a vehicle that still flies then on a
    flight of ours it lands first. Ctrl-C reaches only the application, which can then land.
    """

    def __init__(self, uri: str, command: Sequence[str] = (sys.executable, "-m", "skyloop", "proxy")) -> None:
        """Start the child.

        Args:
            uri: Address of the vehicle.
            command: Command line before the address.
        """
        scheme = re.sub(r"[^a-z0-9]", "", uri.partition("://")[0].lower()) or "vehicle"
        self.name = f"{scheme[:16]}-{os.getpid()}-{next(_numbers)}"
        self.reach = self.name
        self.uri = shown_address(uri)
        self.scheduler = Scheduler()
        self._served = False  # it may have a vehicle in the air
        self._process = ChildProcess([*command, self.uri, "--name", self.name, "--parent-fd", "0"], handed=uri)
        self.pid = self._process.pid  #: process id of the child

    def dialer(self, deadline_s: float) -> Dialer:
        """Return a dialer that at first waits until the proxy serves.

        It raises :class:`NoAnswerError` if that takes too long, :class:`UsageError` if the address makes no sense, and
        :class:`LinkError` if the child has ended, with the end of what it wrote to standard error.

        Args:
            deadline_s: Until when it waits at most, on ``time.monotonic``.
        """
        from skyloop.transport.local import dial as local_dial

        inner = local_dial(self.name)

        def dial(handler: ClientHandler) -> TransportClient:
            while True:
                try:
                    end = inner(handler)
                except (LinkError, UsageError) as error:
                    self._check_alive()
                    if time.monotonic() > deadline_s:
                        if self._served:
                            raise
                        raise NoAnswerError(
                            f"the proxy for {self.uri} did not start in time{self._process.quoted_output}"
                        ) from error
                    self._wait_for_output()
                else:
                    self._served = True
                    return end

        return dial

    def close(self) -> None:
        """End the child and wait for it, 4 s at most while it lands what flies. Idempotent.

        One that never served is terminated after 4 s, and killed after another 4 s.
        """
        self._process.part()
        if not self._served or self._process.wait(GRACE_S) is not None:
            self._process.close(GRACE_S, GRACE_S)
        else:
            end = partial(self._process.close, ORPHAN_LANDS_WITHIN_S + GRACE_S, GRACE_S)
            threading.Thread(target=end, name="skyloop-private-proxy", daemon=True).start()

    def _check_alive(self) -> None:
        child = self._process
        if child.code is None:
            return
        if child.code == _USAGE_ERROR and (words := child.last_words.removeprefix("skyloop: ")):
            raise UsageError(words)
        raise LinkError(f"the proxy for {self.uri} {child.ending}{child.quoted_output}")

    def _wait_for_output(self) -> None:
        """Sleep until the child prints something (that it is ready), ends, or a moment has passed."""
        stdout = self._process.stdout
        if wait_readable(stdout, _LOOK_S) and not os.read(stdout.fileno(), 4096):
            time.sleep(0.005)  # it closed its output and is about to end
