"""WebRTC through aiortc: video as a track, commands and feedback as unordered data channels without retransmission.

Runs under an interpreter with ``aiortc``, which need not be Skyloop's own. The two ends exchange their offer and answer
over TCP at the vehicle's address; no other servers are involved.
"""

from __future__ import annotations

import asyncio
import json
import queue
import struct
import threading
import time
from collections.abc import Coroutine
from fractions import Fraction
from typing import Any

from aiortc import (
    MediaStreamTrack,
    RTCConfiguration,
    RTCPeerConnection,
    RTCSessionDescription,
)
from aiortc.mediastreams import MediaStreamError
from av import VideoFrame

from benchmarks.measuring.contract import Image, Received
from benchmarks.measuring.schedule import COMMAND, FEEDBACK, MIDDLE, VIDEO
from benchmarks.measuring.waypoints import Setpoint
from benchmarks.moving_scene import MovingScene, stamp_in
from benchmarks.video_judge import Judge

_CONNECTED_WITHIN_S = 15.0
_STAMP = struct.Struct("<q")
_FEEDBACK_BYTES = bytes(200)  # about the size of ours
_COMMAND_BYTES = bytes(60)
_CLOCK_HZ = 90_000


class _End:
    """A peer connection, and the thread of its event loop."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="webrtc", daemon=True)
        self._thread.start()
        self._connection: Any = None
        self._channels: dict[str, Any] = {}
        self._open = threading.Event()

    def _run(self, work: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result(_CONNECTED_WITHIN_S)

    def _make(self) -> None:
        self._connection = RTCPeerConnection(RTCConfiguration(iceServers=[]))

    def _channel(self, name: str) -> None:
        channel = self._connection.createDataChannel(name, ordered=False, maxRetransmits=0)
        self._channels[name] = channel

    def _say(self, name: str, sent_ns: int, padding: bytes) -> None:
        def send() -> None:
            channel = self._channels.get(name)
            if channel is not None and channel.readyState == "open":
                channel.send(_STAMP.pack(sent_ns) + padding)

        self._loop.call_soon_threadsafe(send)

    def close(self) -> None:
        self._run(self._connection.close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


class _Camera(MediaStreamTrack):  # type: ignore[misc]
    """A track that sends each newest picture once."""

    kind = "video"

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._loop = loop
        self._newest: tuple[int, Image] | None = None
        self._changed = asyncio.Event()

    def show(self, sent_ns: int, image: Image) -> None:
        """Set the next picture. Any thread."""
        self._loop.call_soon_threadsafe(self._take, (sent_ns, image))

    def _take(self, newest: tuple[int, Image]) -> None:
        self._newest = newest
        self._changed.set()

    async def recv(self) -> VideoFrame:
        await self._changed.wait()
        self._changed.clear()
        assert self._newest is not None
        sent_ns, image = self._newest
        frame = VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts, frame.time_base = sent_ns * _CLOCK_HZ // 1_000_000_000, Fraction(1, _CLOCK_HZ)
        return frame


class Vehicle(_End):
    def __init__(self, address: str, received: Received) -> None:
        super().__init__()
        self._received = received
        self._scene = MovingScene(MIDDLE)
        self._camera = _Camera(self._loop)
        self._server: Any = None
        self._run(self._listen(*address.rsplit(":", 1)))

    async def _listen(self, host: str, port: str) -> None:
        self._server = await asyncio.start_server(self._meet, host, int(port))

    async def _meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._make()
        self._connection.addTrack(self._camera)
        self._channel(FEEDBACK)

        @self._connection.on("datachannel")  # type: ignore[untyped-decorator]
        def opened(channel: Any) -> None:
            @channel.on("message")  # type: ignore[untyped-decorator]
            def told(message: bytes) -> None:
                self._received(COMMAND, _STAMP.unpack_from(message)[0])

        offer = RTCSessionDescription(**json.loads(await reader.readline()))
        await self._connection.setRemoteDescription(offer)
        await self._connection.setLocalDescription(await self._connection.createAnswer())
        await _tell(writer, self._connection.localDescription)
        writer.close()

    def feedback(self, sent_ns: int) -> None:
        self._say(FEEDBACK, sent_ns, _FEEDBACK_BYTES)

    def frame(self, sent_ns: int, image: Image) -> None:  # noqa: ARG002  (a moving scene instead)
        self._camera.show(sent_ns, self._scene.picture(sent_ns))

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._server.close)
        self._camera.stop()
        super().close()


class Application(_End):
    def __init__(self, address: str, received: Received) -> None:
        super().__init__()
        self._received = received
        self._judge = Judge(received)
        self._pictures: queue.SimpleQueue[tuple[int, Image] | None] = queue.SimpleQueue()
        self._judging = threading.Thread(target=self._judge_all, name="judge", daemon=True)
        self._judging.start()
        self._run(self._call(*address.rsplit(":", 1)))
        if not self._open.wait(_CONNECTED_WITHIN_S):
            raise TimeoutError(f"WebRTC was not connected within {_CONNECTED_WITHIN_S:g} s")

    async def _call(self, host: str, port: str) -> None:
        self._make()
        self._connection.addTransceiver("video", direction="recvonly")
        self._channel(COMMAND)
        self._channels[COMMAND].on("open", self._open.set)

        @self._connection.on("track")  # type: ignore[untyped-decorator]
        def track(video: Any) -> None:
            self._watching = asyncio.ensure_future(self._watch(video))

        @self._connection.on("datachannel")  # type: ignore[untyped-decorator]
        def opened(channel: Any) -> None:
            @channel.on("message")  # type: ignore[untyped-decorator]
            def told(message: bytes) -> None:
                self._received(FEEDBACK, _STAMP.unpack_from(message)[0])

        await self._connection.setLocalDescription(await self._connection.createOffer())
        reader, writer = await asyncio.open_connection(host, int(port))
        await _tell(writer, self._connection.localDescription)
        await self._connection.setRemoteDescription(RTCSessionDescription(**json.loads(await reader.readline())))
        writer.close()

    async def _watch(self, video: Any) -> None:
        while True:
            try:
                frame = await video.recv()
            except MediaStreamError:
                return
            image = frame.to_ndarray(format="bgr24")
            stamp_ns = stamp_in(image, time.monotonic_ns())
            self._received(VIDEO, stamp_ns)
            self._pictures.put((stamp_ns, image))

    def _judge_all(self) -> None:
        while (found := self._pictures.get()) is not None:
            self._judge.look(found[1], found[0])

    def command(self, sent_ns: int, setpoint: Setpoint) -> None:  # noqa: ARG002  (only its size matters, which equals ours)
        self._say(COMMAND, sent_ns, _COMMAND_BYTES)

    def close(self) -> None:
        super().close()
        self._pictures.put(None)
        self._judging.join()


async def _tell(writer: asyncio.StreamWriter, description: Any) -> None:
    writer.write(json.dumps({"sdp": description.sdp, "type": description.type}).encode() + b"\n")
    await writer.drain()
