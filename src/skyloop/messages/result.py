"""What a processor made of a frame, and how the workers of one processor share the frames.

Relayed by the proxy on the topics ``results`` (all) and ``results/NAME`` (one processor's).
"""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from skyloop.messages.frame import Name
from skyloop.messages.numbers import Count, TimeNs

MAX_PAYLOAD: Final = 32_768  #: bytes of a result's value, packed
MAX_CODE: Final = 128  #: characters of what identifies the code of a processor
MAX_PARTS: Final = 1024  #: of a camera's frames, of which each worker takes one
PROCESSOR_NAME: Final = r"^[A-Za-z0-9_.-]{1,64}$"
ProcessorName = Annotated[str, msgspec.Meta(pattern=PROCESSOR_NAME, min_length=1, max_length=64)]


class ProcessorResult(msgspec.Struct, frozen=True, array_like=True):
    """What a processor made of one frame."""

    processor: ProcessorName
    camera: Name
    seq: Count  #: of the frame
    captured_ns: TimeNs  #: of the frame
    made_ns: TimeNs  #: when the result was there, on the proxy's clock
    took_ns: Count  #: how long the worker's ``process`` ran
    number: Count  #: grows by one with each result of a worker
    payload: Annotated[bytes, msgspec.Meta(max_length=MAX_PAYLOAD)]  #: see ``skyloop.messages.relayed``
    worker: Count = 0  #: number of the application that sent it; written by the proxy, whatever was there


class ProcessorShare(msgspec.Struct, frozen=True, array_like=True):
    """Tells a worker which frames are its own: those with ``seq % parts == part``."""

    processor: ProcessorName
    camera: Name
    part: Count  #: from 0
    #: 0: no frame, for it stated that it can take none; 1: every frame
    parts: Annotated[int, msgspec.Meta(ge=0, le=MAX_PARTS)]
    workers: Count  #: of this processor and camera, those that can take none included

    def __post_init__(self) -> None:
        if self.part >= max(1, self.parts):
            raise ValueError(f"part {self.part} of {self.parts} is none")
