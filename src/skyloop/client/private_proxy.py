"""A private proxy: a child process for one vehicle that never outlives its parent."""

from __future__ import annotations

import itertools
import os
import re
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import IO, Final

from skyloop.client.scheduler import Scheduler
from skyloop.errors import LinkError, NoAnswerError, UsageError
from skyloop.transport.base import ClientHandler, Dialer, TransportClient

_TAIL: Final = 2000  #: bytes of the child's standard error that an error shows
_USAGE_ERROR: Final = 2  #: exit code of a child that rejects its address; it prints why in one line
_GRACE_S: Final = 4.0  #: time for the child to end by itself, before a signal
_LOOK_S: Final = 0.05
_numbers = itertools.count(1)


class PrivateProxy:
    """Runs ``python -m skyloop proxy URI`` as a child process.

    The child holds the reading end of a pipe: when this process closes the writing end or is gone, however it ended,
    the child ends too. It has a session of its own, so that Ctrl-C reaches only the application, which can then land.
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
        self.uri = uri
        self.scheduler = Scheduler()
        self._messages: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  (closed by close())
        reading, self._alive_fd = os.pipe()
        try:
            self._process = subprocess.Popen(
                [*command, uri, "--name", self.name, "--parent-fd", str(reading)],
                pass_fds=(reading,),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._messages,
                start_new_session=True,
            )
        except BaseException:
            os.close(self._alive_fd)
            self._messages.close()
            raise
        finally:
            os.close(reading)

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    def dialer(self, deadline_s: float) -> Dialer:
        """Return a dialer that at first waits until the proxy serves.

        It raises :class:`NoAnswerError` if that takes too long, :class:`UsageError` if the address makes no sense, and
        :class:`LinkError` if the child has ended, with the end of what it wrote to standard error.

        Args:
            deadline_s: Until when it waits at most, on ``time.monotonic``.
        """
        from skyloop.transport.local import dial as local_dial

        inner = local_dial(self.name)
        served = False

        def dial(handler: ClientHandler) -> TransportClient:
            nonlocal served
            while True:
                try:
                    end = inner(handler)
                except (LinkError, UsageError) as error:
                    self._check_alive()
                    if time.monotonic() > deadline_s:
                        if served:
                            raise
                        raise NoAnswerError(f"the proxy for {self.uri} did not start in time{self._said()}") from error
                    self._wait_for_output()
                else:
                    served = True
                    return end

        return dial

    def close(self) -> None:
        """End the child and wait for it. Idempotent.

        After 4 s it is terminated, after another 4 s killed.
        """
        if self._alive_fd < 0:
            return
        os.close(self._alive_fd)
        self._alive_fd = -1
        for harder in (self._process.terminate, self._process.kill):
            try:
                self._process.wait(_GRACE_S)
            except subprocess.TimeoutExpired:
                harder()
        self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._messages.close()

    def _check_alive(self) -> None:
        code = self._process.poll()
        if code is not None:
            if code == _USAGE_ERROR and (words := self._text().removeprefix("skyloop: ")):
                raise UsageError(words)
            how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
            raise LinkError(f"the proxy for {self.uri} {how}{self._said()}")

    def _wait_for_output(self) -> None:
        """Sleep until the child prints something (that it is ready), ends, or a moment has passed."""
        stdout = self._process.stdout
        assert stdout is not None
        readable, _, _ = select.select([stdout], [], [], _LOOK_S)
        if readable and not os.read(stdout.fileno(), 4096):
            time.sleep(0.005)  # it closed its output and is about to end

    def _said(self) -> str:
        """The end of what the child wrote to its standard error."""
        text = self._text()
        return f"; it said:\n{text}" if text else ""

    def _text(self) -> str:
        size = os.fstat(self._messages.fileno()).st_size
        return os.pread(self._messages.fileno(), _TAIL, max(0, size - _TAIL)).decode(errors="replace").strip()
