"""Export recorded flights as a LeRobotDataset, version 3.0.

The layout follows https://huggingface.co/docs/lerobot/lerobot-dataset-v3: one Parquet file with the rows, one video per
camera, and their description in ``meta/``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import FileFormatError, MissingExtraError, UsageError
from skyloop.files import replacing
from skyloop.pyav import require_pyav
from skyloop.recording.layout import Channel
from skyloop.recording.reader import Recording
from skyloop.recording.review.episodes import Episode, Film, RowFormat, episodes, numbers_stats, row_format_of
from skyloop.recording.review.tables import tables

VERSION: Final = "v3.0"  #: version of the dataset format
STATE: Final = "observation.state"
ACTION: Final = "action"
IMAGES: Final = "observation.images."
LEAST_FPS: Final = 0.5  #: minimum number of rows per second
MOST_FPS: Final = 120.0  #: maximum number of rows per second
_FILE: Final = "chunk-000/file-000"
_CHANNELS: Final = (Channel.FEEDBACK, Channel.COMMANDS, Channel.LOGS, Channel.FRAMES)
_OTHERS: Final = {"timestamp": "float32"} | dict.fromkeys(
    ("frame_index", "episode_index", "index", "task_index"), "int64"
)
_PURPOSE: Final = "exporting for LeRobot"

#: Called with the current step and its progress, 0 to 1.
Doing = Callable[[str, float], object]


@dataclass(frozen=True, slots=True)
class Exported:
    """The result of an export."""

    folder: Path
    form: RowFormat
    episodes: int
    rows: int
    repeated: int  #: number of rows whose image could not be decoded, so they repeat the previous image


#: A recording, the drone that was flown, and its episodes.
_Flight = tuple[Recording, str, list[Episode]]


def export_lerobot(
    recordings: Sequence[Recording],
    folder: Path,
    *,
    drone: str | None = None,
    cameras: Sequence[str] | None = None,
    fps: float = 10.0,
    task: str = "",
    doing: Doing | None = None,
) -> Exported:
    """Export flights as episodes of a LeRobotDataset.

    An episode lasts while the drone follows set-points; a logged text named ``mark`` starts a new episode and names its
    task. :func:`skyloop.recording.review.episodes.episodes` describes the rows.

    Args:
        recordings: Recordings of similar drones flown in the same way.
        folder: Folder for the dataset; it must be new or empty.
        drone: The drone's name in each recording; None for the first drone in each.
        cameras: Cameras to export, which every recording must have; None for all.
        fps: Rows per second.
        task: Name of the task where no mark names one.
        doing: Called to report the progress.

    Raises:
        UsageError: The folder can't be written or is not empty, the recordings don't match, or ``fps`` is out of range.
        UnknownNameError: A recording has no such drone.
        FileFormatError: A recording has no feedback, set-points or frames, or no recording contains an episode.
        MissingExtraError: PyArrow, PyAV or OpenCV is not installed.
    """
    doing = doing or (lambda *_: None)
    writer = _Writer(folder)
    require_pyav(_PURPOSE)
    if not LEAST_FPS <= fps <= MOST_FPS:
        raise UsageError(f"fps is {fps!r} and must be from {LEAST_FPS:g} to {MOST_FPS:g}")
    form, flights = _read(recordings, drone, cameras, fps, task, doing)
    whole = [episode for _, _, flown in flights for episode in flown]
    if not whole:
        raise FileFormatError("no recorded flight has images and follows set-points for at least a second")
    writer.make_folders()
    films: dict[str, Film] = {}
    for camera in form.cameras:
        with Film(folder / "videos" / f"{IMAGES}{camera}" / f"{_FILE}.mp4", form.fps) as film:
            for number, (recording, name, flown) in enumerate(flights):
                doing(f"encoding {camera}", number / len(flights))
                film.add(recording, name, camera, [episode.frames_ns[camera] for episode in flown])
        films[camera] = film
    tasks = sorted({episode.task for episode in whole})
    rows = _rows(whole, form, tasks)
    stats = {name: numbers_stats(values) for name, values in rows.items()}
    stats |= {f"{IMAGES}{camera}": film.stats() for camera, film in films.items()}
    writer.table(f"data/{_FILE}.parquet", rows)
    writer.table(f"meta/episodes/{_FILE}.parquet", _episodes(whole, form))
    writer.tasks(tasks)
    writer.json("meta/stats.json", stats)
    writer.json("meta/info.json", _info(whole, form, tasks, films))
    return Exported(folder, form, len(whole), sum(map(len, whole)), sum(film.repeated for film in films.values()))


def _read(
    recordings: Sequence[Recording],
    drone: str | None,
    cameras: Sequence[str] | None,
    fps: float,
    task: str,
    doing: Doing,
) -> tuple[RowFormat, list[_Flight]]:
    form: RowFormat | None = None
    flights: list[_Flight] = []
    for number, recording in enumerate(recordings):
        doing("reading", number / len(recordings))
        name = recording.drone(drone).name
        try:
            found = tables(recording, name, _CHANNELS)
            here = row_format_of(found, recording.cameras(name) if cameras is None else cameras, fps)
        except (FileFormatError, UsageError) as error:
            raise type(error)(f"{recording.path}: {error}") from None
        form = form or here
        if here != form:
            raise UsageError(
                f"{recording.path} has {_words(here)}, but {recordings[0].path} has {_words(form)}: "
                "export mismatched recordings separately, or choose cameras that all of them have"
            )
        flights.append((recording, name, episodes(found, form, task)))
    if form is None:
        raise UsageError("no recording was given")
    return form, flights


def _words(form: RowFormat) -> str:
    return f"{form.set_point} set-points, the state {', '.join(form.state)} and the cameras {', '.join(form.cameras)}"


# Contents of the files ---------------------------------------------------------------------------------------------


def _rows(whole: Sequence[Episode], form: RowFormat, tasks: Sequence[str]) -> dict[str, NDArray[Any]]:
    lengths = [len(episode) for episode in whole]
    within = np.concatenate([np.arange(length) for length in lengths])
    return {
        STATE: np.concatenate([episode.state for episode in whole]).astype(np.float32),
        ACTION: np.concatenate([episode.action for episode in whole]).astype(np.float32),
        "timestamp": (within / form.fps).astype(np.float32),
        "frame_index": within.astype(np.int64),
        "episode_index": np.repeat(np.arange(len(whole)), lengths).astype(np.int64),
        "index": np.arange(sum(lengths), dtype=np.int64),
        "task_index": np.repeat([tasks.index(episode.task) for episode in whole], lengths).astype(np.int64),
    }


def _episodes(whole: Sequence[Episode], form: RowFormat) -> dict[str, Any]:
    """Return the rows of each episode and its part of each video."""
    ends = np.cumsum([len(episode) for episode in whole])
    begins = ends - [len(episode) for episode in whole]
    zeros = np.zeros(len(whole), np.int64)
    columns: dict[str, Any] = {
        "episode_index": np.arange(len(whole)),
        "tasks": [[episode.task] for episode in whole],
        "length": ends - begins,
        "data/chunk_index": zeros,
        "data/file_index": zeros,
        "dataset_from_index": begins,
        "dataset_to_index": ends,
        "meta/episodes/chunk_index": zeros,
        "meta/episodes/file_index": zeros,
    }
    for camera in form.cameras:
        video = f"videos/{IMAGES}{camera}"
        columns |= {f"{video}/chunk_index": zeros, f"{video}/file_index": zeros}
        columns |= {f"{video}/from_timestamp": begins / form.fps, f"{video}/to_timestamp": ends / form.fps}
    return columns


def _info(whole: Sequence[Episode], form: RowFormat, tasks: Sequence[str], films: Mapping[str, Film]) -> dict[str, Any]:
    fps = int(form.fps) if form.fps == int(form.fps) else form.fps
    features: dict[str, Any] = {
        STATE: {"dtype": "float32", "shape": [len(form.state)], "names": list(form.state)},
        ACTION: {"dtype": "float32", "shape": [len(form.action)], "names": list(form.action)},
    }
    for camera, film in films.items():
        features[f"{IMAGES}{camera}"] = {
            "dtype": "video",
            "shape": [film.height, film.width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": film.height,
                "video.width": film.width,
                "video.codec": "h264",
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False,
                "video.fps": fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }
    features |= {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in _OTHERS.items()}
    return {
        "codebase_version": VERSION,
        "robot_type": "skyloop",
        "total_episodes": len(whole),
        "total_frames": sum(map(len, whole)),
        "total_tasks": len(tasks),
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(whole)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features,
    }


class _Writer:
    """Writes the files of a dataset into a folder that is new or empty.

    Raise ``UsageError`` if the folder is not empty.
    """

    def __init__(self, folder: Path) -> None:
        try:
            import pyarrow
            import pyarrow.parquet
        except ImportError as error:
            raise MissingExtraError(_PURPOSE, "parquet", cause=str(error)) from None
        self._pa, self._pq, self._folder = pyarrow, pyarrow.parquet, folder
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(f"{folder} is not empty: choose another folder for the dataset, or remove it")

    def make_folders(self) -> None:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{self._folder} can't be created: {error.strerror}") from error

    def table(self, name: str, columns: Mapping[str, Any], metadata: dict[str, str] | None = None) -> None:
        """Write columns; columns of shape (rows, n) are written as lists."""
        pa = self._pa
        arrays = {}
        for column, values in columns.items():
            if getattr(values, "ndim", 1) == 2:
                arrays[column] = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
            else:
                arrays[column] = pa.array(values)
        with self._replacing(name) as part:
            self._pq.write_table(pa.table(arrays).replace_schema_metadata(metadata), part)

    def tasks(self, tasks: Sequence[str]) -> None:
        """Write the tasks as the index of a Pandas frame, which is what readers expect."""
        columns = {"task_index": np.arange(len(tasks)), "task": list(tasks)}
        kinds = [("task_index", "int64", "int64"), ("task", "unicode", "object")]
        described = [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
            for name, kind, numpy in kinds
        ]
        about = {"index_columns": ["task"], "column_indexes": [], "columns": described}
        self.table("meta/tasks.parquet", columns, {"pandas": json.dumps(about)})

    def json(self, name: str, value: Any) -> None:
        with self._replacing(name) as part:
            part.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")

    @contextmanager
    def _replacing(self, name: str) -> Iterator[Path]:
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part:
            yield part
