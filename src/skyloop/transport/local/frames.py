"""The server's frames: which slot is free, who looks at which, and who waits for the newest.

A frame is copied once, into a slot that nobody looks at, and each viewer is sent a small packet that names the slot.
A viewer that has :data:`MAX_LEASES` frames, or whose socket is full, is passed over; as soon as it gives one back it
is sent the newest frame. There are always slots enough: each viewer can hold only so many.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Iterator
from typing import Final, Protocol

import numpy as np

from skyloop.messages import FrameHeader, encode
from skyloop.transport.base import Pixels
from skyloop.transport.local import packets
from skyloop.transport.local.slots import SlotMemory

MAX_LEASES: Final = 4  #: frames of one camera that one client may have: on the way, or looked at
_Newest = tuple[SlotMemory, bytes]


class Connection(Protocol):
    """What a viewer needs of its connection. Both raise ``OSError`` when the packet can't be taken now."""

    def transmit(self, packet: bytes) -> None: ...

    def transmit_descriptor(self, packet: bytes, descriptor: int) -> None: ...


class Viewer:
    """One client's subscription to one camera."""

    __slots__ = ("active", "announced", "connection", "leases", "retire_before", "waits")

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.leases: dict[int, SlotMemory] = {}
        self.announced: set[int] = set()
        self.retire_before = 0  #: slots below this number were given up, which the client was not told yet
        self.active = True  #: it wants frames; if not, it may still look at some
        self.waits = False  #: it was passed over

    def hand(self, slot: SlotMemory, packet: bytes, camera: int) -> bool:
        """Send a frame; False, and the viewer waits, if it has enough or its socket is full."""
        self.waits = True
        if len(self.leases) >= MAX_LEASES:
            return False
        connection = self.connection
        try:
            if self.retire_before:
                connection.transmit(packets.retire(camera, self.retire_before))
                self.retire_before = 0
            if slot.number not in self.announced:
                connection.transmit_descriptor(packets.slot(slot.number, camera, slot.capacity), slot.fd)
                self.announced.add(slot.number)
            connection.transmit(packet)
        except OSError:
            return False
        self.leases[slot.number] = slot
        slot.holders += 1
        self.waits = False
        return True


class Camera:
    """The slots and viewers of one camera. Not locked: :class:`FrameExchange` sees to that."""

    def __init__(self, number: int, slot_numbers: Iterator[int]) -> None:
        self.number = number
        self.viewers: dict[Connection, Viewer] = {}  # some may want no more frames, and only look at some
        self.active: tuple[Viewer, ...] = ()  # those who want frames
        self._generation = 0
        self._geometry: object = None
        self._capacity = 0
        self._free: list[SlotMemory] = []
        self._count = 0  # slots of this generation
        self._slot_numbers = slot_numbers
        self._next_number = 0  # no slot so far has this number or a higher one
        self._newest: _Newest | None = None

    def take(self, header: FrameHeader) -> SlotMemory:
        """A slot to write a frame to, held by the writer until :meth:`offer`. Raises ``OSError``: no memory is left."""
        geometry = (header.width, header.height, header.encoding)
        if geometry != self._geometry or header.size > self._capacity:
            # Compressed frames vary in size: when one outgrows its slots, the next ones get room to spare.
            grows = geometry == self._geometry
            self.retire()
            self._geometry = geometry
            self._capacity = 1 << (header.size - 1).bit_length() if grows else max(header.size, 1)
        if self._free:
            slot = self._free.pop()  # the one freed last: it is in the processor's cache
        else:
            slot = SlotMemory(next(self._slot_numbers), self._generation, self._capacity)
            self._next_number = slot.number + 1
            self._count += 1
        slot.holders = 1
        return slot

    def offer(self, slot: SlotMemory, packet: bytes) -> int:
        """Hand a written slot to all viewers; returns how many were passed over."""
        missed = 0
        for viewer in self.active:
            if not viewer.hand(slot, packet, self.number):
                missed += 1
        if missed or self._newest is not None:
            self._keep((slot, packet) if missed else None)
        if not missed:
            self.drop(slot)
        return missed

    def drop(self, slot: SlotMemory) -> None:
        """One holder less."""
        slot.holders -= 1
        if slot.holders == 0 and slot.generation == self._generation:
            self._free.append(slot)

    def released(self, viewer: Viewer, number: int) -> bool:
        """A viewer gave a slot back; False if it did not have it."""
        slot = viewer.leases.pop(number, None)
        if slot is None:
            return False
        self.drop(slot)
        if viewer.waits and self._newest is not None:
            viewer.hand(*self._newest, self.number)
            if not any(other.waits for other in self.viewers.values()):
                self._keep(None)
        return True

    def subscribe(self, connection: Connection) -> None:
        """A viewer wants frames, from the next one on."""
        self.viewers.setdefault(connection, Viewer(connection)).active = True
        self._count_active()

    def unsubscribe(self, viewer: Viewer) -> None:
        """A viewer wants no more frames. What it looks at stays as it is until it gives that back."""
        viewer.active = viewer.waits = False
        viewer.announced.clear()
        with contextlib.suppress(OSError):  # then it keeps the slots mapped until it ends
            viewer.connection.transmit(packets.retire(self.number, self._next_number))
        self._trim()

    def leave(self, connection: Connection) -> None:
        """A client is gone, and all that it looked at is free."""
        viewer = self.viewers.pop(connection, None)
        if viewer is not None:
            for slot in viewer.leases.values():
                self.drop(slot)
            self._trim()

    def _trim(self) -> None:
        """Give memory back that fewer viewers cannot need."""
        self._count_active()
        if not self.active or self._count > (MAX_LEASES * len(self.viewers)) + 2:
            self.retire()

    def _count_active(self) -> None:
        self.active = tuple(viewer for viewer in self.viewers.values() if viewer.active)

    def retire(self) -> None:
        """Give the memory of all slots back; of those somebody looks at, when they are released."""
        self._keep(None)
        self._generation += 1
        self._geometry = None
        self._capacity = 0
        self._free.clear()
        self._count = 0
        for viewer in self.viewers.values():
            viewer.announced.clear()
            viewer.retire_before = self._next_number

    def _keep(self, newest: _Newest | None) -> None:
        """Keep a slot for viewers that wait, or none; the hold on ``newest`` passes on from its writer."""
        before, self._newest = self._newest, newest
        if before is not None:
            self.drop(before[0])


class FrameExchange:
    """All cameras of a server. Thread-safe; nothing is copied under its lock."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._cameras: dict[str, Camera] = {}
        self._slot_numbers = itertools.count(1)

    def publish(self, header: FrameHeader, pixels: Pixels) -> int:
        """Copy a frame and hand it on; returns to how many viewers it could not be handed."""
        camera = self._cameras.get(header.camera)
        if camera is None or not camera.active:
            return 0
        description = encode(header)
        with self._lock:
            try:
                slot = camera.take(header)
            except OSError:
                return len(camera.active)
        np.copyto(slot.array[: header.size], pixels.reshape(-1))
        packet = packets.frame(slot.number, description)
        with self._lock:
            return camera.offer(slot, packet)

    def subscribe(self, connection: Connection, name: str) -> None:
        """A client wants a camera's frames, from the next one on."""
        with self._lock:
            camera = self._cameras.get(name)
            if camera is None:
                camera = self._cameras[name] = Camera(len(self._cameras) + 1, self._slot_numbers)
            camera.subscribe(connection)

    def unsubscribe(self, connection: Connection, name: str) -> None:
        """A client wants them no longer."""
        with self._lock:
            camera = self._cameras.get(name)
            viewer = camera.viewers.get(connection) if camera is not None else None
            if camera is not None and viewer is not None:
                camera.unsubscribe(viewer)

    def release(self, connection: Connection, slot: int) -> bool:
        """A client gives a slot back; False if it did not have it."""
        with self._lock:
            for camera in self._cameras.values():
                viewer = camera.viewers.get(connection)
                if viewer is not None and camera.released(viewer, slot):
                    return True
        return False

    def leave(self, connection: Connection) -> None:
        """A client is gone."""
        with self._lock:
            for camera in self._cameras.values():
                camera.leave(connection)
