"""Addresses that asked for datagrams. Pure."""

from __future__ import annotations

from typing import Final

from skyloop.vehicles.ardrone.wire.navdata import FIRST_SEQUENCE

MOST: Final = 8

Address = tuple[str, int]


class Listeners:
    """Addresses that are sent to, each with a sequence of its own.

    As many as :data:`MOST`: a further one replaces the one that has not asked for longest. They never have to ask
    again, as with the real drone.
    """

    def __init__(self) -> None:
        self._sequences: dict[Address, int] = {}  # in the order in which they asked last

    def refresh(self, address: Address) -> bool:
        """Add an address that asked. Return whether it is new."""
        sequence = self._sequences.pop(address, None)
        self._sequences[address] = FIRST_SEQUENCE if sequence is None else sequence
        if len(self._sequences) > MOST:
            del self._sequences[next(iter(self._sequences))]
        return sequence is None

    def next_sequences(self) -> list[tuple[Address, int]]:
        """Return all addresses with the sequence number of what is sent now."""
        now = list(self._sequences.items())
        for address, sequence in now:
            self._sequences[address] = (sequence + 1) & 0xFFFFFFFF
        return now

    def __len__(self) -> int:
        return len(self._sequences)
