"""``python -m tests.promises.fuzz``: fuzzes all targets, or those named, each for a while, some in parallel."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

from tests.promises.fuzz.targets import CORPUS, TARGETS, seeds

EPILOG = (
    "Example: python -m tests.promises.fuzz --seconds 600 recording; ends with 1 if something was found, and keeps it."
)
MEMORY_MB = 1024  #: of a process; more counts as a finding
SLOW_S = 10  #: a slower input counts as a finding


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns 0 if nothing was found."""
    parser = argparse.ArgumentParser(prog="python -m tests.promises.fuzz", description=__doc__, epilog=EPILOG)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)} [all]")
    parser.add_argument("--seconds", type=int, default=60, help="for each target [60]")
    parser.add_argument("--keep", action="store_true", help="add what leads into new corners to the corpus")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="at a time [as many as cores]")
    chosen = parser.parse_args(arguments)
    unknown = [name for name in chosen.targets if name not in TARGETS]
    if unknown:
        parser.error(f"there is no target {unknown[0]!r}: {', '.join(TARGETS)}")
    if find_spec("atheris") is None:
        print("fuzzing needs atheris: pip install atheris (on Linux, Python 3.11 to 3.13)")
        return 1
    names = chosen.targets or list(TARGETS)
    with ThreadPoolExecutor(chosen.jobs) as pool:
        results = list(pool.map(lambda name: _fuzz(name, chosen.seconds, chosen.keep), names))
    print(f"{results.count(True)} passed, {results.count(False)} failed")
    return 0 if all(results) else 1


def _fuzz(name: str, seconds: int, keep: bool) -> bool:
    """Returns whether nothing was found."""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix=f"fuzz-{name}-") as folder:
        given, found = Path(folder) / "seeds", Path(folder) / "found"
        given.mkdir()
        found.mkdir()
        for number, seed in enumerate(seeds(name)):
            (given / f"{number:05}").write_bytes(seed)
        kept = CORPUS / name
        kept.mkdir(parents=True, exist_ok=True)
        options = [f"-max_total_time={seconds}", f"-rss_limit_mb={MEMORY_MB}", f"-timeout={SLOW_S}", "-max_len=16384"]
        # A finding is stored where the ordinary tests replay it.
        options.append(f"-artifact_prefix={kept}/found-")
        command = [sys.executable, "-m", "tests.promises.fuzz.run", name, str(found), str(given), *options]
        result = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
        if keep and result.returncode == 0:
            merge = ["-merge=1", "-max_len=2048", "-rss_limit_mb=2048"]
            command = [sys.executable, "-m", "tests.promises.fuzz.run", name, str(kept), str(found), *merge]
            subprocess.run(command, capture_output=True, check=False)
    lines = result.stdout.splitlines()
    done = [line for line in lines if line.startswith("Done ")]
    print(f"{name}: {done[0] if done else f'ended after {time.monotonic() - begin:.0f} s'}", flush=True)
    if result.returncode:
        print("\n".join(lines[-40:]), flush=True)
    return result.returncode == 0


if __name__ == "__main__":
    sys.exit(main())
