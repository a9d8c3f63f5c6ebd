"""A WebSocket server for Foxglove: live topics with the same schemas as recordings, and the drones' parameters.

The ``foxglove-sdk`` implements the protocol (https://github.com/foxglove/ws-protocol), sends from its own threads, and
drops the oldest messages if a viewer does not read. Any viewer can read parameters; writing one acquires a lease for a
short time.
"""

from __future__ import annotations

import contextlib
import ipaddress
import random
import re
import socket
import socketserver
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from time import monotonic_ns
from typing import Any, Final
from urllib.parse import urlsplit

from skyloop.address import is_loopback
from skyloop.client import Authority, Drone, connect
from skyloop.client.channels import Listener
from skyloop.errors import LinkError, MissingExtraError, ParameterError, SkyloopError, UnknownNameError, UsageError
from skyloop.extend import Known
from skyloop.messages import CameraInfo, Capabilities, Event, Parameter, ParameterType, Value
from skyloop.messages.frame import H264, Chain
from skyloop.platform import claim_port
from skyloop.recording import foxglove, layout
from skyloop.recording.backlog import Item
from skyloop.recording.foxglove import CompressedVideo
from skyloop.recording.layout import Channel, ClockPair, FrameRecord, Topic
from skyloop.recording.options import VIDEO
from skyloop.recording.taps import Parameters, Source, check_names
from skyloop.recording.translation import Message, Schema, TranslatedImage, Translator

PORT: Final = 8765  #: Foxglove's default
WAITING: Final = 512  #: number of messages queued per viewer before the oldest are dropped


class FoxgloveServer:
    """A :class:`skyloop.recording.taps.Screen` that serves any number of viewers."""

    def __init__(
        self, drones: Sequence[Drone], *, host: str = "127.0.0.1", port: int = PORT, priority: int | None = None
    ) -> None:
        """Start listening; port 0 selects a free port.

        ``priority``, from 0 (highest) to 31, is used for viewers' parameter writes; None forbids writing.

        Raises:
            UsageError: Two drones have the same name, or other machines would be able to write parameters.
            LinkError: Listening on the address failed.
            MissingExtraError: The extra ``[foxglove]`` is not installed.
        """
        check_names(drones, "view")
        if priority is not None and not is_loopback(host):
            raise UsageError(
                f"parameters can be written only from this machine, but {host} is open to others: Foxglove's "
                "protocol has no passwords. Leave out --write, or leave out --host and connect through ssh -L"
            )
        self._sdk = _sdk()
        clock = ClockPair.now()
        self._translators = [
            Translator(drone.name, drone.capabilities, clock, lambda drone=drone: drone.clock_offset_ns)  # type: ignore[misc]
            for drone in drones
        ]
        self._lock = threading.Lock()  # guards the next three attributes, which are modified on viewers' threads
        self._viewers: Counter[str] = Counter()  # number of viewers per topic
        self._began: set[str] = set()  # topics that have just gained a new subscriber
        self._starts: set[str] = set()  # topics that have just gained their first subscriber
        self._known: dict[str, tuple[ViewTopic, tuple[Source, ...]]] = {}
        for number, drone in enumerate(drones):
            for topic in topics(drone.name, drone.capabilities, far=Known(drone).is_far):
                before = self._known[topic.name][1] if topic.name in self._known else ()
                self._known[topic.name] = topic, (*before, *((number, channel) for channel in topic.channels))
        self._chains: dict[str, Chain] = {}  # H.264 frames sent to viewers so far, by topic
        self._ready = threading.Event()  # set once ``self._server`` exists, because viewers may connect earlier
        self._context = self._sdk.Context()
        self._channels = {name: self._channel(topic) for name, (topic, _) in self._known.items() if topic.at_once}
        self._parameters = ParameterAccess(drones, priority, self._parameter_changed)
        self._guard: OriginGuard | None = None  # set if parameters can be written: any web page could connect otherwise
        hidden = hidden_host()
        try:
            if priority is not None:
                self._guard = OriginGuard(host, port)
            self._server = self._sdk.start_server(
                name=f"skyloop: {', '.join(drone.name for drone in drones)}",
                host=host if self._guard is None else hidden,
                port=port if self._guard is None else 0,
                capabilities=[self._sdk.Capability.Parameters],
                server_listener=self,
                context=self._context,
                message_backlog_size=WAITING,
            )
        except (RuntimeError, OSError) as error:
            if self._guard is not None:
                self._guard.close()
            raise LinkError(f"can't listen on {host}:{port}: {error}; choose another --port, or 0 for any") from None
        # The SDK would log to Python while holding its own locks, and deadlock: another thread that holds the GIL may
        # be waiting for one of these locks.
        self._sdk._foxglove_py.disable_logging()
        self.host = host
        self.port: int = self._server.port
        if self._guard is not None:
            self._guard.behind, self.port = (hidden, self._server.port), self._guard.port
        self._ready.set()

    @property
    def url(self) -> str:
        """The address for Foxglove to connect to."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"ws://{host}:{self.port}"

    @property
    def viewers(self) -> dict[str, int]:
        """Number of subscribed viewers per topic. Safe to read from any thread."""
        with self._lock:
            return {topic: count for topic, count in self._viewers.items() if count > 0}

    # On the view's thread --------------------------------------------------------------------------------------

    def wanted(self) -> frozenset[Source]:
        """Return the sources needed for the topics that viewers have subscribed to."""
        with self._lock:
            found = {source for topic, count in self._viewers.items() if count > 0 for source in self._known[topic][1]}
            began, self._began = self._began, set()
            starts, self._starts = self._starts, set()
        for topic in starts:
            self._chains.pop(topic, None)
        if began:
            self._show_known(began)
        return frozenset(found)

    def show(self, item: Item) -> None:
        """Send a sample's messages to the viewers subscribed to them."""
        for message in self._translators[item.drone].messages(item):
            if isinstance(item.sample, TranslatedImage) and not self._decodable(message, item.sample):
                continue
            self._send(message)

    def close(self) -> None:
        """Stop listening and disconnect the viewers."""
        if self._guard is not None:
            self._guard.close()
        self._server.stop()
        self._parameters.close()
        for channel in self._channels.values():
            channel.close()

    def _show_known(self, began: set[str]) -> None:
        """Send new subscribers the data already known: parameters, mountings and calibrations."""
        for translator in self._translators:
            for message in translator.prelude(monotonic_ns()):
                if message.topic in began:
                    self._send(message)

    def _decodable(self, message: Message, picture: TranslatedImage) -> bool:
        """Return whether viewers can decode a message, given the messages already sent; a key frame must come first."""
        record = picture.record
        if record.format != H264 or message.kind is not CompressedVideo:
            return True
        if message.topic not in self.viewers:
            return False
        chain = self._chains.setdefault(message.topic, Chain())
        return chain.follows(record.header.seq, key=record.key)

    def _send(self, message: Message) -> None:
        channel = self._channels.get(message.topic)
        if channel is None:  # the images have an unexpected format
            known = self._known.get(message.topic)
            if known is None:
                return
            channel = self._channels[message.topic] = self._channel(known[0])
        if channel.has_sinks():
            channel.log(message.data, log_time=message.log_ns)

    def _channel(self, topic: ViewTopic) -> Any:
        schema = Schema.of(topic.kind)
        described = self._sdk.Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
        return self._sdk.Channel(
            topic.name, schema=described, message_encoding=schema.message_encoding, context=self._context
        )

    # On the SDK's threads, which call the listener; the SDK only logs exceptions raised here --------------------------

    def on_subscribe(self, client: Any, channel: Any) -> None:  # noqa: ARG002
        """Register a viewer's subscription."""
        with self._lock:
            self._viewers[channel.topic] += 1
            self._began.add(channel.topic)
            if self._viewers[channel.topic] == 1:
                self._starts.add(channel.topic)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:  # noqa: ARG002
        """Remove the subscription of a viewer that unsubscribed or disconnected."""
        with self._lock:
            self._viewers[channel.topic] -= 1

    def on_get_parameters(self, client: Any, param_names: list[str], request_id: str | None = None) -> list[Any]:  # noqa: ARG002
        """Return the named parameters, or all parameters."""
        self._ready.wait()
        self._parameters.follow()
        try:
            found = self._parameters.read(param_names)
        except SkyloopError as error:
            self._report(f"the parameters can't be read: {error.reason}", "parameters")
            return []
        return [self._parameter(name, value) for name, value in found.items()]

    def on_set_parameters(self, client: Any, parameters: list[Any], request_id: str | None = None) -> list[Any]:  # noqa: ARG002
        """Write parameters and return their values afterwards."""
        self._ready.wait()
        found = []
        for each in parameters:
            written = self._parameters.write(each.name, each.get_value())
            if written.refused:
                self._report(written.refused, written.name)
            else:
                self._server.remove_status([written.name])
            if written.value is not None:
                found.append(self._parameter(written.name, written.value))
        return found

    def on_parameters_subscribe(self, param_names: list[str]) -> None:  # noqa: ARG002
        """Report parameter changes from now on."""
        self._ready.wait()
        self._parameters.follow()

    def on_parameters_unsubscribe(self, param_names: list[str]) -> None: ...
    def on_client_advertise(self, client: Any, channel: Any) -> None: ...
    def on_client_unadvertise(self, client: Any, client_channel_id: int) -> None: ...
    def on_message_data(self, client: Any, client_channel_id: int, data: bytes) -> None: ...
    def on_connection_graph_subscribe(self) -> None: ...
    def on_connection_graph_unsubscribe(self) -> None: ...

    def _report(self, text: str, about: str) -> None:
        self._server.publish_status(text, self._sdk.StatusLevel.Warning, about)

    def _parameter_changed(self, name: str, value: Value) -> None:
        self._server.publish_parameter_values([self._parameter(name, value)])

    def _parameter(self, name: str, value: Value) -> Any:
        return self._sdk.Parameter(name, value=list(value) if isinstance(value, tuple) else value)


def _sdk() -> Any:
    try:
        import foxglove
    except ImportError as error:
        raise MissingExtraError("viewing in Foxglove", "foxglove", cause=str(error)) from None
    return foxglove


# Topics ---------------------------------------------------------------------------------------------------------


_OTHERS: Final = (Channel.FRAMES, Channel.DROPS)  # FRAMES has a topic per camera; DROPS is only written to files


@dataclass(frozen=True, slots=True)
class ViewTopic:
    """A topic that viewers can subscribe to."""

    name: str
    kind: type[Any]  #: class of the topic's messages; see :class:`skyloop.recording.translation.Message`
    channels: tuple[str, ...]  #: the drone's channels that the topic needs; empty for state that is known in advance
    at_once: bool = True  #: whether the topic is advertised before its first message


def topics(drone: str, capabilities: Capabilities, *, far: bool) -> Iterator[ViewTopic]:
    """Yield a drone's topics. ``far`` means that the drone's frames are encoded for the network."""
    for channel, kind in layout.TYPES.items():
        if channel not in _OTHERS:
            yield ViewTopic(str(Topic(drone, channel)), kind, (channel.value,))
    state, logs = (Channel.FEEDBACK.value,), (Channel.LOGS.value,)
    yield ViewTopic(layout.pose_topic(drone), foxglove.PoseInFrame, state)
    yield ViewTopic(layout.path_topic(drone), foxglove.PosesInFrame, state)
    yield ViewTopic(layout.TF, foxglove.FrameTransform, state)
    yield ViewTopic(layout.mocap_topic(drone), foxglove.PoseInFrame, logs)
    yield ViewTopic(layout.LOG, foxglove.Log, (Channel.EVENTS.value, *logs))
    for camera in capabilities.cameras:
        yield from _of_camera(drone, camera, far)


def _of_camera(drone: str, camera: CameraInfo, far: bool) -> Iterator[ViewTopic]:
    frames = (f"{VIDEO}.{camera.name}",)
    encoded = far or camera.stream == H264
    yield ViewTopic(str(Topic(drone, Channel.FRAMES, camera.name)), FrameRecord, frames)
    yield ViewTopic(layout.video_topic(drone, camera.name), foxglove.CompressedVideo, frames, encoded)
    yield ViewTopic(layout.image_topic(drone, camera.name), foxglove.CompressedImage, frames, not encoded)
    known = camera.intrinsics is not None
    calibration = layout.calibration_topic(drone, camera.name)
    yield ViewTopic(calibration, foxglove.CameraCalibration, () if known else frames)
    drawings = layout.drawing_topic(drone, camera.name)
    yield ViewTopic(drawings, foxglove.ImageAnnotations, (Channel.ANNOTATIONS.value,))


# Access: which web pages may connect, and how viewers read and write parameters ----------------------------------


READ_ONLY: Final = "this view is read-only: start it with --write to write parameters"


@dataclass(frozen=True, slots=True)
class Written:
    """The result of writing a parameter."""

    name: str  #: parameter name, prefixed with the drone's name
    value: Value | None  #: the current value; None if it could not be read
    refused: str = ""  #: why the write was refused; empty if the write succeeded


class ParameterAccess:
    """Reads and writes parameters by names such as ``alpha/limits.tilt``. Safe to use from any thread."""

    def __init__(
        self,
        drones: Sequence[Drone],
        priority: int | None,
        on_change: Callable[[str, Value], None] = lambda *_: None,
    ) -> None:
        """Initialise without sending any request.

        ``priority``, from 0 (highest) to 31, is used for writes; None forbids writing. ``on_change`` is called with a
        parameter's name and value on a separate thread: once for each when :meth:`follow` is called, and after changes.
        """
        self._drones = {drone.name: drone for drone in drones}
        self._priority = priority
        self._on_change = on_change
        self._lock = threading.Lock()  # serialises writes with the start of following
        self._following: list[tuple[Parameters, Listener[Event]]] = []

    def read(self, names: Iterable[str] = ()) -> dict[str, Value]:
        """Return the values of the named parameters, or of all; raise ``SkyloopError`` if a drone does not answer."""
        wanted = set(names)
        of = {name.partition("/")[0] for name in wanted} if wanted else self._drones.keys()
        found = {
            f"{drone.name}/{parameter.name}": parameter.value
            for name, drone in self._drones.items()
            if name in of
            for parameter in drone.config.parameters()
        }
        return {name: value for name, value in found.items() if not wanted or name in wanted}

    def write(self, name: str, value: object) -> Written:
        """Write a parameter and return its value afterwards."""
        refused = ""
        with self._lock:
            try:
                self._write(name, value)
            except SkyloopError as error:
                refused = f"{name} was not written: {error.reason}"
            return Written(name, self._present(name), refused)

    def follow(self) -> None:
        """Report every parameter once, then every change. Idempotent."""
        with self._lock:
            if self._following:
                return
            for drone in self._drones.values():
                followed = Parameters(drone, self._reporter(drone.name))
                self._following.append((followed, drone.on_event(followed.on_event, inline=True)))
                followed.start()

    def close(self) -> None:
        """Stop the reporting of changes."""
        for followed, listener in self._following:
            listener.cancel()
            followed.stop()

    def _reporter(self, drone: str) -> Callable[[Parameter], None]:
        return lambda parameter: self._on_change(f"{drone}/{parameter.name}", parameter.value)

    def _write(self, name: str, value: object) -> None:
        drone, key = self._found(name)
        parameter = drone.config.describe(key)
        if self._priority is None:
            raise ParameterError(READ_ONLY)
        authority = Authority(priority=self._priority)
        with connect(drone.name, authority=authority, name="skyloop view", on_exit="hover") as writer:
            writer.config[key] = _typed(parameter, value)

    def _present(self, name: str) -> Value | None:
        try:
            drone, key = self._found(name)
            return drone.config[key]
        except SkyloopError:
            return None

    def _found(self, name: str) -> tuple[Drone, str]:
        drone, _, key = name.partition("/")
        if drone not in self._drones:
            raise UnknownNameError("drone in this view", drone, self._drones)
        return self._drones[drone], key


def _typed(parameter: Parameter, value: object) -> object:
    """Convert a viewer's value to the parameter's type, because viewers send 1 for 1.0."""
    if parameter.type is ParameterType.FLOAT and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if parameter.type is ParameterType.INT and isinstance(value, float) and value.is_integer():
        return int(value)
    return value


# Origins --------------------------------------------------------------------------------------------------------


MAX_HEAD: Final = 16_384  #: maximum size of a request's head [bytes]
HEAD_S: Final = 5.0  #: time limit for receiving a request's head
_CHUNK: Final = 1 << 16  # maximum number of bytes to receive at once
_ORIGIN: Final = re.compile(rb"^origin[ \t]*:[ \t]*(.*?)[ \t]*\r?$", re.IGNORECASE | re.MULTILINE)
_FOXGLOVE: Final = "foxglove.dev"
_REFUSED: Final = (
    b"HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain\r\nConnection: close\r\n\r\n"
    b"pages of other origins can't connect while parameters are writable\n"
)


def is_trusted(origin: str) -> bool:
    """Return whether a page may connect: Foxglove's web page or desktop application, or a local page."""
    parts = urlsplit(origin)
    name = parts.hostname or ""
    if parts.scheme == "https" and (name == _FOXGLOVE or name.endswith(f".{_FOXGLOVE}")):
        return True
    if parts.scheme in ("http", "https"):
        return is_loopback(name)
    return parts.scheme == "file"  # Foxglove's desktop application; the origin "null", in contrast, could be any page


def hidden_host() -> str:
    """Return a random loopback address, which a page can't find by scanning ports."""
    if sys.platform != "linux":
        return "127.0.0.1"
    return str(ipaddress.IPv4Address((127 << 24) + random.SystemRandom().randrange(1 << 16, 1 << 24)))


class OriginGuard:
    """Listens until :meth:`close` is called, and forwards connections from trusted origins to the server."""

    def __init__(self, host: str, port: int) -> None:
        """Start listening; port 0 selects a free one. Raise ``OSError`` if listening on the address failed."""
        guard = self

        class Visitor(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                guard._accept(self.request)

        class Server(socketserver.ThreadingTCPServer):
            address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
            daemon_threads = True
            block_on_close = False

            def server_bind(self) -> None:
                claim_port(self.socket)
                super().server_bind()

            def handle_error(self, request: Any, client_address: Any) -> None: ...

        #: address and port of the server behind the guard; set before the port is announced
        self.behind: tuple[str, int] = ("", 0)
        self._server = Server((host, port), Visitor)
        self.port = int(self._server.server_address[1])  #: port that the guard listens on
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="skyloop-foxglove-guard", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop accepting connections. Existing connections end when the server stops."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _accept(self, visitor: socket.socket) -> None:
        visitor.settimeout(HEAD_S)
        head = b""
        while b"\r\n\r\n" not in head and len(head) < MAX_HEAD:
            if not (more := visitor.recv(_CHUNK)):
                return
            head += more
        # Browsers always name the page's origin when opening a WebSocket (RFC 6455, section 4.1); programs need not.
        origins = _ORIGIN.findall(head.partition(b"\r\n\r\n")[0])
        if len(head) >= MAX_HEAD or not all(is_trusted(origin.decode("latin-1")) for origin in origins):
            visitor.sendall(_REFUSED)
            return
        visitor.settimeout(None)
        with socket.create_connection(self.behind, timeout=HEAD_S) as server:
            server.settimeout(None)
            server.sendall(head)
            back = threading.Thread(target=_pump, args=(server, visitor), name="skyloop-foxglove-guard", daemon=True)
            back.start()
            _pump(visitor, server)
            back.join()


def _pump(source: socket.socket, target: socket.socket) -> None:
    """Copy bytes until either socket closes, then shut down both."""
    with contextlib.suppress(OSError):
        while data := source.recv(_CHUNK):
            target.sendall(data)
    for one in (source, target):
        with contextlib.suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)
