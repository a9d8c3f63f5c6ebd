"""Looks up a host's name on a thread of its own: a resolver without a network takes its time, often 10 s."""

from __future__ import annotations

import errno
import ipaddress
import socket
import threading
from typing import Final

WAIT_S: Final = 0.2  #: enough for most names


class NameLookup:
    """Looks up one host at a time. Used by one thread.

    Args:
        family: Of the address that is wanted.
        wait_s: How long :meth:`address` may block [s]; 0 on a thread that others need too.
    """

    def __init__(self, family: socket.AddressFamily = socket.AF_INET, wait_s: float = WAIT_S) -> None:
        self._family = family
        self._wait_s = wait_s
        self._asking: _Question | None = None

    @property
    def answered(self) -> bool:
        """Whether what was not known yet is known now: it is worth asking again."""
        return self._asking is not None and self._asking.answered.is_set()

    def address(self, host: str) -> str:
        """Return a host's first address. Blocks for ``wait_s`` at most.

        Args:
            host: A name, or an address, which is returned at once.

        Raises:
            OSError: It is not known, or not known yet: ask again.
        """
        try:
            return str(ipaddress.ip_address(host))
        except ValueError:
            pass
        if self._asking is None:
            self._asking = _Question(host, self._family)
        question = self._asking
        if not question.answered.wait(self._wait_s):
            raise OSError(errno.ETIMEDOUT, f"the name {host} is still being looked up")
        self._asking = None
        if isinstance(question.answer, OSError):
            raise question.answer
        return question.answer


class _Question:
    def __init__(self, host: str, family: socket.AddressFamily) -> None:
        self.answered = threading.Event()
        self.answer: str | OSError = ""
        threading.Thread(target=self._ask, args=(host, family), name="skyloop-lookup", daemon=True).start()

    def _ask(self, host: str, family: socket.AddressFamily) -> None:
        try:
            self.answer = str(socket.getaddrinfo(host, None, family, socket.SOCK_STREAM)[0][4][0])
        except OSError as error:
            self.answer = error
        except UnicodeError:  # a label that is too long
            self.answer = OSError(errno.EINVAL, f"{host!r:.80} is no name of a host")
        finally:
            self.answered.set()
