"""Set up Skyloop in this checkout, then fly the demo or run the tests. The same commands on Linux, macOS and Windows.

    python dev.py demo                             # a simulated drone that flies by its camera
    python dev.py demo --seconds 30 --headless
    python dev.py test                             # the everyday tests
    python dev.py test -k authority                # those of all tests that the options of pytest select
    python dev.py install dev                      # only set up: what the demo needs, and what the tests need

Needs Python 3.11 or newer and nothing else; ``make`` calls it where there is one. The environment ``.venv`` is made by
the first call, and updated when the project's dependencies change.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parent
ENVIRONMENT = Path(os.environ.get("VENV") or ".venv")  #: relative to the checkout
PYTHON = ENVIRONMENT / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
LOCK = "requirements-dev.lock"
DEMO = ENVIRONMENT / ".installed"  #: stamp: what the demo needs is installed, in the state of these files
DEV = ENVIRONMENT / ".installed-dev"  #: stamp: what the tests need, too
NEEDS: dict[Path, Sequence[str | Path]] = {DEMO: ["pyproject.toml"], DEV: [DEMO, "requirements-dev.txt", LOCK]}


def main(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code."""
    if sys.version_info < (3, 11):  # noqa: UP036  an older one can run this file, and nothing else here
        print(f"Skyloop needs Python 3.11 or newer, this is {sys.version.split()[0]}", file=sys.stderr)
        return 1
    os.chdir(ROOT)
    # Where Python is told to keep nothing that it compiled, each process of the tests would compile everything anew.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    command, *rest = arguments or ["--help"]
    try:
        if command == "demo":
            install()
            return run("-m", "skyloop", "demo", *rest)
        if command == "test":
            install(dev=True)
            # Twice as many tests at a time as the machine has cores: most wait more than they compute.
            chosen = rest or ["-m", "not slow", "--durations", "10", "--durations-min", "3"]
            return run("-m", "pytest", "--numprocesses", str(2 * (os.cpu_count() or 1)), *chosen)
        if command == "install" and rest in ([], ["dev"]):
            install(dev=bool(rest))
            return 0
    except subprocess.CalledProcessError as error:
        print(f"dev.py: installing failed: {subprocess.list2cmdline(error.cmd)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    print(__doc__)
    return 0 if command in ("-h", "--help", "help") else 2


def run(*arguments: str) -> int:
    """Run the environment's Python and return its exit code."""
    if os.name == "posix":
        os.execv(PYTHON, [str(PYTHON), *arguments])  # signals reach it, and not only this script
    child = subprocess.Popen([PYTHON, *arguments])
    while True:
        try:
            return child.wait()
        except KeyboardInterrupt:
            continue  # the demo lands its drone first; a second Ctrl-C makes it hurry


def install(*, dev: bool = False) -> None:
    """Bring the environment up to date: what the demo needs and, with ``dev``, what the tests and checks need."""
    if is_old(DEMO):
        print(f"Installing Skyloop into {ENVIRONMENT}: a minute or two, once", flush=True)
        with dots():
            subprocess.run([sys.executable, "-m", "venv", ENVIRONMENT], check=True)
        pip("--editable", ".[sim,vision,cockpit]")
        DEMO.touch()
    if dev and is_old(DEV):
        print("Installing what the tests and checks need besides: two minutes or three, once", flush=True)
        pip("--editable", ".[all]", "--requirement", "requirements-dev.txt")
        DEV.touch()


def is_old(stamp: Path) -> bool:
    """Return whether a stamp is missing, or older than a file that it depends on."""
    return not stamp.exists() or any(Path(need).stat().st_mtime > stamp.stat().st_mtime for need in NEEDS[stamp])


def pip(*arguments: str) -> None:
    """Install packages: the newest that fit or, with ``LOCKED=1``, exactly the versions in the lock file."""
    locked = ["--constraint", LOCK] if os.environ.get("LOCKED") else []
    subprocess.run(
        [str(PYTHON), "-m", "pip", "install", "--disable-pip-version-check", *locked, *arguments], check=True
    )


@contextmanager
def dots() -> Iterator[None]:
    """Print a dot every two seconds during a long silent step."""
    done = threading.Event()

    def show() -> None:
        while not done.wait(2.0):
            print(".", end="", flush=True)

    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        print()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
