"""Runs the ``skyloop`` command as on another platform: ``python -m`` this module ``win32 list``.

First imports the third-party modules that Skyloop uses, then changes ``sys.platform`` and hides the parts of Python
that the other platform lacks. This tests what Skyloop itself needs, not how other libraries behave there.
"""

from __future__ import annotations

import asyncio
import atexit
import importlib
import mmap
import os
import pkgutil
import sys
import sysconfig
import types
from typing import Any

MISSING_MODULES = {
    "darwin": (),
    "win32": ("curses", "fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"),
}
MISSING_NAMES = {
    "darwin": ("memfd_create", "sched_getaffinity", "sched_setaffinity", "eventfd"),
    "win32": (
        "memfd_create",
        "sched_getaffinity",
        "sched_setaffinity",
        "eventfd",
        "getuid",
        "geteuid",
        "killpg",
        "setsid",
    ),
}
#: Modules that check the platform when they are imported.
LIBRARIES = (
    "numpy", "cv2", "zenoh", "msgspec", "platformdirs", "typer", "rich.console", "rich.live", "pydantic.fields",
    "uvicorn.main", "starlette.applications", "websockets.asyncio.server", "cryptography", "urllib.request",
    "webbrowser", "multiprocessing.connection", "concurrent.futures.process", "ctypes.util", "zoneinfo",
)  # fmt: skip


def pretend(platform: str) -> None:
    """Make this process one of another platform, as far as Skyloop can see."""
    sysconfig.get_config_vars()  # reads a file named after the platform, once
    asyncio.new_event_loop().close()
    for name in LIBRARIES:
        try:
            importlib.import_module(name)
        except ImportError:  # it belongs to an extra that is not installed
            continue
    locking = file_locking()
    for name in MISSING_MODULES[platform]:
        sys.modules[name] = None  # type: ignore[assignment]  # an import of it fails
    for name in MISSING_NAMES[platform]:
        if hasattr(os, name):
            delattr(os, name)
    if platform == "win32":
        sys.modules["msvcrt"] = locking
        mmap.mmap = TaggedMemory  # type: ignore[assignment,misc]
    sys.platform = platform


class TaggedMemory(mmap.mmap):
    """Memory with a name, as on Windows, where it is free when no one uses it any more."""

    def __new__(cls, number: int, length: int, *args: Any, tagname: str = "", access: int = 0) -> TaggedMemory:
        if not tagname:
            return super().__new__(cls, number, length, *args)
        path = f"/dev/shm/as-on-windows-{tagname}"
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        if os.fstat(file).st_size == 0:
            os.ftruncate(file, length)
            atexit.register(os.unlink, path)
        found = super().__new__(cls, file, length, access=access)
        os.close(file)
        return found


def file_locking() -> types.ModuleType:
    """Return a module with what Windows' ``msvcrt`` has for files."""
    import fcntl

    def locking(descriptor: int, mode: int, _: int) -> None:
        assert mode == found.LK_NBLCK
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise PermissionError(*error.args) from None

    found: Any = types.ModuleType("msvcrt")
    found.LK_NBLCK, found.locking = 2, locking
    return found  # type: ignore[no-any-return]


def fly(name: str, place: str) -> None:
    """Import everything that the package offers, and fly a drone on the network, or without ``place`` on this host."""
    import skyloop

    for offered in dir(skyloop):
        getattr(skyloop, offered)
    packages = ("client", "messages", "control", "vision", "recording", "cockpit", "network.keys", "aio", "drivers")
    for package in packages:
        module = importlib.import_module(f"skyloop.{package}")
        for one in pkgutil.iter_modules(module.__path__):
            if one.name != "__main__":
                importlib.import_module(f"{module.__name__}.{one.name}")
    with skyloop.connect(name, network=place or False) as drone:
        drone.takeoff()
        print("flew, and saw", drone.next_frame(timeout_s=20.0).shape, flush=True)
        drone.land()


if __name__ == "__main__":
    pretend(sys.argv[1])
    if sys.argv[2] == "fly":
        fly(sys.argv[3], sys.argv[4])
    else:
        from skyloop.cli import main

        sys.argv = ["skyloop", *sys.argv[2:]]
        main()
