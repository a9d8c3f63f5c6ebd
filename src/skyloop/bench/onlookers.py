"""Processes that look on while the pilot flies: observers and a recorder."""

from __future__ import annotations

from skyloop.bench.contract import Recorder
from skyloop.bench.ours import Listening
from skyloop.bench.vehicle import CAMERA
from skyloop.bench.workers import Pipe
from skyloop.client import connect


def observe(pipe: Pipe, proxy: str) -> None:
    """An observer of feedback and video: connects when told to, and at the end says what it heard."""
    pipe.send("ready")
    while pipe.recv() is not None:
        heard = Recorder()
        listening = Listening(heard.heard)
        with connect(proxy, access="observe", name="observer") as drone:
            drone.on_feedback(listening.feedback, inline=True)
            drone.add_processor(listening.frame, camera=CAMERA, inline=True)
            pipe.send("connected")
            pipe.recv()
        pipe.send(heard.arrivals)


def record(pipe: Pipe, proxy: str, file: str) -> None:
    """A recorder of everything, and at the end what it could not record, by channel."""
    from skyloop import recording

    with recording.record(proxy, file, in_process=True, overwrite=True) as recorder:
        pipe.send("ready")
        pipe.recv()
    lost: dict[str, int] = {}
    for by_channel in (*recorder.dropped.values(), *recorder.missed.values()):
        for channel, number in by_channel.items():
            lost[channel] = lost.get(channel, 0) + number
    pipe.send(lost)


def recorder_problem() -> str:
    """Why nothing can be recorded here; empty if it can."""
    try:
        from skyloop.recording.child import check_installed

        check_installed()
    except ImportError as error:  # a part that is not installed is one too
        return str(error)
    return ""
