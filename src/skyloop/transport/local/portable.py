"""The portable side of the local transport: loopback TCP between processes that share a secret, and selectors.

A server listens on a port of 127.0.0.1. Its *registration*, a file that only its user can read, holds the port and a
random secret. Both ends prove that they know the secret before the first packet (``docs/wire-format.md``), so other
users of the host, and programs that took over the port of an ended server, learn nothing. The server holds a lock on
its registration. The lock ends with the process and shows whether it still runs.

Each packet follows its length in four bytes. If the kernel takes only a part of a packet, a thread sends the rest when
there is room, also after the sender has hung up. Until then, one small packet may follow it, such as a stop, and
further ones are refused. The server is then told, so that it sends the newest frame.
"""

from __future__ import annotations

import _thread
import errno
import hashlib
import hmac
import logging
import math
import os
import select
import selectors
import socket
import struct
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from skyloop.child_process import leave_to_parent
from skyloop.errors import LinkError, UsageError
from skyloop.platform import change_file, lock_file, own_uid, socket_pair, try_lock
from skyloop.transport.base import Pixels
from skyloop.transport.local.named_memory import NamedSlot, prefix, remove_names
from skyloop.transport.local.system import (
    CONNECT_TIMEOUT_S,
    HOST,
    PROXY,
    SEND_FLAGS,
    Credentials,
    PacketSocket,
    StrangerError,
)

SUFFIXES: Final = {PROXY: ".port", HOST: ".hostport"}
VERSION: Final = 1  #: of the registration and the handshake
HANDSHAKE_S: Final = 2.0  #: time for both ends to prove that they know the secret
MAX_STRANGERS: Final = 32  #: maximum number of connections that have not proved it yet; one more closes the oldest
_HOST: Final = "127.0.0.1"
#: Sizes of both ends' buffers towards the server and the client. On Linux, 290 set-points wait for a stalled server and
#: 200 packets of 300 bytes for a stalled client, as on the fast side. Larger packets are completed while it reads.
_TO_SERVER: Final = 16_384
_TO_CLIENT: Final = 32_768
_LENGTH: Final = 4  # bytes before each packet
_LONGEST: Final = 1 << 16  # longest packet [bytes]; a host accepts longer ones than a proxy
_SLICE_MS: Final = 500 if sys.platform == "win32" else -1  # longest wait at once: on Windows, a shutdown ends none
_LOCKED_WITHIN_S: Final = 1.0  # how long other processes that check a new registration may delay its lock
_REST_S: Final = 1.0  # time for the rest of a packet after its sender has hung up
_REST_SLICE_MS: Final = 250  # how often that packet's thread checks whether the sender has
_SMALL: Final = 1024  # longest packet that may follow a rest
_MOST_WAITING: Final = 128
_MOST_SELECTED: Final = 512  # what Windows' select waits for
_FAILED_S: Final = 0.2  # pause after a failure to accept, when descriptors or memory have run out
_REGISTRATION: Final = struct.Struct("<8sHHI32s32s")  # magic, version, port, process, secret, names of its memory
_MAGIC: Final = b"SkyPort\n"
_NONCE: Final = 32
_PROOF: Final = struct.Struct("<4sHI32s32s")  # magic, version, process, the client's nonce, its MAC
_PROOF_MAGIC: Final = b"SKYL"
_MAC: Final = 32
_log = logging.getLogger(__name__)


class Registration(NamedTuple):
    """The content of a server's file."""

    port: int
    pid: int
    secret: bytes
    memory: str  #: what the names of its shared memory begin with

    def mac(self, who: bytes, server_nonce: bytes, client_nonce: bytes, pid: int) -> bytes:
        """Return the proof of one end."""
        said = who + struct.pack("<HI", VERSION, pid) + server_nonce + client_nonce
        return hmac.digest(self.secret, said, hashlib.sha256)


_NOT_LET_IN: Final = "it closed the connection too early; perhaps too many others are connecting, so try again"
_TURNED_AWAY: Final = "a process that wanted to connect was turned away"
_CLIENT: Final = b"skyloop client"
_SERVER: Final = b"skyloop server"


def check_support() -> None:
    """Do nothing: this side works everywhere."""


class _TcpSocket(socket.socket):
    """A socket that closes itself when nothing refers to it any more."""

    def __del__(self) -> None:
        self.close()


class StreamSocket:
    """A TCP connection that carries packets; see :class:`skyloop.transport.local.system.PacketSocket`."""

    post_flags = 0

    def __init__(self, sock: socket.socket, who: Credentials, backlog: int) -> None:
        self.who = who
        self._backlog = backlog
        self._socket = _TcpSocket(fileno=sock.detach())
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._poll = _waiter(self._socket)
        self._wait_s = 0.0
        # Re-entrant, because the garbage collector or a signal's handler may send in the middle of another call.
        self._sending = threading.RLock()
        self._inside = False  # whether a call that sends is under way
        self._rest = b""  # the unsent end of a packet that was sent in part, and a small one behind it
        self._followed = False  # whether there is one
        self._awaiting_room = False  # whether a thread waits until something fits again
        self._has_room: Callable[[], object] | None = None
        self._partial = bytearray()  # the beginning of an incomplete packet, with its length
        self._ended = False

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(self, packet: bytes, flags: int = 0) -> int:
        if not self._sending.acquire(blocking=flags != self.post_flags):
            raise BlockingIOError(errno.EAGAIN, "another thread is sending")
        try:
            self._send(packet)
        finally:
            self._sending.release()
        return len(packet)

    def _send(self, packet: bytes) -> None:
        if self._ended:
            raise BrokenPipeError(errno.EPIPE, "the connection has ended")
        if self._inside:
            raise BlockingIOError(errno.EAGAIN, "this thread is sending")
        self._inside = True
        try:
            accepted = self._offer(len(packet).to_bytes(_LENGTH, "little") + packet)
            if self._rest or not accepted:
                self._await_room()
        except OSError:
            raise
        except BaseException:  # raised by a signal's handler: it is unknown how much the kernel took
            self._break()
            raise
        finally:
            self._inside = False
        if not accepted:
            raise BlockingIOError(errno.EAGAIN, "it does not fit now")

    def _offer(self, content: bytes) -> bool:
        """Send a packet with its length, at least in part; return False if it is refused."""
        try:
            if self._rest:
                self._send_rest()
            self._rest = content[self._socket.send(content) :]
        except BlockingIOError:
            if not self._rest or self._followed or len(content) > _LENGTH + _SMALL:
                return False
            self._rest, self._followed = self._rest + content, True
        return True

    def _send_rest(self) -> None:
        while self._rest:
            self._rest = self._rest[self._socket.send(self._rest) :]
        self._followed = False

    def _break(self) -> None:
        """End the connection at once, because the boundary between packets is lost."""
        self._ended, self._rest = True, b""
        self._shut_down(socket.SHUT_RDWR)

    def _shut_down(self, how: int) -> None:
        with suppress(OSError):  # the connection had already ended
            self._socket.shutdown(how)

    def _await_room(self) -> None:
        if not self._awaiting_room:
            self._awaiting_room = True
            try:
                _thread.start_new_thread(self._complete, ())
            except RuntimeError as error:  # no more threads
                self._break()
                raise ConnectionAbortedError(errno.ECONNABORTED, str(error)) from None

    def _complete(self) -> None:
        """Send the rest of a packet as soon as there is room, and tell the server so, or end the connection."""
        complete = False
        try:
            complete = self._wait_and_send()
        except BaseException as error:
            self._break()
            if not isinstance(error, (OSError, ValueError)):  # the connection has ended, or was closed
                raise
        if not complete:
            self._awaiting_room = False
        if self._ended:
            if not self._awaiting_room:  # otherwise, another packet was sent in part, and its thread does this
                self._shut_down(socket.SHUT_RDWR)
        elif (has_room := self._has_room) is not None:
            with suppress(OSError, ValueError):
                has_room()

    def _wait_and_send(self) -> bool:
        """Send the rest; return False if the sender has hung up and there was no room for too long."""
        wait, deadline_s = _waiter(self._socket, to_send=True), math.inf
        while time.monotonic() < deadline_s:
            wait(_REST_SLICE_MS)
            with self._sending:
                self._inside = True
                try:
                    self._send_rest()
                    # From here on, a partly sent packet gets its own thread.
                    self._awaiting_room = False
                    return True
                except BlockingIOError:
                    pass
                finally:
                    self._inside = False
            if self._ended:
                deadline_s = min(deadline_s, time.monotonic() + _REST_S)
        return False

    def send_descriptor(self, packet: bytes, descriptor: int) -> None:  # noqa: ARG002
        raise OSError(errno.EOPNOTSUPP, "TCP carries no descriptors")

    def send_within(self, packet: bytes, seconds: float) -> None:
        deadline_s = time.monotonic() + seconds
        while True:
            try:
                self.send(packet)
            except BlockingIOError:
                if time.monotonic() > deadline_s:
                    raise
                time.sleep(0.001)
            else:
                return

    def recv(self, size: int, flags: int = 0) -> bytes:
        if not flags:
            self._wait()
        while not self._ended:
            try:
                packet = self._next(size)
            except ConnectionError:
                break
            except BlockingIOError:  # only a part of a packet has arrived
                if flags:
                    raise
                self._wait()
                continue
            except OSError:
                raise
            except BaseException:  # raised by a signal's handler: it is unknown how much was taken from the kernel
                self._break()
                raise
            if packet:
                return packet
            break
        self._ended = True
        return b""

    def receiver(self, size: int) -> Callable[[], tuple[bytes, Sequence[Any], int, Any]]:
        return lambda: (self.recv(size), (), 0, None)

    def _wait(self) -> None:
        """Wait for something to arrive; ``BlockingIOError`` if nothing does for too long."""
        deadline_s = time.monotonic() + self._wait_s if self._wait_s else math.inf
        while not self._ended:
            left_s = deadline_s - time.monotonic()
            if self._poll(_SLICE_MS if left_s == math.inf else max(0, math.ceil(left_s * 1e3))):
                return
            if left_s <= 0.0:
                raise BlockingIOError(errno.EAGAIN, "nothing has arrived")

    def _next(self, size: int) -> bytes:
        """Return the next packet; empty at the end. ``BlockingIOError``: it has not arrived completely."""
        receive, partial = self._socket.recv, self._partial
        if not partial:  # in the usual case, one call takes a whole packet
            head = receive(_LENGTH, socket.MSG_PEEK)
            if not head:
                return b""
            content = receive(self._length(head)) if len(head) == _LENGTH else receive(len(head))
            if len(head) == _LENGTH and len(content) == self._length(head):
                return content[_LENGTH : _LENGTH + size]
            partial += content
        while (missing := (self._length(partial) if len(partial) >= _LENGTH else _LENGTH) - len(partial)) > 0:
            content = receive(missing)
            if not content:
                return b""
            partial += content
        packet = bytes(partial[_LENGTH : _LENGTH + size])
        partial.clear()
        return packet

    def _length(self, head: bytes | bytearray) -> int:
        """Return how long a packet and its length are together."""
        length = int.from_bytes(head[:_LENGTH], "little")
        if length > _LONGEST:
            raise ConnectionAbortedError(errno.ECONNABORTED, f"a packet of {length} bytes")
        return _LENGTH + length

    def descriptors(self, ancillary: Sequence[Any]) -> list[int]:  # noqa: ARG002
        return []

    def map_sealed(self, descriptor: int, capacity: int) -> Pixels:  # noqa: ARG002
        raise LinkError("the proxy sent a descriptor over TCP")

    def poller(self) -> Callable[[int], object]:
        return self._poll

    def limit_wait(self, seconds: float) -> None:
        self._wait_s = seconds

    def on_room(self, call: Callable[[], object]) -> None:
        self._has_room = call

    def limit_backlog(self) -> None:
        with suppress(OSError):  # it has been reset, which macOS reports here
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, self._backlog)

    def hang_up(self, last_packet: bytes = b"") -> None:
        if last_packet:
            with suppress(OSError):
                self.send(last_packet, SEND_FLAGS)
        self._ended = True
        self._has_room = None
        if not (self._rest and self._awaiting_room):
            self._shut_down(socket.SHUT_RDWR)
        elif sys.platform != "win32":  # its thread does the rest; Windows would reset the connection
            self._shut_down(socket.SHUT_RD)

    def close(self) -> None:
        self._socket.close()


def _waiter(sock: socket.socket, *, to_send: bool = False) -> Callable[[int], object]:
    """Return a function that waits for up to some time [ms], and returns whether the socket is ready."""
    if sys.platform != "win32":
        poll = select.poll()
        poll.register(sock, select.POLLOUT if to_send else select.POLLIN)
        return poll.poll
    readers, writers = ([], [sock]) if to_send else ([sock], [])
    return lambda wait_ms: any(select.select(readers, writers, [], None if wait_ms < 0 else wait_ms / 1e3))


class SelectorPoller:
    """Waits with the best means of this system, which on Windows are limited to 512 sockets."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._woken, self._bell = socket_pair()
        for end in (self._woken, self._bell):
            end.setblocking(False)
        self.waker = self._woken.fileno()
        self._selector.register(self.waker, selectors.EVENT_READ)

    def poll(self, timeout_s: float) -> list[tuple[int, int]]:
        try:
            return [(key.fd, events) for key, events in self._selector.select(timeout_s)]
        except OSError:  # on Windows: a socket was closed while this waited for it
            return []

    def register(self, fileno: int) -> None:
        if isinstance(self._selector, selectors.SelectSelector) and len(self._selector.get_map()) >= _MOST_SELECTED:
            raise OSError(errno.EMFILE, "too many sockets for this system")
        with suppress(KeyError):
            self._selector.register(fileno, selectors.EVENT_READ)
        self.wake()  # not every selector notices it otherwise

    def unregister(self, fileno: int) -> None:
        with suppress(KeyError, RuntimeError):  # already done, or closed
            self._selector.unregister(fileno)

    def mute(self, fileno: int, muted: bool) -> None:
        (self.unregister if muted else self.register)(fileno)

    def wake(self) -> None:
        with suppress(OSError):  # it is awake, or closed
            self._bell.send(b"\0")

    def drain(self) -> None:
        with suppress(BlockingIOError):
            self._woken.recv(4096)

    def close(self) -> None:
        self._selector.close()
        self._woken.close()
        self._bell.close()


new_slot = NamedSlot
new_poller = SelectorPoller


def check_path(path: Path) -> None:
    """Do nothing: a file may have any path."""


def listen(path: Path, gid: int | None) -> Gate:
    if gid is not None:
        raise UsageError(
            "a group can't share proxies over the portable transport, where frames are only for their own user: "
            "serve without a group"
        )
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        if exclusive := getattr(socket, "SO_EXCLUSIVEADDRUSE", 0):  # Windows would let others listen on the same port
            listener.setsockopt(socket.SOL_SOCKET, exclusive, 1)
        _limit_received(listener, _TO_SERVER)
        listener.bind((_HOST, 0))
        listener.listen(128)
        registration = Registration(listener.getsockname()[1], os.getpid(), os.urandom(32), prefix())
        lock = _register(path, registration)
        try:
            return Gate(listener, registration, path.name, lock)
        except BaseException:
            os.close(lock)
            path.unlink(missing_ok=True)
            raise
    except BaseException:
        listener.close()
        raise


def _limit_received(sock: socket.socket, size: int) -> None:
    """Limit what waits in the kernel to be read. Must be called before the connection is made."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)


def _register(path: Path, registration: Registration) -> int:
    """Write a registration in one step, and return a descriptor whose lock shows that it is alive."""
    port, pid, secret, memory = registration
    descriptor, part = tempfile.mkstemp(prefix=".", suffix=path.suffix, dir=path.parent)  # only for this user
    try:
        try:
            os.write(descriptor, _REGISTRATION.pack(_MAGIC, VERSION, port, pid, secret, memory.encode()))
        finally:
            os.close(descriptor)
        change_file(lambda: Path(part).replace(path))
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise
    descriptor = os.open(path, os.O_RDWR)
    if not lock_file(descriptor, _LOCKED_WITHIN_S):  # others hold it for a moment when they look
        os.close(descriptor)
        path.unlink(missing_ok=True)
        raise LinkError(f"{path} is locked by another process, which appears to be stopped")
    return descriptor


def _read(path: Path) -> Registration:
    """Read a registration. Raises ``OSError``, also for one of another version."""
    content = path.read_bytes()
    if len(content) != _REGISTRATION.size:
        raise OSError(errno.EPROTO, "its registration is not complete")
    magic, version, port, pid, secret, memory = _REGISTRATION.unpack(content)
    if magic != _MAGIC or version != VERSION:
        raise OSError(errno.EPROTO, f"its registration is not of version {VERSION} of the portable transport")
    return Registration(port, pid, secret, memory.rstrip(b"\0").decode("ascii", "replace"))


def is_live(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    try:
        return not try_lock(descriptor, shared=True)
    finally:
        os.close(descriptor)


def owner_pid(path: Path) -> int | None:
    try:
        return _read(path).pid
    except OSError:
        return None


def remove(path: Path) -> None:
    with suppress(OSError):
        registration = _read(path)
        if registration.memory != prefix():  # otherwise, other servers of this process have the same memory
            remove_names(registration.memory)
    change_file(lambda: path.unlink(missing_ok=True))


def may_connect(sock: PacketSocket, gid: int | None) -> bool:  # noqa: ARG001
    """Return True: the other end has proved that it knows the secret."""
    return True


def connect(path: Path) -> StreamSocket:
    registration = _read(path)
    if not is_live(path):
        raise ConnectionRefusedError(errno.ECONNREFUSED, "its process has ended")
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        _limit_received(sock, _TO_CLIENT)
        sock.settimeout(CONNECT_TIMEOUT_S)
        sock.connect((_HOST, registration.port))
        _introduce(sock, registration, time.monotonic() + HANDSHAKE_S)
    except TimeoutError:
        sock.close()
        raise BlockingIOError(errno.EAGAIN, "it does not answer") from None
    except BaseException:
        sock.close()
        raise
    return StreamSocket(sock, Credentials(registration.pid, own_uid(), 0), _TO_SERVER)


def _introduce(sock: socket.socket, registration: Registration, deadline_s: float) -> None:
    """Prove to the server that this end knows the secret, and let the server prove the same."""
    pid, ours = os.getpid(), os.urandom(_NONCE)
    theirs = _receive(sock, _NONCE, deadline_s)
    mac = registration.mac(_CLIENT, theirs, ours, pid)
    sock.sendall(_PROOF.pack(_PROOF_MAGIC, VERSION, pid, ours, mac))
    proof = _receive(sock, _MAC, deadline_s)
    if not hmac.compare_digest(proof, registration.mac(_SERVER, theirs, ours, pid)):
        raise ConnectionAbortedError(errno.ECONNABORTED, "the process at its port is not this proxy")


def _receive(sock: socket.socket, size: int, deadline_s: float) -> bytes:
    content = b""
    while len(content) < size:
        sock.settimeout(max(1e-3, deadline_s - time.monotonic()))
        if not (more := sock.recv(size - len(content))):
            raise ConnectionAbortedError(errno.ECONNABORTED, _NOT_LET_IN)
        content += more
    return content


def _challenge(sock: socket.socket, registration: Registration, deadline_s: float) -> int:
    """Return the process at the other end if it knows the secret. Raises :class:`StrangerError` if it does not."""
    pid: int
    ours = os.urandom(_NONCE)
    sock.sendall(ours)
    magic, version, pid, theirs, mac = _PROOF.unpack(_receive(sock, _PROOF.size, deadline_s))
    if magic != _PROOF_MAGIC or version != VERSION:
        raise StrangerError(f"it does not speak version {VERSION} of the local transport's handshake")
    if not hmac.compare_digest(mac, registration.mac(_CLIENT, ours, theirs, pid)):
        raise StrangerError("it does not know the proxy's secret")
    sock.sendall(registration.mac(_SERVER, ours, theirs, pid))
    return pid


class Gate:
    """A server's socket. It lets only those in that know the secret, each of which has a thread until then."""

    _lock = -1
    _ends: tuple[socket.socket, ...] = ()

    def __init__(self, listener: socket.socket, registration: Registration, name: str, lock: int) -> None:
        listener.settimeout(HANDSHAKE_S)
        self._listener = listener
        self._registration = registration
        self._name = name
        self._strangers: dict[socket.socket, None] = {}  # oldest first
        self._meeting = threading.Lock()  # guards those
        self._waiting: deque[StreamSocket | str] = deque()  # admitted connections, or the reason why one was refused
        self._ends = self._woken, self._bell = socket_pair()  # a byte for each of those
        self._woken.setblocking(True)  # overrides socket.setdefaulttimeout()
        self._bell.setblocking(False)
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="skyloop-gate", daemon=True)
        self._thread.start()
        self._lock = lock  # its owner from here on
        leave_to_parent(self)

    def __del__(self) -> None:
        for end in self._ends:
            end.close()
        self.release()

    def forked(self) -> None:
        """Close a forked child's copies. Otherwise, the registration would stay locked after the parent's end."""
        for copy in (self._listener, *self._ends):
            copy.close()
        lock, self._lock = self._lock, -1
        if lock >= 0:
            os.close(lock)

    def release(self) -> None:
        """Empty the registration and unlock it. If it could not be removed, the next listing does that.

        The memory is not that listing's to remove, because other servers of this process may still use it.
        """
        lock, self._lock = self._lock, -1
        if lock >= 0:
            with suppress(OSError):
                os.ftruncate(lock, 0)
            os.close(lock)

    def fileno(self) -> int:
        return self._woken.fileno()

    def setblocking(self, flag: bool, /) -> None:
        self._woken.setblocking(flag)

    def accept(self) -> tuple[StreamSocket, object]:
        if not self._woken.recv(1):
            raise ConnectionAbortedError(errno.ECONNABORTED, "it no longer listens")
        found = self._waiting.popleft()
        if isinstance(found, str):
            raise StrangerError(found)
        return found, None

    def hang_up(self) -> None:
        self._closing = True
        with suppress(OSError):  # wakes the thread, which otherwise looks every two seconds
            socket.create_connection((_HOST, self._registration.port), CONNECT_TIMEOUT_S).close()
        self._thread.join()

    def _run(self) -> None:
        while not self._closing:
            try:
                sock, _ = self._listener.accept()
                if self._closing:  # it only woke this thread
                    sock.close()
                    break
                self._meet(sock)
            except (TimeoutError, ConnectionError):
                continue
            except Exception as error:  # noqa: BLE001  e.g. no more descriptors, memory or threads; others may come
                _log.warning("%s cannot accept: %r", self._name, error)
                time.sleep(_FAILED_S)
        self._listener.close()
        with suppress(OSError):  # wakes ``accept``, even if a process holds a copy of this socket
            self._bell.shutdown(socket.SHUT_RDWR)

    def _meet(self, sock: socket.socket) -> None:
        """Start to greet a stranger. If there are too many, the oldest gives way."""
        try:
            with self._meeting:
                oldest = next(iter(self._strangers), None) if len(self._strangers) >= MAX_STRANGERS else None
                if oldest is not None:
                    del self._strangers[oldest]
                    with suppress(OSError):  # its thread ends it
                        oldest.shutdown(socket.SHUT_RDWR)
                self._strangers[sock] = None
            if oldest is not None:
                self._pass_on(f"{_TURNED_AWAY}: others wanted to connect")
            threading.Thread(target=self._greet, args=(sock,), name="skyloop-greeting", daemon=True).start()
        except BaseException:
            self._part(sock)
            sock.close()
            raise

    def _part(self, sock: socket.socket) -> None:
        with self._meeting:
            self._strangers.pop(sock, None)

    def _greet(self, sock: socket.socket) -> None:
        found: StreamSocket | str = ""
        try:
            pid = _challenge(sock, self._registration, time.monotonic() + HANDSHAKE_S)
            found = StreamSocket(sock, Credentials(pid, own_uid(), 0), _TO_CLIENT)
        except StrangerError as error:
            found = f"{_TURNED_AWAY}: {error}"
        except TimeoutError:
            found = f"{_TURNED_AWAY}: it did not prove within {HANDSHAKE_S:g} s that it knows the secret"
        except OSError:
            pass  # it only looked who is there, or gave up
        finally:
            self._part(sock)
            if isinstance(found, str):
                sock.close()
        if found:
            self._pass_on(found)

    def _pass_on(self, found: StreamSocket | str) -> None:
        if len(self._waiting) < _MOST_WAITING:  # otherwise, the server is too busy to accept anybody
            self._waiting.append(found)
            with suppress(OSError):  # it no longer listens
                self._bell.send(b"\0")
