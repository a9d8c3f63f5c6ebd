"""The video port of an AR.Drone: :class:`skyloop.drivers.live_video.LiveVideo` with its streams and decoders."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from skyloop.clock import Clock, monotonic_ns
from skyloop.drivers.ardrone.decoding import make_decoder
from skyloop.drivers.ardrone.streams import open_stream
from skyloop.drivers.backlog import Coded
from skyloop.drivers.live_video import LiveVideo, Notice, Picture, VideoCounters
from skyloop.errors import UsageError

__all__ = ["Notice", "Picture", "VideoCounters", "VideoReceiver"]


class VideoReceiver(LiveVideo):
    """Of an AR.Drone 1 or 2."""

    def __init__(
        self,
        host: str,
        port: int,
        *,
        version: int,
        show: Callable[[Picture], None],
        told: Callable[[Notice, str], None],
        wants: Callable[[], bool] = lambda: True,
        came: Callable[[Coded], None] | None = None,
        clock: Clock = monotonic_ns,
    ) -> None:
        """No I/O. Raises :class:`UsageError` for a version other than 1 and 2."""
        if version not in (1, 2):
            raise UsageError(f"there is an AR.Drone 1 and an AR.Drone 2, not {version}")

        super().__init__(
            f"{host}:{port}",
            connect=lambda connection: open_stream(version, host, port, connection, clock),
            make_decoder=partial(make_decoder, version),
            show=show,
            told=told,
            wants=wants,
            came=came,
            clock=clock,
            name="ardrone-video",
        )
