"""``python -m tests.chaos``: flies, makes trouble, and tells what became of the promises."""

from __future__ import annotations

import argparse
import os
import random
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from skyloop.transport.fabric.config import free_port
from tests.chaos.judge import Verdict
from tests.chaos.lanes import LOCAL, NETWORK, Fault, Lane, Resources, disk_full, foreign_clock, torment

EPILOG = "Example: python -m tests.chaos --seconds 180 --seed 7; ends with 1 if a promise was broken, and says which."
CALM_S = 5.0  #: before the first fault and after the last
DISK = "8m"
#: A proxy that went through all this may hold so much more than before. What waited at once in a flood (some 25 MB over
#: the network) the allocator keeps for the next: an hour of floods was seen to leave less, three minutes 26 MB.
MORE_DESCRIPTORS, MORE_THREADS, MORE_MB = 8, 3, 48.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns 0 if every promise was kept."""
    parser = argparse.ArgumentParser(prog="python -m tests.chaos", description=__doc__, epilog=EPILOG)
    parser.add_argument("--seconds", type=float, default=180.0, help="how long to make trouble [180]")
    parser.add_argument("--seed", type=int, default=1, help="of the order and length of the faults [1]")
    parser.add_argument("--quiet", action="store_true", help="only the result")
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="chaos-") as folder, _small_disk(Path(folder)) as mounted:
        impossible = set() if mounted else {disk_full}
        if not _may_part_clocks():
            impossible.add(foreign_clock)
        for fault in impossible:
            print(f"left out, as it takes root: {fault.__doc__}")
        local, remote = ([fault for fault in faults if fault not in impossible] for faults in (LOCAL, NETWORK))
        return _run(Path(folder), chosen.seconds, chosen.seed, chosen.quiet, local, remote)


def _run(folder: Path, seconds: float, seed: int, quiet: bool, local: Sequence[Fault], remote: Sequence[Fault]) -> int:
    begin = time.monotonic()

    def report(text: str) -> None:
        if not quiet:
            print(f"{time.monotonic() - begin:7.1f} s  {text}", flush=True)

    with ExitStack() as stack:
        lanes: list[Lane] = []
        for name in ("local", "network", "local-control", "network-control"):
            network = f"127.0.0.1:{free_port('127.0.0.1')}" if name.startswith("network") else None
            lane = Lane(name, folder, network=network)
            stack.callback(lane.close)
            lanes.append(lane)
        for lane in lanes:
            lane.proxy.until("ready")
        for lane in lanes:
            lane.pilot.until("flying")
        report("all fly")
        time.sleep(CALM_S)
        for lane in lanes:
            lane.settled()
        ending = threading.Event()
        threads = []
        for number, (lane, faults) in enumerate(zip(lanes, (local, remote), strict=False)):
            source = random.Random(seed * 1000 + number)
            thread = threading.Thread(target=torment, args=(lane, faults, source, ending, report), name=lane.name)
            thread.start()
            threads.append(thread)
        try:
            time.sleep(seconds)
        finally:
            ending.set()
            for thread in threads:
                thread.join()
        report("no more faults")
        time.sleep(CALM_S + 5.0)
        verdicts = {lane.name: lane.verdict() for lane in lanes}
        broken = [*_leaks(lanes), *_dead(lanes)]
        broken += _broken(verdicts)
        for lane in lanes:
            log = lane.folder / f"{lane.name}.log"
            if broken and log.exists():
                print(f"--- what {lane.name} said\n{log.read_text(errors='replace')[-4000:]}")
        table = _table(verdicts, lanes)
    print(table)
    for line in broken:
        print(f"BROKEN  {line}")
    kept = "every promise was kept" if not broken else f"{len(broken)} promises were broken"
    print(f"seed {seed}, {seconds:.0f} s of faults: {kept}")
    return 1 if broken else 0


def _broken(verdicts: dict[str, Verdict]) -> list[str]:
    broken = []
    for name, verdict in verdicts.items():
        broken += [f"{name}: stale: {text}" for text in verdict.stale]
        broken += [f"{name}: missed: {text}" for text in verdict.missed]
        broken += [f"{name}: not flown again after {text}" for text in verdict.unrecovered]
        control = verdicts.get(f"{name}-control")
        if control is not None and len(verdict.needless) > len(control.needless):
            broken += [f"{name}: needless: {text}" for text in verdict.needless]
        if not verdict.applied:
            broken.append(f"{name}: never flew")
    return broken


def _leaks(lanes: Sequence[Lane]) -> list[str]:
    found = []
    for lane in lanes:
        now, before = Resources.of(lane.proxy.pid), lane.baseline
        assert before is not None
        if (
            now.descriptors > before.descriptors + MORE_DESCRIPTORS
            or now.threads > before.threads + MORE_THREADS
            or now.memory_mb > before.memory_mb + MORE_MB
        ):
            found.append(f"{lane.name}: the proxy held {before} at first and holds {now}")
    return found


def _dead(lanes: Sequence[Lane]) -> list[str]:
    processes = [(lane.name, what, getattr(lane, what)) for lane in lanes for what in ("proxy", "pilot")]
    return [f"{name}: the {what} is dead" for name, what, process in processes if not process.alive]


def _table(verdicts: dict[str, Verdict], lanes: Sequence[Lane]) -> str:
    rows = [["", *verdicts]]
    rows.append(["calls / executed", *(f"{v.calls} / {v.applied}" for v in verdicts.values())])
    rows.append(["stale executed", *(str(len(v.stale)) for v in verdicts.values())])
    rows.append(["needless failsafes", *(str(len(v.needless)) for v in verdicts.values())])
    rows.append(["missed failsafes", *(str(len(v.missed)) for v in verdicts.values())])
    rows.append(["failsafes that were due", *(str(v.justified) for v in verdicts.values())])
    rows.append(["call to vehicle [ms]", *(_spread(v.delay_s) for v in verdicts.values())])
    rows.append(["hover after its time [ms]", *(_spread(v.hover_late_s) for v in verdicts.values())])
    for kind in sorted({kind for v in verdicts.values() for kind in v.recovery_s}):
        spans = (v.recovery_s.get(kind, []) for v in verdicts.values())
        rows.append([f"flown after {kind.replace('_', ' ')} [ms]", *(_spread(span) for span in spans)])
    held = [Resources.of(lane.proxy.pid) if lane.proxy.alive else None for lane in lanes]
    rows.append(["descriptors, threads, MB", *(_held(resources) for resources in held)])
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)
    return "\n".join(["(spans: median, p99, greatest, number)", *lines])


def _held(resources: Resources | None) -> str:
    return "" if resources is None else f"{resources.descriptors}, {resources.threads}, {resources.memory_mb:.0f}"


def _spread(spans_s: Sequence[float]) -> str:
    if not spans_s:
        return "-"
    ordered = sorted(spans_s)
    p99 = ordered[min(len(ordered) - 1, round(0.99 * (len(ordered) - 1)))]
    median = statistics.median(ordered)
    return f"{median * 1e3:.1f}, {p99 * 1e3:.1f}, {ordered[-1] * 1e3:.1f}, {len(ordered)}"


@contextmanager
def _small_disk(folder: Path) -> Iterator[bool]:
    """A disk that is soon full, for recordings and audit trails; whether it could be mounted, else it is a folder."""
    disk = folder / "disk"
    disk.mkdir()
    (folder / "elsewhere").mkdir(mode=0o700)
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(disk)]
    mounted = os.geteuid() == 0 and subprocess.run(command, capture_output=True, check=False).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(disk)], check=False)


def _may_part_clocks() -> bool:
    """Whether a process with another clock can be started here."""
    try:
        probe = subprocess.run(["unshare", "--time", "--monotonic", "1", "true"], capture_output=True, check=False)
    except FileNotFoundError:
        return False
    return probe.returncode == 0


if __name__ == "__main__":
    sys.exit(main())
