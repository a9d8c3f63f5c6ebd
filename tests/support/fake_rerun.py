"""A fake of Rerun's module, which has 790 MB: stores what is logged, with its time, and draws nothing."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import pytest


class Made:
    """An archetype or any other object, with its arguments."""

    def __init__(self, kind: str, *values: Any, **named: Any) -> None:
        self.kind = kind
        self.values = values
        self.named = named


class Stream:
    """A recording."""

    def __init__(self, application: str, *, recording_id: str) -> None:
        self.recording_id = recording_id
        self.logged: list[tuple[str, int | None, Made]] = []  #: entity, time (None if static), object
        self.target = ""
        self.closed = False
        self.broken = False
        self._now_ns: int | None = None

    def set_log_time_enabled(self, on: bool) -> None:
        assert not on

    def set_log_tick_enabled(self, on: bool) -> None:
        assert not on

    def save(self, path: str, *, default_blueprint: Made) -> None:
        if "nowhere" in path:
            raise RuntimeError("no such folder")
        self.target = path

    def connect_grpc(self, url: str, *, default_blueprint: Made) -> None:
        if not url.startswith("rerun"):
            raise ValueError("no scheme")
        self.target = url

    def set_time(self, timeline: str, *, timestamp: Any) -> None:
        assert timeline == "capture"
        self._now_ns = int(timestamp.astype("int64"))

    def log(self, entity: str, made: Made, *, static: bool = False) -> None:
        assert static or self._now_ns is not None, f"{entity} at no time"
        self.logged.append((entity, None if static else self._now_ns, made))

    def flush(self, *, timeout_sec: float) -> None:
        if self.broken:
            raise RuntimeError("the viewer is gone")

    def disconnect(self) -> None:
        self.closed = True

    def of(self, entity: str, kind: str = "") -> list[Made]:
        return [made for name, _, made in self.logged if name == entity and kind in ("", made.kind)]


class Module(ModuleType):
    """Creates any requested object, and stores the streams."""

    def __init__(self, name: str, streams: list[Stream]) -> None:
        super().__init__(name)
        self.streams = streams

    def __getattr__(self, kind: str) -> Any:
        if kind.startswith("__"):
            raise AttributeError(kind)

        def make(*values: Any, **named: Any) -> Made:
            return Made(kind, *values, **named)

        make.from_fields = make  # type: ignore[attr-defined]
        make.RDF = make.H264 = make.RIGHT_HAND_Z_UP = Made(kind)  # type: ignore[attr-defined]
        return make

    def unregister_shutdown(self) -> None: ...

    def RecordingStream(self, application: str, *, recording_id: str) -> Stream:  # noqa: N802
        self.streams.append(Stream(application, recording_id=recording_id))
        return self.streams[-1]

    def escape_entity_path_part(self, name: str) -> str:
        return name.replace(" ", "\\ ")


def install(monkeypatch: pytest.MonkeyPatch) -> list[Stream]:
    """Install the fake; return the list to which streams are added."""
    streams: list[Stream] = []
    module = Module("rerun", streams)
    module.blueprint = Module("rerun.blueprint", streams)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "rerun", module)
    monkeypatch.setitem(sys.modules, "rerun.blueprint", module.blueprint)
    return streams
