"""Results as tables, for the terminal and for the pages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from benchmarks.codecs import CodecResults
from benchmarks.fleet import HostedFleet
from benchmarks.load import PARTS as LOAD_PARTS
from benchmarks.load import CaseResult as LoadCase
from benchmarks.load import Load
from benchmarks.mavlink_fleet import MavlinkResult
from benchmarks.measuring.schedule import COMMAND, FEEDBACK, VIDEO
from benchmarks.measuring.statistics import Summary
from benchmarks.measuring.tables import UNKNOWN, Table, median_and_p99
from benchmarks.network import Channel, Network
from benchmarks.scale import PARTS, CaseResult, Scale, bends
from benchmarks.swarm import Swarm
from benchmarks.units import Fleet, Needs, Units
from skyloop.bench import Spread

_OBSERVED: Final = (f"{FEEDBACK}, observers", f"{VIDEO}, observers")


def load_table(results: Load) -> Table:
    """Return the pilot's delays in every case, and the age of frames at the other applications."""
    rows = [
        [
            case.case,
            f"{case.size}, {case.frames_per_s:.0f}/s",
            *(median_and_p99(case.channels.get(channel)) for channel in (COMMAND, FEEDBACK, VIDEO)),
            _others(case),
        ]
        for case in results.cases
    ]
    rows += [[name, f"left out: {why}", *[""] * 4] for name, why in results.skipped.items()]
    columns = ["beside the pilot", "frames", "command", "feedback", "age of frames", "at the others"]
    return Table("The pilot's delays in µs: median (99th percentile)", columns, rows)


def cpu_table(results: Load) -> Table:
    """Return the processor time of each part of a case."""
    rows = [
        [case.case, f"{case.size}, {case.frames_per_s:.0f}/s", *(_share(case.cpu.get(part)) for part in LOAD_PARTS)]
        for case in results.cases
    ]
    return Table("Processor time, in percent of one core", ["beside the pilot", "frames", *LOAD_PARTS], rows)


def codecs_table(results: CodecResults) -> Table:
    """Return the processor time of each kind of work."""
    rows = [
        [
            row.what,
            row.of,
            f"{row.size / 1e3:.1f} kB",
            f"{row.once.median_us / 1e3:.3f} ({row.once.p99_us / 1e3:.3f})",
            f"{row.per_s:.0f}",
            "" if row.target is None else f"≥ {row.target:g}",
        ]
        for row in results.rows
    ]
    rows += [[name, f"left out: {why}", *[""] * 4] for name, why in results.skipped.items()]
    columns = ["work", "of", "encoded", "time", "a second on one core", "target"]
    return Table("Processor time in ms for one: median (99th percentile)", columns, rows)


def network_table(results: Network) -> Table:
    """Return the fractions and ages of arrivals, by connection and loss."""
    rows = [
        [
            f"{case.loss:.0%}",
            case.way,
            _ages(case.channels[COMMAND]),
            f"{case.channels[COMMAND].share:.1%}",
            _ages(case.channels[FEEDBACK]),
            f"{case.channels[FEEDBACK].share:.1%}",
            f"{case.frames_per_s:.1f}",
            _ages(case.channels[VIDEO]),
        ]
        for case in sorted(results.cases, key=lambda case: case.loss)
    ]
    columns = [
        "lost",
        "by",
        "age of commands",
        "executed",
        "age of feedback",
        "arrived",
        "frames a second",
        "their age",
    ]
    return Table(f"Ages in ms: median, 99th percentile, longest; the path: {results.path}", columns, rows)


def path_table(results: Network) -> Table:
    """Return the path's own figures, and the bytes that each sample takes on it."""
    rows = [["maximum throughput", f"{results.megabytes_per_s:.0f} MB/s"]]
    late = max(case.relay.p99_us for case in results.cases)
    typical = max(case.relay.median_us for case in results.cases)
    rows.append(
        ["delay added by the emulation itself", f"{typical:.0f} µs (99th percentile {late:.0f}), in the worst case"]
    )
    if results.wire is not None:
        wire = results.wire
        rows += [
            ["a command", f"{wire.command:.0f} bytes"],
            ["a sample of feedback", f"{wire.feedback:.0f} bytes"],
            ["a frame, JPEG of 320×240", f"{wire.frame:.0f} bytes, and {wire.frame_back:.0f} back"],
        ]
    return Table("The path, and what passes it", ["what", "measured"], rows)


def swarm_table(results: Sequence[Swarm]) -> Table:
    """Return a row for each run."""
    rows = [
        [
            f"{run.drones} by {run.users}, {run.observers} observers",
            f"{run.seconds:g} s",
            _spread(run.command),
            _spread(run.feedback),
            UNKNOWN if run.feedback_at_observers is None else _spread(run.feedback_at_observers),
            f"{run.commands_per_s:.1f}",
            f"{run.frames_per_s:.1f}" if run.observers else UNKNOWN,
            f"{run.failsafe.expected - run.failsafe.missed} of {run.failsafe.expected}",
            UNKNOWN if run.failsafe.delay is None else _spread(run.failsafe.delay),
            str(run.failsafe.needless),
            ", ".join(f"{part} {cores:.0%}" for part, cores in run.cpu.items()),
        ]
        for run in results
    ]
    columns = [
        *("drones, users", "flown", "command", "feedback", "at observers", "commands/s", "frames/s"),
        *("failsafes executed", "after", "needless", "processor"),
    ]
    return Table("Delays in ms: median (99th percentile)", columns, rows)


def scale_table(results: Scale, many: str) -> Table:
    """Return the cases with growing numbers of ``"proxies"``, each with an observer, or of one's ``"observers"``."""
    series = results.series(many)
    rows = [[str(case.observers), *_scale_cells(case)] for case in series]
    columns = [
        *(many, "command", "feedback", *_OBSERVED, "least share"),
        *(f"{part}, cores" for part in PARTS[:3]),
        *("all", "pilot connects in"),
    ]
    bend = bends(series, results.machine.cores)
    where = "it does not bend" if bend is None else f"it bends at {bend[0].observers}: {bend[1]}"
    return Table(f"More and more {many}; delays in ms: median (99th percentile). Here {where}", columns, rows)


def _scale_cells(case: CaseResult) -> list[str]:
    return [
        *(_pair(case.channels.get(name)) for name in (COMMAND, FEEDBACK, *_OBSERVED)),
        f"{min(case.shares.values()):.1%}",
        *(f"{case.cpu.get(part, 0.0):.2f}" for part in PARTS[:3]),
        f"{sum(case.cpu.values()):.2f}",
        f"{case.opened_s:.1f} s",
    ]


def fleet_table(results: HostedFleet) -> Table:
    """Return the costs of many vehicles in one host, and the delays of their samples."""
    rows = [
        [
            str(case.vehicles),
            "network" if case.network else "local",
            str(case.observers),
            *(_pair(case.channels.get(name)) for name in (COMMAND, FEEDBACK, *_OBSERVED)),
            f"{min(case.shares.values()):.2%}",
            *(f"{case.cpu.get(part, 0.0):.2f}" for part in ("host", "pilot", "observers")),
            f"{case.vehicle_mb:.2f}",
        ]
        for case in results.cases
    ]
    columns = ["vehicles", "way", "observers of one", "command", "feedback", *_OBSERVED, "least share"]
    columns += ["host, cores", "pilot, cores", "observers, cores", "MB a vehicle"]
    return Table("Many vehicles in one host; delays in ms: median (99th percentile)", columns, rows)


def mavlink_table(case: MavlinkResult) -> Table:
    """Return the results of emulated MAVLink vehicles in one host."""
    row = [
        str(case.vehicles),
        str(case.flown),
        f"{case.lost + case.vehicles - case.up}",
        f"{case.share:.2%}",
        f"{case.age_median_ms:.1f} ({case.age_p99_ms:.1f})",
        "–" if case.error_p99_m is None else f"{case.error_p99_m:.2f} ({case.error_most_m:.2f})",
        str(len(case.failed)),
        *(f"{case.cpu[part]:.2f}" for part in ("host", "pilot", "emulators")),
    ]
    columns = ["vehicles", "in formation", "links lost", "states received", "age, ms", "off its place, m", "failed"]
    columns += ["host, cores", "pilot, cores", "emulators, cores"]
    return Table(
        "Emulated MAVLink vehicles in one host; ages: median (99th percentile); places: 99th percentile (most)",
        columns,
        [row],
    )


def bend_text(results: Scale, many: str) -> str:
    """Return a sentence on where a series becomes worse than at its beginning."""
    series = results.series(many)
    bend = bends(series, results.machine.cores)
    if bend is None:
        return f"Up to {series[-1].observers} {many} nothing bends." if series else ""
    case, why = bend
    return f"With {many} it bends at {case.observers}: {why}."


def units_table(units: Units) -> Table:
    """Return the unit costs."""
    rows = [
        ["a proxy with its pilot, each second", f"{units.proxy_us_per_s / 1e3:.1f} ms", f"{units.proxy_mb:.0f} MB"],
        ["a pilot, each second and drone", f"{units.pilot_us_per_s / 1e3:.1f} ms", ""],
        ["feedback sent to one more observer", f"{units.feedback_sent_us:.0f} µs", f"{units.feedback_bytes:.0f} bytes"],
        ["feedback received by an observer", f"{units.feedback_received_us:.0f} µs", f"{units.observer_mb:.0f} MB"],
        ["a frame encoded as JPEG, once for all clients", f"{units.jpeg_us:.0f} µs", f"{units.frame_bytes:.0f} bytes"],
        ["a frame sent to one observer", f"{units.frame_sent_us:.0f} µs", ""],
        ["a frame received and decoded", f"{units.frame_received_us:.0f} µs", ""],
        [
            "feedback forwarded by a router, to one client",
            f"{units.feedback_routed_us:.0f} µs",
            f"{units.router_mb:.0f} MB",
        ],
        ["a frame forwarded by a router, to one client", f"{units.frame_routed_us:.0f} µs", ""],
        ["a command", "", f"{units.command_bytes:.0f} bytes"],
    ]
    return Table("What one costs", ["what", "processor", "memory or wire"], rows)


def needs_table(fleet: Fleet, found: Needs) -> Table:
    """Return the requirements of a fleet."""
    rows = [
        ["cores for proxies", f"{found.proxy_cores:.1f}", f"{fleet.drones} of them"],
        ["cores for pilots", f"{found.pilot_cores:.1f}", ""],
        ["cores for observers", f"{found.observer_cores:.1f}", f"{fleet.drones * fleet.observers} of them"],
        ["cores for each site's router", f"{found.router_cores:.2f}", f"{fleet.sites} of them"],
        ["cores for the router in the middle", f"{found.middle_cores:.2f}", ""],
        ["cores in all", str(found.cores), f"with a load of at most {fleet.busy:.0%}"],
        ["memory of proxies", f"{found.proxy_memory_gb:.0f} GB", ""],
        ["memory of observers", f"{found.observer_memory_gb:.0f} GB", ""],
        ["link of one drone, out", f"{found.drone_uplink:.2f} Mbit/s", "feedback and one video"],
        ["link of one drone, in", f"{found.drone_downlink:.3f} Mbit/s", "commands"],
        ["link of a site", f"{found.site_link:.0f} Mbit/s", "each way, as half of the observers are elsewhere"],
        ["liveliness tokens", str(found.tokens), "one a proxy, one a connection"],
        ["links without routers", f"{found.mesh_links:,}", "if each process connected to each other one, so none does"],
    ]
    return Table(f"{fleet.drones} drones at {fleet.sites} sites", ["what", "needed", ""], rows)


def _ages(channel: Channel) -> str:
    age = channel.age
    if age is None:
        return UNKNOWN
    return ", ".join(f"{us / 1e3:.1f}" for us in (age.median_us, age.p99_us, age.maximum_us))


def _pair(summary: Summary | None) -> str:
    return UNKNOWN if summary is None else f"{summary.median_us / 1e3:.1f} ({summary.p99_us / 1e3:.1f})"


def _spread(spread: Spread) -> str:
    return f"{spread.median_us / 1e3:.1f} ({spread.p99_us / 1e3:.1f})"


def _others(case: LoadCase) -> str:
    found = [summary for name, summary in case.channels.items() if name.startswith(f"{VIDEO},")]
    return median_and_p99(found[0]) if found else ""


def _share(cores: float | None) -> str:
    return UNKNOWN if cores is None else f"{100 * cores:.1f}"
