"""``python -m tests.promises.chaos``: flies, makes trouble, and reports which promises were kept."""

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
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

from skyloop.network.config import free_port
from tests.promises.chaos.judge import Verdict
from tests.promises.chaos.lanes import LOCAL, NETWORK, Fault, Lane, disk_full, foreign_clock, torment
from tests.promises.chaos.mavlink_lanes import HANDS, MAVLINK, MavlinkLane, PageLane
from tests.promises.chaos.processes import Resources

EPILOG = "Example: python -m tests.promises.chaos --seconds 180 --seed 7; ends with 1 if a promise broke."
CALM_S = 5.0  #: before the first fault and after the last
DISK = "8m"
#: A lane beside each of the others, without faults: faults that appear there too are caused by the machine.
CONTROLS = {
    "local": "local-control",
    "network": "network-control",
    "mavlink": "mavlink-control",
    "page": "page-control",
}
#: How much more a proxy may hold after all this. The allocator keeps the memory that a flood needed at once (some 25 MB
#: over the network) for the next one: after an hour of floods it was less than that, after three minutes 26 MB.
MORE_DESCRIPTORS, MORE_THREADS, MORE_MB = 8, 3, 48.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns 0 if every promise was kept."""
    parser = argparse.ArgumentParser(prog="python -m tests.promises.chaos", description=__doc__, epilog=EPILOG)
    parser.add_argument("--seconds", type=float, default=180.0, help="how long to make trouble [180]")
    parser.add_argument("--seed", type=int, default=1, help="of the order and length of the faults [1]")
    parser.add_argument("--lanes", nargs="+", choices=CONTROLS, default=list(CONTROLS), help="fly only these [all]")
    parser.add_argument("--quiet", action="store_true", help="only the result")
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="chaos-") as folder, _small_disk(Path(folder)) as mounted:
        impossible = set() if mounted else {disk_full}
        if not _may_part_clocks():
            impossible.add(foreign_clock)
        for fault in impossible:
            print(f"left out, as it takes root: {fault.__doc__}")
        faults = {"local": LOCAL, "network": NETWORK, "mavlink": MAVLINK, "page": HANDS}
        faults = {name: each for name, each in faults.items() if name in chosen.lanes}
        if "page" in faults and (missing := PageLane.missing()):
            print(f"left out, as it takes {missing}: {', '.join(str(fault.__doc__) for fault in faults.pop('page'))}")
        possible = {name: [fault for fault in each if fault not in impossible] for name, each in faults.items()}
        return _run(Path(folder), chosen.seconds, chosen.seed, chosen.quiet, possible)


def _lane(name: str, folder: Path) -> Lane:
    """Make the lane whose kind is the beginning of its name."""
    if name.startswith("page"):
        return PageLane(name, folder)
    if name.startswith("mavlink"):
        return MavlinkLane(name, folder)
    return Lane(name, folder, network=f"127.0.0.1:{free_port('127.0.0.1')}" if name.startswith("network") else None)


def _begun(names: Sequence[str], folder: Path, stack: ExitStack) -> list[Lane]:
    """Lanes that start in parallel, and are closed with the stack."""

    def begin(name: str) -> Lane:
        lane = _lane(name, folder)
        stack.callback(lane.close)
        return lane

    with ThreadPoolExecutor(len(names)) as pool:
        return list(pool.map(begin, names))


def _run(folder: Path, seconds: float, seed: int, quiet: bool, faults: Mapping[str, Sequence[Fault]]) -> int:
    begin = time.monotonic()

    def report(text: str) -> None:
        if not quiet:
            print(f"{time.monotonic() - begin:7.1f} s  {text}", flush=True)

    with ExitStack() as stack:
        lanes = _begun((*faults, *(CONTROLS[name] for name in faults)), folder, stack)
        ending = threading.Event()
        for lane in lanes:
            lane.proxy.until("ready")
        for lane in lanes:
            lane.pilot.until("flying")
        for lane in lanes:
            lane.resume(ending)
        report("all fly")
        time.sleep(CALM_S)
        for lane in lanes:
            lane.settled()
        threads = []
        for number, (lane, each) in enumerate(zip(lanes, faults.values(), strict=False)):
            source = random.Random(seed * 1000 + number)
            thread = threading.Thread(target=torment, args=(lane, each, source, ending, report), name=lane.name)
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
        broken += [f"{lane.name}: {text}" for lane in lanes for text in lane.complaints]
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
        broken += [f"{name}: nobody asked for it: {text}" for text in verdict.unasked]
        broken += [f"{name}: not flown again after {text}" for text in verdict.unrecovered]
        control = verdicts.get(CONTROLS.get(name, ""))
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
    return [
        f"{lane.name}: the {what} is dead"
        for lane in lanes
        for what, process in lane.processes().items()
        if not process.alive
    ]


def _table(verdicts: dict[str, Verdict], lanes: Sequence[Lane]) -> str:
    rows = [["", *verdicts]]
    rows.append(["calls / executed", *(f"{v.calls} / {v.applied}" for v in verdicts.values())])
    rows.append(["stale executed", *(str(len(v.stale)) for v in verdicts.values())])
    rows.append(["flights nobody asked for", *(str(len(v.unasked)) for v in verdicts.values())])
    rows.append(["needless failsafes", *(str(len(v.needless)) for v in verdicts.values())])
    rows.append(["missed failsafes", *(str(len(v.missed)) for v in verdicts.values())])
    rows.append(["failsafes that were due", *(str(v.justified) for v in verdicts.values())])
    rows.append(["call to vehicle [ms]", *(_spread(v.delay_s) for v in verdicts.values())])
    rows.append(["hover after its time [ms]", *(_spread(v.hover_late_s) for v in verdicts.values())])
    rows.append(["stop to standing [ms]", *(_spread(v.stop_s) for v in verdicts.values())])
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
    """A small disk for recordings and audit trails; yields whether it could be mounted (else it is a folder)."""
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
