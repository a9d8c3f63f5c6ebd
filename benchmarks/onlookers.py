"""Start processes that watch while the pilot flies: observers, a recorder, cockpit pages, a Foxglove viewer."""

from __future__ import annotations

import json
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

from benchmarks.measuring.contract import Arrivals, Recorder
from benchmarks.measuring.ours import Listening
from benchmarks.measuring.schedule import VIDEO
from benchmarks.measuring.workers import Pipe
from skyloop.bench import CAMERA
from skyloop.client import connect
from skyloop.clock import nanoseconds
from skyloop.errors import LinkError, MissingExtraError

if TYPE_CHECKING:
    from skyloop.cockpit.testing import Pages

#: The message that makes an observer receive H.264, all in one format or each in its own.
SHARED: Final = "h264"
OWN: Final = "h264, own"
_KBIT_S: Final = 1000
_LOOK_S: Final = 0.02  #: shorter than the pause between two frames of a page


def observe(pipe: Pipe, proxy: str) -> None:
    """Run an observer of feedback and video, which connects on request and finally sends its arrivals."""
    pipe.send("ready")
    while (word := pipe.recv()) is not None:
        recorder = Recorder()
        listening = Listening(recorder.received)
        with connect(proxy, access="observe", name="observer") as drone:
            drone.on_feedback(listening.feedback, inline=True)
            if word in (SHARED, OWN):
                rate = _KBIT_S if word == SHARED else None
                drone.on_encoded(listening.picture, camera=CAMERA, kbit_s=rate, inline=True)
            else:
                drone.on_frame(listening.frame, camera=CAMERA, inline=True)
            pipe.send("connected")
            pipe.recv()
        pipe.send(recorder.arrivals)


def record(pipe: Pipe, proxy: str, file: str, fill: bool) -> None:
    """Run a recorder of everything; it finally sends the unrecorded samples by channel, and why it paused.

    Args:
        pipe: To the measuring process.
        proxy: The proxy's name.
        file: Where to record.
        fill: Whether to fill the disk to the last byte; the file is deleted afterwards.
    """
    from skyloop import recording
    from skyloop.recording.options import Options

    room_mb = 0.0 if fill else Options().min_free_mb
    with recording.record(proxy, file, in_process=True, overwrite=True, min_free_mb=room_mb) as recorder:
        pipe.send("ready")
        pipe.recv()
    if fill:
        for written in recorder.files:
            written.unlink(missing_ok=True)
    lost: dict[str, int] = {}
    for by_channel in (*recorder.dropped.values(), *recorder.missed.values()):
        for channel, number in by_channel.items():
            lost[channel] = lost.get(channel, 0) + number
    pipe.send((lost, recorder.reason))


def show(pipe: Pipe, proxy: str, number: int) -> None:
    """Run a cockpit; send its process id once ``number`` pages are open, and finally the ages of their frames."""
    from skyloop.cockpit.child import CockpitProcess
    from skyloop.cockpit.testing import Pages

    with (
        tempfile.TemporaryDirectory(prefix="bench-") as folder,
        CockpitProcess(proxy, recordings=Path(folder)) as cockpit,
        Pages(cockpit.address(), proxy, number) as pages,
    ):
        pipe.send(cockpit.pid)
        pipe.send(_ages(pipe, pages))


def serve(pipe: Pipe, proxy: str) -> None:
    """Run a live view for Foxglove; send its address."""
    from skyloop.recording.foxglove_server import FoxgloveServer
    from skyloop.recording.taps import View, give_way

    give_way()
    with connect(proxy, access="observe", name="view") as drone:
        server = FoxgloveServer([drone], port=0)
        with View([drone], server):
            pipe.send(server.url)
            pipe.recv()
    pipe.send("ended")


def look(pipe: Pipe, url: str) -> None:
    """Run a viewer that subscribes to everything served; it finally sends the number of messages."""
    from websockets.sync.client import connect as dial
    from websockets.typing import Subprotocol

    messages = 0
    with dial(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None, close_timeout=1.0) as socket:
        connected = False
        while not pipe.poll():
            try:
                data = socket.recv(timeout=_LOOK_S)
            except TimeoutError:
                continue
            if isinstance(data, bytes):
                messages += 1
                if not connected:
                    connected = True
                    pipe.send("connected")
                continue
            message = json.loads(data)
            if message["op"] == "advertise":
                each = [{"id": channel["id"], "channelId": channel["id"]} for channel in message["channels"]]
                socket.send(json.dumps({"op": "subscribe", "subscriptions": each}))
    pipe.recv()
    pipe.send(messages)


def _ages(pipe: Pipe, pages: Pages) -> Arrivals:
    """Return the frames that the pages receive, until a message arrives through the pipe."""
    arrivals: Arrivals = {VIDEO: []}
    seen = [0] * len(pages.clients)
    while not pipe.poll(_LOOK_S):
        now_ns = time.monotonic_ns()
        for index, page in enumerate(pages.clients):
            frames, age_s = page.frames, page.newest_age_s
            if frames > seen[index] and age_s is not None:
                seen[index] = frames
                arrivals[VIDEO].append((now_ns - nanoseconds(age_s), now_ns))
    if pages.problem is not None:
        raise LinkError(f"the pages ended: {pages.problem}")
    pipe.recv()
    return arrivals


def recorder_problem() -> str:
    """Return why recording is impossible here; empty if it is possible."""
    try:
        from skyloop.recording.recorder import check_installed

        check_installed()
    except ImportError as error:  # also if a part is not installed
        return str(error)
    return ""


def view_problem() -> str:
    """Return why viewing in Foxglove is impossible here; empty if it is possible."""
    missing = [name for name in ("foxglove", "foxglove_schemas_protobuf", "cv2") if find_spec(name) is None]
    if missing:
        return str(MissingExtraError("viewing in Foxglove", "foxglove", cause=f"no {', '.join(missing)}"))
    return "" if find_spec("websockets") else str(MissingExtraError("a viewer", "cockpit", cause="no websockets"))


def cockpit_problem() -> str:
    """Return why a cockpit can't be opened here; empty if it can."""
    missing = [name for name in ("starlette", "uvicorn", "websockets", "cv2") if find_spec(name) is None]
    return str(MissingExtraError("the cockpit", "cockpit", cause=f"no {', '.join(missing)}")) if missing else ""
