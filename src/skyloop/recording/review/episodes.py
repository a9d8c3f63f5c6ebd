"""Convert recorded flights to episodes for learning: rows at a constant rate, each with an observation and an action.

Everything except the video is computed from the recording's tables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.errors import FileFormatError, MissingExtraError, UsageError
from skyloop.files import replacing
from skyloop.messages import FlightState
from skyloop.messages.rows import ACTIONS, STATE
from skyloop.recording.reader import Recording
from skyloop.recording.review.tables import Table
from skyloop.recording.review.video import even

MARK: Final = "mark"  #: name of the logged text that starts a new episode and names its task
TAUGHT: Final = "action"  #: name of the logged arrays that hold the demonstrated action for an image
_STILL: Final = "hover"
_STEERED: Final = (FlightState.HOVERING.value, FlightState.FLYING.value)
_GAP_S: Final = 0.5  #: an episode ends after this time without an image or state
_SHORTEST_S: Final = 1.0  # minimum duration of an episode; shorter ones are skipped

Floats = NDArray[np.float64]
Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class RowFormat:
    """Defines the columns that each row has."""

    state: tuple[str, ...]  #: names of the values in the state, from :data:`~skyloop.messages.rows.STATE`
    set_point: str  #: kind of commanded set-point, a key of :data:`~skyloop.messages.rows.ACTIONS`
    cameras: tuple[str, ...]  #: cameras whose images each row includes
    fps: float  #: rows per second

    @property
    def action(self) -> tuple[str, ...]:
        """Names of the values in the action."""
        return ACTIONS[self.set_point]


@dataclass(frozen=True, slots=True)
class Episode:
    """One flight, or a part of a flight that the application has marked."""

    task: str  #: description of the task
    state: Floats  #: state when the first camera's image was captured, shape (rows, len(form.state)), float64
    #: action that was demonstrated, or commanded by the time of the next row, shape (rows, len(form.action)), float64
    action: Floats
    frames_ns: Mapping[str, Times]  #: capture time of each row's image by camera, on the proxy's clock, shape (rows,)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.state)


def row_format_of(tables: Mapping[str, Table], cameras: Sequence[str], fps: float) -> RowFormat:
    """Return the columns available in every row of a recording.

    Raise ``FileFormatError`` if the recording has no feedback, no set-points, or no frames of a camera, and
    ``UsageError`` if it was flown with positions or several kinds of set-points.
    """
    feedback, commands = tables.get("feedback"), tables.get("commands")
    state = tuple(name for name in STATE if feedback is not None and feedback.known(name))
    if not state:
        raise FileFormatError("the recording has no state of the drone: record the feedback channel")
    for camera in cameras:
        if f"frames.{camera}" not in tables:
            raise FileFormatError(f"the recording has no frames of {camera}")
    asked: set[str] = set() if commands is None else {str(name) for name in commands["asked"][_piloted(commands)]}
    kinds = asked & (ACTIONS.keys() | {"position"})
    if not kinds:
        raise FileFormatError("the recording has no set-points from an application, so there is nothing to learn")
    if len(kinds) > 1 or kinds == {"position"}:
        raise UsageError(
            f"the recorded flight used {' and '.join(sorted(kinds))} set-points: an action is either velocity "
            "(forward, left, up, yaw rate) or attitude (roll, pitch, climb, yaw rate)"
        )
    return RowFormat(state, kinds.pop(), tuple(cameras), fps)


def episodes(tables: Mapping[str, Table], form: RowFormat, task: str) -> list[Episode]:
    """Cut a recording into episodes.

    An episode lasts while the drone follows set-points without a gap in its images or state. Marks split episodes. Its
    rows are ``1 / form.fps`` apart. Each contains the newest image from every camera, the state at the first camera's
    capture time, and the set-point in effect when the next row begins, which is the response to that image. Hovering is
    stored as an all-zero set-point. If an application logs arrays named ``action``, these are used as the actions
    instead: each row has the first of these actions at or after its image's capture, and a gap in them ends an episode.
    ``task`` names the task where no mark does. Episodes shorter than a second are skipped.

    Raise ``FileFormatError`` if the number of values of a logged action differs from that of the form's set-points.
    """
    feedback, commands = tables["feedback"], tables["commands"]
    state_ns = _times(feedback, "captured_ns")
    frames = {camera: np.sort(_times(tables[f"frames.{camera}"], "captured_ns")) for camera in form.cameras}
    taught = _taught(tables.get("logs"), form)
    found = []
    for begin_ns, end_ns, what in _parts(feedback, tables.get("logs"), task):
        grid = np.arange(begin_ns, end_ns, NS_PER_S / form.fps).astype(np.int64)
        rows = {camera: np.searchsorted(times, grid, side="right") - 1 for camera, times in frames.items()}
        shown = {camera: frames[camera][np.maximum(row, 0)] for camera, row in rows.items()}
        good = np.ones(len(grid), np.bool_)
        for camera, row in rows.items():
            good &= (row >= 0) & (grid - shown[camera] < nanoseconds(_GAP_S))
        at_ns = shown[form.cameras[0]] if form.cameras else grid
        nearest = np.searchsorted(state_ns, at_ns).clip(1, max(len(state_ns) - 1, 1))
        good &= np.abs(state_ns[nearest - 1] - at_ns) < nanoseconds(_GAP_S)
        state, action = _states(feedback, form, at_ns), _actions(commands, form, grid + round(NS_PER_S / form.fps))
        if taught is not None:
            answers_ns, answers = taught
            answered = np.searchsorted(answers_ns, at_ns).clip(max=len(answers) - 1)
            good &= (answers_ns[answered] >= at_ns) & (answers_ns[answered] - at_ns < nanoseconds(_GAP_S))
            action = answers[answered]
        for part in _runs(good):
            if (part.stop - part.start) / form.fps >= _SHORTEST_S:
                pictures = {camera: times[part] for camera, times in shown.items()}
                found.append(Episode(what, state[part], action[part], pictures))
    return found


def _times(table: Table, column: str) -> Times:
    return np.asarray(table[column], np.int64)


def _piloted(commands: Table) -> NDArray[np.bool_]:
    """Return which commands were sent by an application rather than by the proxy."""
    given: NDArray[np.bool_] = commands.numbers("app_id") > 0
    return given


def _taught(logs: Table | None, form: RowFormat) -> tuple[Times, Floats] | None:
    """Return times and values of the logged actions, or None if there are none."""
    if logs is None or "values" not in logs.columns:
        return None
    kept = (logs["name"] == TAUGHT) & (logs["values"] != "")
    if not kept.any():
        return None
    rows = [[float(number) for number in text.split()] for text in logs["values"][kept]]
    if any(len(row) != len(form.action) for row in rows):
        raise FileFormatError(
            f"an array logged as {TAUGHT} must have the {len(form.action)} numbers of a set-point "
            f"({', '.join(form.action)})"
        )
    times = _times(logs, "at_ns")[kept]
    order = np.argsort(times, kind="stable")
    return times[order], np.array(rows, np.float64)[order]


def _parts(feedback: Table, logs: Table | None, task: str) -> list[tuple[int, int, str]]:
    """Return the start [ns], end [ns] and task of each period in which the drone follows set-points, split at marks."""
    times, steered = _times(feedback, "captured_ns"), np.isin(feedback["state"], _STEERED)
    marks: list[tuple[int, str]] = []
    if logs is not None and "text" in logs.columns:
        marked = (logs["name"] == MARK) & (logs["text"] != "")
        # Times in a table are relative, and a mark is stored at the time it was received, between two states.
        for t_s, text in zip(logs.numbers("t_s")[marked], logs["text"][marked], strict=True):
            marks.append((int(np.interp(t_s, feedback.numbers("t_s"), times)), str(text)))
    parts = []
    for run in _runs(steered):
        begin_ns, end_ns = int(times[run.start]), int(times[run.stop - 1])
        what = task
        for at_ns, text in marks:
            if at_ns >= end_ns:
                break
            if at_ns > begin_ns:
                parts.append((begin_ns, at_ns, what))
                begin_ns = at_ns
            what = text
        parts.append((begin_ns, end_ns, what))
    return parts


def _runs(good: NDArray[np.bool_]) -> list[slice]:
    """Return the runs of consecutive true values."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], good, [False])).astype(np.int8)))
    return [slice(int(begin), int(end)) for begin, end in zip(edges[::2], edges[1::2], strict=True)]


def _states(feedback: Table, form: RowFormat, at_ns: Times) -> Floats:
    """Return the state interpolated at the given times, with angles going the shorter way around."""
    times = _times(feedback, "captured_ns")
    columns = []
    for name in form.state:
        values = feedback.numbers(name)
        known = np.isfinite(values)
        values = np.unwrap(values[known]) if name == "yaw_rad" else values[known]
        column = np.interp(at_ns, times[known], values)
        columns.append((column + np.pi) % (2 * np.pi) - np.pi if name == "yaw_rad" else column)
    return np.stack(columns, axis=1) if columns else np.empty((len(at_ns), 0))


def _actions(commands: Table, form: RowFormat, by_ns: Times) -> Floats:
    """Return the set-point in effect at the given times, or zeros before the first set-point and while hovering."""
    kept = _piloted(commands) & np.isin(commands["asked"], [form.set_point, _STILL])
    times, moves = _times(commands, "applied_ns")[kept], (commands["asked"] == form.set_point)[kept]
    values = np.stack([np.nan_to_num(commands.numbers(f"asked_{name}")[kept]) for name in form.action], axis=1)
    rows = np.searchsorted(times, by_ns, side="right") - 1
    if not len(times):
        return np.zeros((len(by_ns), len(form.action)))
    newest = np.maximum(rows, 0)
    found: Floats = np.where(((rows >= 0) & moves[newest])[:, None], values[newest], 0.0)
    return found


# Their video ----------------------------------------------------------------------------------------------------


_KEY_EVERY: Final = 2  #: interval between key frames, in images; small, because training reads images in random order
_LOOKED_AT_EVERY: Final = 16  #: interval, in rows, between the rows sampled for the statistics
_THINNED: Final = 4  #: spacing of the rows and columns used from a sampled image
_QUANTILES: Final = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Pixels = NDArray[np.uint8]


class Film:
    """An H.264 MP4 file with one camera's images from all episodes at a fixed rate. It is deleted after an error."""

    def __init__(self, path: Path, fps: float) -> None:
        self.width = self.height = 0  #: size of the images [px]; 0 before the first one
        self.repeated = 0  #: number of rows that repeat the previous image because their own could not be decoded
        self._path, self._fps = path, Fraction(fps).limit_denominator(1000)
        self._opened = ExitStack()
        self._container: Any = None
        self._stream: Any = None
        self._rows = 0
        self._looked_at: list[NDArray[np.uint8]] = []

    def __enter__(self) -> Film:
        import av

        self._path.parent.mkdir(parents=True, exist_ok=True)
        part = self._opened.enter_context(replacing(self._path))
        file = self._opened.enter_context(part.open("wb"))
        self._container = self._opened.enter_context(av.open(file, "w", format="mp4"))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete the file, or remove it after an error."""
        if kind is None and self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._opened.__exit__(kind, error, trace)

    def add(self, recording: Recording, drone: str, camera: str, wanted_ns: Sequence[Times]) -> None:
        """Encode the images for the rows of a recording, selected by capture time, episode by episode.

        Raise ``FileFormatError`` if the first image can't be decoded, and ``UsageError`` if an image differs in size
        from the first one.
        """
        wanted = np.concatenate([np.empty(0, np.int64), *wanted_ns])
        at = 0
        image: Pixels | None = None
        for picture in recording.pictures(drone, camera):
            captured_ns = picture.header.captured_ns
            if at >= len(wanted):
                return
            if captured_ns < wanted[at]:
                continue
            try:
                image = even(picture.pixels())
            except FileFormatError:
                if image is None:
                    raise
                self.repeated += int(np.count_nonzero(wanted == captured_ns))
            while at < len(wanted) and wanted[at] <= captured_ns:
                self._encode(image, recording.path)
                at += 1
        for _ in wanted[at:]:  # the file is truncated: images are missing at its end
            if image is None:
                raise FileFormatError(f"{recording.path}: no image of {camera} can be decoded")
            self.repeated += 1
            self._encode(image, recording.path)

    def stats(self) -> dict[str, Any]:
        """Return the minimum, maximum, mean, deviation and quantiles of the red, green and blue channels, 0 to 1."""
        pixels = np.concatenate([image.reshape(-1, 3) for image in self._looked_at])[:, ::-1] / 255.0
        found = numbers_stats(pixels)
        return {name: [self._rows] if name == "count" else [[[v]] for v in value] for name, value in found.items()}

    def _encode(self, image: Pixels, path: Path) -> None:
        import av

        height, width = image.shape[:2]
        if self._stream is None:
            self._begin(width, height)
        if (width, height) != (self.width, self.height):
            raise UsageError(
                f"{path} has {width}×{height} images, but the first ones were {self.width}×{self.height}: "
                "export mismatched recordings separately"
            )
        if self._rows % _LOOKED_AT_EVERY == 0:
            self._looked_at.append(image[::_THINNED, ::_THINNED].copy())
        frame = av.VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts, frame.time_base = self._rows, 1 / self._fps
        self._rows += 1
        self._container.mux(self._stream.encode(frame))

    def _begin(self, width: int, height: int) -> None:
        try:
            stream = self._container.add_stream("libx264", rate=self._fps)
        except ValueError as error:
            raise MissingExtraError("encoding H.264", "video", cause="this PyAV comes without x264") from error
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.time_base = stream.codec_context.time_base = 1 / self._fps
        stream.options = {"crf": "18", "preset": "veryfast", "g": str(_KEY_EVERY), "bf": "0"}
        self._stream, self.width, self.height = stream, width, height


def numbers_stats(values: NDArray[Any]) -> dict[str, Any]:
    """Return a dataset's statistics for a column, as lists with one value for each number in a row."""
    columns = values.reshape(len(values), -1).astype(np.float64)
    found = {"min": columns.min(0), "max": columns.max(0), "mean": columns.mean(0), "std": columns.std(0)}
    found |= {name: np.quantile(columns, share, axis=0) for name, share in _QUANTILES.items()}
    return {"count": [len(values)], **{name: value.tolist() for name, value in found.items()}}
