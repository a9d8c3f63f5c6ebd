"""Identifies the flight model of the simulated AR.Drone from recorded pitch steps, judges it, and draws it.

    python scripts/identify_ardrone.py
    python scripts/identify_ardrone.py --data ../shared/fixtures/ardrone-flights --picture steps.png

The recordings are no part of the project: docs/ardrone-model.md says where they come from. The parameters are fitted to
the recordings but one, and judged on that one, for each of them in turn. What the code has, ``AR_DRONE`` in
``skyloop.sim.vehicles``, is the fit that is judged on ``1sImpulseNH1``; it is compared with all recordings, and drawn.
Figures are RMS over 3 s. Needs scipy and matplotlib (requirements-dev.txt).
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import least_squares

from skyloop.sim import VehicleParameters
from skyloop.sim.identification import WINDOW_S, Misfit, Recording, Response, compare, read_recording, replay
from skyloop.sim.parameters import Limits
from skyloop.sim.streams import Floats
from skyloop.sim.vehicles import AR_DRONE

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("SKYLOOP_FIXTURES") or ROOT.parent / "shared" / "fixtures") / "ardrone-flights"
RUNS = ("0.5sImpulseNH5", "1sImpulseNH1", "8sStepHalfMagNH1")
PICTURE = ROOT / "docs" / "pictures" / "ardrone-identification.png"
JUDGED = "1sImpulseNH1"  # the run that the parameters in the code have not seen
AGREES_PITCH_RAD = np.radians(2.0)
AGREES_FORWARD_M_S = 0.25
SHOWN_S = (-0.4, 4.2)
INK, FAINT, REAL, MODEL = "#24292f", "#8c959f", "#1f6feb", "#d9730d"


@dataclass(frozen=True, slots=True)
class Free:
    """A parameter that is searched for: where the search begins, and between which bounds."""

    name: str
    start: float
    least: float
    most: float


FREE = (
    Free("attitude_frequency_rad_s", 10.0, 4.0, 30.0),
    Free("attitude_damping", 0.6, 0.2, 2.0),
    Free("linear_drag_per_s", 0.3, 0.0, 2.0),
    Free("airspeed_tilt_rad_s2_per_m2", 0.01, 0.0, 0.1),
    Free("level_brake_per_m", 0.1, 0.0, 1.0),
)


def main() -> None:
    usage = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    usage.add_argument("--data", type=Path, default=DATA, help="folder of the recordings, one folder each")
    usage.add_argument("--picture", type=Path, default=PICTURE, help="where the picture goes")
    given = usage.parse_args()
    folders = [given.data / name for name in RUNS]
    missing = [str(folder) for folder in folders if not folder.is_dir()]
    if missing:
        usage.error(f"no recording at {', '.join(missing)}: give the folder that holds them with --data")
    runs = [from_first_step(read_recording(folder)) for folder in folders]
    for left_out in runs:
        fitted = fit([run for run in runs if run is not left_out])
        print(f"\nFitted to the runs but {left_out.name}:")
        print("  " + ", ".join(f"{free.name} {getattr(fitted, free.name):.4g}" for free in FREE))
        for run in runs:
            print(f"  {line(run, fitted)}{'   <- judged' if run is left_out else ''}")
    print(f"\nIn the code (judged on {JUDGED}):")
    stamped = [from_first_step(read_recording(folder, as_stamped=True)) for folder in folders]
    for run, raw in zip(runs, stamped, strict=True):
        print(f"  {line(run, AR_DRONE)}")
        print(f"  {'with the times of receipt':>24}: {figures(raw, AR_DRONE)}")
        release_s = run.steps()[1]
        print(f"  {'after the release':>24}: {figures(run, AR_DRONE, release_s)}")
    draw(runs, stamped, given.picture)


def from_first_step(recording: Recording) -> Recording:
    return recording.since(recording.steps()[0])


def fit(runs: Sequence[Recording]) -> VehicleParameters:
    """The vehicle that comes nearest to these runs by least squares: each run, and within it pitch and speed in shares
    of the agreement that is wanted, weighs the same. Differential quotients come from drones that fly side by side."""
    start = np.array([free.start for free in FREE])

    def jacobian(values: Floats) -> Floats:
        steps = 0.01 * np.maximum(values, 0.2 * start)
        here, *aside = residuals(runs, [values, *(values + np.diag(steps))])
        return np.stack([(there - here) / step for there, step in zip(aside, steps, strict=True)], axis=1)

    found = least_squares(
        lambda values: residuals(runs, [values])[0],
        start,
        jacobian,
        bounds=([free.least for free in FREE], [free.most for free in FREE]),
        x_scale=start,
    )
    return vehicle(found.x)


def vehicle(values: Iterable[float]) -> VehicleParameters:
    changes: dict[str, Any] = {free.name: float(value) for free, value in zip(FREE, values, strict=True)}
    return replace(AR_DRONE, **changes)


def residuals(runs: Sequence[Recording], candidates: Sequence[Floats]) -> list[Floats]:
    """One array for each candidate."""
    parts: list[list[Floats]] = [[] for _ in candidates]
    for run in runs:
        response = replay(run.command, [vehicle(candidate) for candidate in candidates])
        for own, misfit in zip(parts, compare(response, run), strict=True):
            own.append(misfit.pitch / AGREES_PITCH_RAD / len(misfit.pitch) ** 0.5)
            own.append(misfit.forward / AGREES_FORWARD_M_S / len(misfit.forward) ** 0.5)
    return [np.concatenate(own) for own in parts]


def line(run: Recording, parameters: VehicleParameters) -> str:
    return f"{run.name:>24}: {figures(run, parameters)}"


def figures(run: Recording, parameters: VehicleParameters, begin_s: float = 0.0) -> str:
    """RMS over the window that begins at a time of the run."""
    misfit = misfit_of(run, replay(run.command, [parameters], begin_s + WINDOW_S), begin_s)
    return f"{np.degrees(misfit.pitch_rms):4.2f}°  {misfit.forward_rms:5.3f} m/s"


def misfit_of(run: Recording, response: Response, begin_s: float = 0.0) -> Misfit:
    return compare(response, run, begin_s, begin_s + WINDOW_S)[0]


# The picture ----------------------------------------------------------------------------------------------------------


def draw(runs: Sequence[Recording], stamped: Sequence[Recording], path: Path) -> None:
    """A column for each run: command, pitch and forward speed, recorded and simulated."""
    mpl.use("Agg")  # needs no display
    plt.rcParams.update({"font.family": "DejaVu Sans", "font.size": 9.5, "text.color": INK, "axes.labelcolor": INK})
    figure, axes = plt.subplots(
        3, len(runs), figsize=(12, 7.4), sharex=True, sharey="row", height_ratios=(0.55, 1.25, 1), squeeze=False
    )
    for column, run, raw in zip(axes.T, runs, stamped, strict=True):
        _column(column, run, raw)
    for plot, label in zip(axes[:, 0], ("command", "pitch, nose down [°]", "forward speed [m/s]"), strict=True):
        plot.set_ylabel(label)
    axes[2, 0].set_ylim(-0.3, 3.3)
    handles, labels = axes[1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=3, frameon=False, bbox_to_anchor=(0.985, 0.985))
    figure.suptitle("AR.Drone, steps in pitch", x=0.06, y=0.975, ha="left", fontsize=13, fontweight="bold")
    figure.tight_layout(rect=(0, 0, 1, 0.955))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, facecolor="white")
    plt.close(figure)
    print(f"\n{path}: {path.stat().st_size:,} bytes")


def _column(plots: Sequence[Any], run: Recording, raw: Recording) -> None:
    response = replay(run.command, [AR_DRONE], SHOWN_S[1])
    misfit = misfit_of(run, response)
    lead = np.arange(SHOWN_S[0], 0, 0.1)  # the simulated drone hovers until the step
    times, still = np.append(lead, response.times_s), np.zeros_like(lead)
    pairs = (
        (run.pitch, raw.pitch, response.pitch[0], np.degrees(1.0), f"{np.degrees(misfit.pitch_rms):.2f}°", 0.05),
        (run.forward, raw.forward, response.forward[0], 1.0, f"{misfit.forward_rms:.3f} m/s", 0.92),
    )
    command = run.command.between(*SHOWN_S)
    plots[0].step(command.times_s, command.values, where="post", color=INK, lw=1.4)
    plots[0].set_title(f"{run.name}  ({'judged' if run.name == JUDGED else 'fitted'})", loc="left", fontsize=10)
    for plot, (recorded, received, simulated, scale, rms, height) in zip(plots[1:], pairs, strict=True):
        received = received.between(*SHOWN_S)
        recorded = recorded.between(*SHOWN_S)
        plot.plot(received.times_s, received.values * scale, color=FAINT, lw=0.8, label="recorded, as received")
        plot.plot(recorded.times_s, recorded.values * scale, color=REAL, lw=1.6, label="recorded")
        plot.plot(times, np.append(still, simulated) * scale, color=MODEL, lw=1.6, label="simulated")
        plot.text(0.13, height, f"RMS {rms}", transform=plot.transAxes, va="center", color=INK)
    for plot in plots:
        plot.axvspan(0, WINDOW_S, color="#eaeef2", alpha=0.6, lw=0)
        plot.grid(color="#ffffff", lw=0.8)
        plot.spines[["top", "right"]].set_visible(False)
        plot.spines[["left", "bottom"]].set_color(FAINT)
        plot.tick_params(colors=FAINT, labelcolor=INK)
        plot.set_xlim(*SHOWN_S)
    plots[1].axhline(np.degrees(Limits().tilt_rad), color=FAINT, lw=0.8, ls=(0, (4, 3)))
    plots[1].text(SHOWN_S[1], np.degrees(Limits().tilt_rad), "limit", color=FAINT, ha="right", va="bottom")
    plots[2].set_xlabel("time after the step [s]")


if __name__ == "__main__":
    main()
