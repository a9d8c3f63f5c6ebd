"""AT commands to datagrams: the sequence. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, TypeAlias

from skyloop.wire.ardrone.at import Argument, format_command

#: A command's name and its arguments after the sequence.
Message: TypeAlias = tuple[str, tuple[Argument, ...]]

#: So many datagrams begin at sequence 1 after a restart: the first may be lost, and only a 1 resets the drone's count.
FRESH_DATAGRAMS: Final = 3


class Sequencer:
    """Numbers the commands. The drone executes only what is newer than the last, and takes a 1 as a new beginning."""

    def __init__(self) -> None:
        self._sequence = 0
        self._fresh = FRESH_DATAGRAMS

    def restart(self) -> None:
        """Begin at 1 again: the drone was away or lost us."""
        self._fresh = FRESH_DATAGRAMS

    def datagram(self, messages: Iterable[Message]) -> bytes:
        """The messages as one datagram; empty for none."""
        messages = tuple(messages)
        if messages and self._fresh:
            self._fresh -= 1
            self._sequence = 0
        lines = []
        for name, arguments in messages:
            self._sequence += 1
            lines.append(format_command(name, self._sequence, *arguments))
        return b"".join(lines)
