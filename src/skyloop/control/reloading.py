"""Reload the user's file when it, or a module beside it that it imports, was saved, without interrupting the flight."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Final, Self

from skyloop.control.controller import Controller
from skyloop.control.loading import load_controller
from skyloop.errors import SkyloopError

LOOK_S: Final = 0.1  #: how often the files are polled
Stamp = tuple[int, int, int]  #: what changes when a file is saved: time [ns], size, inode


class Reloader:
    """Watches a controller's file, and loads it on its own thread when it was saved. A context manager.

    A file counts as saved once it is unchanged for ``look_s / 2``, so that a file that is being written is not loaded.
    """

    def __init__(self, path: str | Path, class_name: str | None = None, *, look_s: float = LOOK_S) -> None:
        """Record the state of the files; the thread starts with the context.

        Args:
            path: The controller's file.
            class_name: Which class, where the file has several.
            look_s: How often the files are polled [s].
        """
        self._path = Path(path)
        self._folder = self._path.resolve().parent
        self._class_name = class_name
        self._look_s = look_s
        self._seen = self._stamps()
        self._loaded: deque[type[Controller] | SkyloopError] = deque(maxlen=1)
        self._saved_at = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="skyloop-reloader", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()

    @property
    def waiting(self) -> bool:
        """Whether :meth:`take` has something to return."""
        return bool(self._loaded)

    @property
    def age_s(self) -> float:
        """Time since the last change was detected [s]."""
        return time.monotonic() - self._saved_at

    def take(self) -> type[Controller] | SkyloopError | None:
        """Return the new class, or the error why the saved file can't be loaded; None if nothing was saved since."""
        return self._loaded.popleft() if self._loaded else None

    def look(self) -> None:
        """Poll the files once, and load them if they changed."""
        found = self._stamps()
        if found == self._seen:
            return
        self._saved_at = time.monotonic()
        while (again := self._settled()) != found:  # the file is still being written
            found = again
        self._seen = found
        try:
            self._loaded.append(self._load())
        except SkyloopError as error:
            self._loaded.append(error)
        self._seen = {**self._stamps(), **found}  # modules that the new version imports are watched too

    def _settled(self) -> dict[Path, Stamp]:
        self._ended.wait(self._look_s / 2)
        return self._stamps()

    def _run(self) -> None:
        while not self._ended.wait(self._look_s):
            self.look()

    def _load(self) -> type[Controller]:
        """Load the file and its neighbours again; restore the modules that were loaded before if that fails."""
        before = self._neighbours()
        for name in before:
            sys.modules.pop(name, None)
        try:
            return load_controller(self._path, self._class_name)
        except BaseException:
            sys.modules.update(before)
            raise

    def _neighbours(self) -> dict[str, ModuleType]:
        """Return the loaded modules from the folder of the user's file: that file, and those beside it."""
        loaded = dict(sys.modules)
        tops = {name for name in loaded if "." not in name and self._lies_here(name, loaded[name])}
        return {name: module for name, module in loaded.items() if name.partition(".")[0] in tops and _file(module)}

    def _lies_here(self, name: str, module: ModuleType) -> bool:
        file = _file(module)
        if file is None or name in ("__main__", "skyloop"):
            return False
        return file.parent == self._folder or (file.name == "__init__.py" and file.parent.parent == self._folder)

    def _stamps(self) -> dict[Path, Stamp]:
        files = {self._path.resolve(), *(file for module in self._neighbours().values() if (file := _file(module)))}
        return {file: stamp for file in files if (stamp := _stamp(file)) is not None}


def _file(module: ModuleType) -> Path | None:
    origin = getattr(module, "__file__", None)
    return Path(origin) if isinstance(origin, str) else None


def _stamp(file: Path) -> Stamp | None:
    """Return what changes when a file is saved; None while it is missing, as when an editor replaces it."""
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size, found.st_ino
