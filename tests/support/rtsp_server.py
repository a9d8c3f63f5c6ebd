"""An RTSP camera for tests: one H.264 stream, over TCP or UDP, to any number of clients.

The part of RTSP 1.0 (RFC 2326) that a client needs: OPTIONS, DESCRIBE, SETUP, PLAY, GET_PARAMETER, TEARDOWN. The
pictures travel as RTP (RFC 3550, 5.1), in single NAL units and in fragments, FU-A (RFC 6184, 5.6 and 5.8), each with
a header of four bytes on the RTSP connection itself (RFC 2326, 10.12), or as datagrams. There is no RTCP.
"""

from __future__ import annotations

import base64
import re
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Final

HOST: Final = "127.0.0.1"
CLOCK_HZ: Final = 90_000  #: clock of the stamps, RFC 6184, 8.2.1
PAYLOAD_TYPE: Final = 96
_SSRC: Final = 0x5C410000
_FU_A: Final = 28
_SPS, _PPS = 7, 8
_START_CODE: Final = re.compile(rb"\x00{2,3}\x01")
_SEND_S: Final = 5.0


def units_of(stream: bytes) -> list[bytes]:
    """Return the NAL units of a stream in Annex B form."""
    return [unit for unit in _START_CODE.split(stream) if unit]


def payloads_of(unit: bytes, most: int) -> Iterator[bytes]:
    """Return a NAL unit as payloads of at most this many bytes: a single one, or fragments."""
    if len(unit) <= most:
        yield unit
        return
    indicator, kind = unit[0] & 0xE0 | _FU_A, unit[0] & 0x1F
    body, step = unit[1:], most - 2
    for start in range(0, len(body), step):
        first, last = start == 0, start + step >= len(body)
        yield bytes((indicator, first << 7 | last << 6 | kind)) + body[start : start + step]


class RtpPacker:
    """Packs pictures as numbered RTP packets with payloads of at most ``most`` bytes."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._sequence = 0

    def packets(self, picture: bytes, stamp_s: float) -> list[bytes]:
        """Return the packets of a picture in Annex B form; the last one has the marker, RFC 6184, 5.1."""
        payloads = [payload for unit in units_of(picture) for payload in payloads_of(unit, self._most)]
        stamp = round(stamp_s * CLOCK_HZ) & 0xFFFFFFFF
        made = []
        for n, payload in enumerate(payloads):
            marker = (n == len(payloads) - 1) << 7
            header = struct.pack("!BBHII", 0x80, marker | PAYLOAD_TYPE, self._sequence & 0xFFFF, stamp, _SSRC)
            self._sequence += 1
            made.append(header + payload)
        return made


class RtspSession:
    """One client's connection."""

    def __init__(self, server: RtspServer, connection: socket.socket) -> None:
        self._server = server
        self._connection = connection
        self._lock = threading.Lock()  # replies and pictures share the connection
        self._udp: socket.socket | None = None
        self._packer = RtpPacker(server.most)
        self.playing = False
        connection.settimeout(_SEND_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def serve(self) -> None:
        """Serve until the client or the server ends."""
        held = b""
        self._connection.settimeout(None)
        while data := self._connection.recv(65536):
            held += data
            while held:
                if held[0] == ord("$"):  # the client's RTCP
                    size = 4 + int.from_bytes(held[2:4], "big")
                    if len(held) < max(4, size):
                        break
                    held = held[size:]
                    continue
                request, end, rest = held.partition(b"\r\n\r\n")
                if not end:
                    break
                held = rest
                if not self._answer(request.decode("latin-1")):
                    return

    def send(self, picture: bytes, stamp_s: float) -> None:
        for packet in self._packer.packets(picture, stamp_s):
            self._send_packet(packet)

    def close(self, *, abruptly: bool = False) -> None:
        self.playing = False
        with suppress(OSError):
            if abruptly:
                self._connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()
        if self._udp is not None:
            self._udp.close()

    def _send_packet(self, packet: bytes) -> None:
        with suppress(OSError):  # the client has left
            if self._udp is not None:
                self._udp.send(packet)
                return
            with self._lock:
                self._connection.sendall(b"$\0" + struct.pack("!H", len(packet)) + packet)

    def _answer(self, request: str) -> bool:
        """Answer a request; return whether the session continues."""
        first, *lines = request.split("\r\n")
        method, url, _ = (*first.split(" "), "", "")[:3]
        fields = {name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
        self._server.requests.append(method)
        sequence = fields.get("cseq", "0")
        if not self._server.knows(fields.get("authorization", "")):
            self._reply(sequence, "401 Unauthorized", 'WWW-Authenticate: Basic realm="camera"')
        elif method in ("OPTIONS", "GET_PARAMETER"):
            self._reply(sequence, "200 OK", "Public: OPTIONS, DESCRIBE, SETUP, PLAY, GET_PARAMETER, TEARDOWN")
        elif self._server.path not in url:
            self._reply(sequence, "404 Not Found")
        elif method == "DESCRIBE":
            self._reply(sequence, "200 OK", f"Content-Base: {url}/", "Content-Type: application/sdp", self._server.sdp)
        elif method == "SETUP":
            self._set_up(sequence, fields.get("transport", ""))
        elif method == "PLAY":
            self._reply(sequence, "200 OK", "Session: 1", "Range: npt=0.000-")
            self._server.plays(self)
        elif method == "TEARDOWN":
            self._reply(sequence, "200 OK")
            return False
        else:
            self._reply(sequence, "405 Method Not Allowed")
        return True

    def _set_up(self, sequence: str, transport: str) -> None:
        ports = re.search(r"client_port=(\d+)", transport)
        if "/TCP" in transport and "tcp" in self._server.ways:
            self._reply(sequence, "200 OK", "Transport: RTP/AVP/TCP;unicast;interleaved=0-1", "Session: 1")
        elif "/TCP" not in transport and ports and "udp" in self._server.ways:
            self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._udp.bind((HOST, 0))
            self._udp.connect((HOST, int(ports[1])))
            ours = self._udp.getsockname()[1]
            self._reply(
                sequence,
                "200 OK",
                f"Transport: RTP/AVP;unicast;client_port={ports[1]}-{int(ports[1]) + 1};server_port={ours}-{ours + 1}",
                "Session: 1",
            )
        else:
            self._reply(sequence, "461 Unsupported Transport")

    def _reply(self, sequence: str, status: str, *fields: str) -> None:
        """Send a reply; a last field of several lines is the body."""
        body = fields[-1] if fields and "\r\n" in fields[-1] else ""
        lines = [f"RTSP/1.0 {status}", f"CSeq: {sequence}", *(fields[:-1] if body else fields)]
        if body:
            lines.append(f"Content-Length: {len(body)}")
        with self._lock:
            self._connection.sendall(("\r\n".join(lines) + "\r\n\r\n" + body).encode("latin-1"))


class RtspServer:
    """Starts and stops any number of times, on one port. The SDP has the SPS and PPS of the key picture ``parameters``.

    ``most``: maximum bytes of an RTP payload. ``user``: ``NAME:PASSWORD`` that a client must give.
    """

    def __init__(self, parameters: bytes = b"", *, ways: tuple[str, ...] = ("tcp", "udp"), user: str = "") -> None:
        self.ways = ways
        self.path = "/live"
        self.most = 300  # small, so that small pictures are fragmented too
        self.requests: list[str] = []
        self._user = user
        self._parameters = [unit for unit in units_of(parameters) if unit[0] & 31 in (_SPS, _PPS)]
        self._sessions: list[RtspSession] = []
        self._changed = threading.Condition()
        self._listener: socket.socket | None = None
        self.port = 0
        self._threads: list[threading.Thread] = []

    @property
    def address(self) -> str:
        return f"rtsp://{HOST}:{self.port}{self.path}"

    @property
    def sdp(self) -> str:
        """Return the SDP (RFC 4566) with the parameters of RFC 6184, 8.1."""
        told = ",".join(base64.b64encode(unit).decode() for unit in self._parameters)
        known = f";sprop-parameter-sets={told}" if told else ""
        return (
            f"v=0\r\no=- 0 0 IN IP4 {HOST}\r\ns=camera\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\n"
            f"m=video 0 RTP/AVP {PAYLOAD_TYPE}\r\na=rtpmap:{PAYLOAD_TYPE} H264/{CLOCK_HZ}\r\n"
            f"a=fmtp:{PAYLOAD_TYPE} packetization-mode=1{known}\r\na=control:track1\r\n"
        )

    def __enter__(self) -> RtspServer:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        self._listener = socket.create_server((HOST, self.port))
        self.port = self._listener.getsockname()[1]
        thread = threading.Thread(target=self._accept, args=(self._listener,), daemon=True)
        self._threads = [thread]
        thread.start()

    def stop(self, *, abruptly: bool = False) -> None:
        """Stop; ``abruptly`` resets connections, as when a process is killed with unread data."""
        if self._listener is not None:
            with suppress(OSError):
                self._listener.shutdown(socket.SHUT_RDWR)
            self._listener.close()
            self._listener = None
        with self._changed:
            sessions, self._sessions = self._sessions, []
        for session in sessions:
            session.close(abruptly=abruptly)
        for thread in self._threads:
            thread.join(_SEND_S)
            assert not thread.is_alive()

    def send(self, picture: bytes, stamp_s: float) -> None:
        """Send a picture in Annex B form to every playing client."""
        with self._changed:
            playing = [session for session in self._sessions if session.playing]
        for session in playing:
            session.send(picture, stamp_s)

    def wait_for_player(self, timeout_s: float) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: any(session.playing for session in self._sessions), timeout_s)

    # For sessions ------------------------------------------------------------------------------------------------

    def knows(self, authorization: str) -> bool:
        return not self._user or authorization == f"Basic {base64.b64encode(self._user.encode()).decode()}"

    def plays(self, session: RtspSession) -> None:
        with self._changed:
            session.playing = True
            self._changed.notify_all()

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            session = RtspSession(self, connection)
            with self._changed:
                if self._listener is None:
                    session.close()
                    return
                self._sessions.append(session)
            thread = threading.Thread(target=self._serve, args=(session,), daemon=True)
            self._threads.append(thread)
            thread.start()

    def _serve(self, session: RtspSession) -> None:
        with suppress(OSError):
            session.serve()
        with self._changed:
            if session in self._sessions:
                self._sessions.remove(session)
        session.close()


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])
