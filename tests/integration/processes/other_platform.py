"""Runs the ``skyloop`` command as on another platform: ``python -m`` this module ``win32 list``.

First imports the third-party modules that Skyloop uses, then changes ``sys.platform`` and hides the parts of Python
that the other platform lacks. This tests what Skyloop itself needs, not how other libraries behave there.
"""

import asyncio
import importlib
import os
import pkgutil
import sys
import sysconfig

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
    for name in MISSING_MODULES[platform]:
        sys.modules[name] = None  # type: ignore[assignment]  # an import of it fails
    for name in MISSING_NAMES[platform]:
        if hasattr(os, name):
            delattr(os, name)
    sys.platform = platform


def fly(name: str, place: str) -> None:
    """Import everything that the package offers, and fly a drone on the network."""
    import skyloop

    for offered in dir(skyloop):
        getattr(skyloop, offered)
    packages = ("client", "messages", "control", "vision", "recording", "cockpit", "network.keys", "aio", "drivers")
    for package in packages:
        module = importlib.import_module(f"skyloop.{package}")
        for one in pkgutil.iter_modules(module.__path__):
            if one.name != "__main__":
                importlib.import_module(f"{module.__name__}.{one.name}")
    with skyloop.connect(name, network=place) as drone:
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
