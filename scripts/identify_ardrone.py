"""Identify the flight model of the simulated AR.Drone from recorded pitch steps, judge it, and draw it.

    python -m scripts.identify_ardrone
    python -m scripts.identify_ardrone --data ../shared/fixtures/ardrone-flights --picture steps.png

The recordings are not part of the project: docs/ardrone-model.md names their source. The parameters, and how the
drone's own estimate of its speed follows the speed, are fitted to all recordings but one and judged on that one, for
each in turn. The values in the code, ``AR_DRONE`` in ``skyloop.sim.vehicles`` and ``AR_DRONE_ESTIMATE`` in
``benchmarks.recorded_steps``, are fitted to five and judged on three; they are compared with all, beside the default
vehicle, and drawn. Figures are RMS over 3 s, and the reported speed 3 s after the step, simulated and recorded. Needs
scipy and matplotlib (requirements-dev.txt), and some five minutes.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import least_squares

from benchmarks.recorded_steps import (
    AR_DRONE_ESTIMATE,
    WINDOW_S,
    Recording,
    SpeedEstimate,
    compare,
    read_recording,
    replay,
)
from skyloop.sim import VehicleParameters
from skyloop.sim.parameters import Limits
from skyloop.sim.streams import Floats
from skyloop.sim.vehicles import AR_DRONE

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("SKYLOOP_FIXTURES") or ROOT.parent / "shared" / "fixtures") / "ardrone-flights"
FITTED = ("0.4sImpulseNoHover", "0.5sImpulseNH5", "1sImpulseHalfMagNH2", "1sImpulseNH3", "8sStepHalfMagNH1")
#: The recordings not used for the code: every second run by name, but not the long step, which is the only one.
JUDGED = ("0.5sImpulseHalfMagNH1", "0.5sImpulseNH6", "1sImpulseNH1")
RUNS = tuple(sorted(FITTED + JUDGED))
DRAWN = ("0.5sImpulseHalfMagNH1", "0.5sImpulseNH6", "1sImpulseNH1", "8sStepHalfMagNH1")
PICTURE = ROOT / "docs" / "pictures" / "ardrone-identification.png"
AGREES_PITCH_RAD = np.radians(2.0)
AGREES_FORWARD_M_S = 0.25
SHOWN_S = (-0.4, 4.2)
LABELS = ("command", "pitch, nose down [°]", "forward speed, reported [m/s]")
INK, FAINT, REAL, MODEL = "#24292f", "#8c959f", "#1f6feb", "#d9730d"


@dataclass(frozen=True, slots=True)
class Free:
    """A parameter to search: start and bounds."""

    name: str
    start: float
    least: float
    most: float


FREE = (
    Free("attitude_frequency_rad_s", 10.0, 4.0, 30.0),
    Free("attitude_damping", 0.6, 0.2, 2.0),
    Free("linear_drag_per_s", 0.3, 0.0, 2.0),
    Free("airspeed_tilt_rad_s2_per_m2", 0.01, 0.0, 0.1),
    Free("level_brake_per_s", 0.3, 0.0, 2.0),
    # The estimate's.
    Free("lag_s", 0.1, 0.01, 0.5),
    Free("scale", 1.1, 0.5, 2.0),
)

Model = tuple[VehicleParameters, SpeedEstimate]
IN_THE_CODE: Model = (AR_DRONE, AR_DRONE_ESTIMATE)
BY_DEFAULT: Model = (VehicleParameters(), AR_DRONE_ESTIMATE)
BY_DEFAULT_PLAIN: Model = (VehicleParameters(), SpeedEstimate(1e-9, 1.0))


def main() -> None:
    usage = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    usage.add_argument("--data", type=Path, default=DATA, help="folder of the recordings, one folder each")
    usage.add_argument("--picture", type=Path, default=PICTURE, help="file for the picture")
    usage.add_argument("--only-compare", action="store_true", help="don't fit: compare and draw the code's values")
    usage.add_argument("--hold", action="append", default=[], metavar="NAME=VALUE", help="don't fit this parameter")
    given = usage.parse_args()
    held = {name: float(value) for name, _, value in (one.partition("=") for one in given.hold)}
    if unknown := held.keys() - {one.name for one in FREE}:
        usage.error(f"--hold {', '.join(unknown)}: none of {', '.join(one.name for one in FREE)}")
    free, base = [one for one in FREE if one.name not in held], changed(IN_THE_CODE, held.items())
    folders = [given.data / name for name in RUNS]
    missing = [str(folder) for folder in folders if not folder.is_dir()]
    if missing:
        usage.error(f"no recording at {', '.join(missing)}: give the folder that holds them with --data")
    runs = [from_first_step(read_recording(folder)) for folder in folders]
    if not given.only_compare:
        print("\nEach run, judged by the fit to all others:")
        faster = []
        for run in runs:
            fitted = fit([other for other in runs if other is not run], free, base)
            print(f"  {line(run, fitted)}   {values(fitted)}", flush=True)
            faster.append(judge(run, fitted))
        print("  {:>24}: {:5.2f}°  {:5.3f} m/s  {:+5.2f} m/s".format("mean, faster by", *np.mean(faster, axis=0)))
        if held:
            return
        fitted = fit([run for run in runs if run.name in FITTED])
        print(f"\nFitted to {', '.join(FITTED)}:\n  {values(fitted)}")
        for run in runs:
            print(f"  {line(run, fitted)}")
    stamped = [from_first_step(read_recording(folder, as_stamped=True)) for folder in folders]
    for title, model in (
        ("In the code", IN_THE_CODE),
        ("The vehicle by default", BY_DEFAULT),
        ("The vehicle by default, its speed not estimated but known", BY_DEFAULT_PLAIN),
    ):
        print(f"\n{title}:")
        for run in runs:
            print(f"  {line(run, model)}")
    print("\nIn the code, with the times of receipt, and counted from the release:")
    for run, raw in zip(runs, stamped, strict=True):
        print(f"  {line(raw, IN_THE_CODE)}   |{figures(run, IN_THE_CODE, run.steps()[1])}")
    drawn = [number for number, run in enumerate(runs) if run.name in DRAWN]
    draw([runs[number] for number in drawn], [stamped[number] for number in drawn], given.picture)


def from_first_step(recording: Recording) -> Recording:
    return recording.since(recording.steps()[0])


def fit(runs: Sequence[Recording], free: Sequence[Free] = FREE, base: Model = IN_THE_CODE) -> Model:
    """Return the vehicle and estimate nearest to these runs by least squares: each run, and within it pitch and speed
    as shares of the desired agreement, has equal weight. Difference quotients come from drones that fly side by
    side."""
    start = np.array([one.start for one in free])

    def models(candidates: Sequence[Floats]) -> list[Model]:
        return [changed(base, zip((one.name for one in free), values, strict=True)) for values in candidates]

    def jacobian(values: Floats) -> Floats:
        steps = 0.01 * np.maximum(values, 0.2 * start)
        here, *aside = residuals(runs, models([values, *(values + np.diag(steps))]))
        return np.stack([(there - here) / step for there, step in zip(aside, steps, strict=True)], axis=1)

    found = least_squares(
        lambda values: residuals(runs, models([values]))[0],
        start,
        jacobian,
        bounds=([one.least for one in free], [one.most for one in free]),
        x_scale=start,
    )
    [fitted] = models([found.x])
    return fitted


def changed(model: Model, parameters: Iterable[tuple[str, float]]) -> Model:
    vehicle, estimate = model
    changes: dict[str, Any] = {name: float(value) for name, value in parameters}
    own = {field.name: changes.pop(field.name) for field in fields(estimate) if field.name in changes}
    return replace(vehicle, **changes), replace(estimate, **own)


def values(model: Model) -> str:
    both = asdict(model[0]) | asdict(model[1])
    return ", ".join(f"{free.name} {both[free.name]:.4g}" for free in FREE)


def residuals(runs: Sequence[Recording], models: Sequence[Model]) -> list[Floats]:
    """Return one array for each model."""
    parts: list[list[Floats]] = [[] for _ in models]
    for run in runs:
        response = replay(run.command, [vehicle for vehicle, _ in models])
        for number, (own, (_, estimate)) in enumerate(zip(parts, models, strict=True)):
            misfit = compare(response, run, estimate=estimate)[number]
            own.append(misfit.pitch / AGREES_PITCH_RAD / len(misfit.pitch) ** 0.5)
            own.append(misfit.forward / AGREES_FORWARD_M_S / len(misfit.forward) ** 0.5)
    return [np.concatenate(own) for own in parts]


def line(run: Recording, model: Model) -> str:
    return f"{run.name:>24}: {figures(run, model)}{'  judged' if run.name in JUDGED else '        '}"


def figures(run: Recording, model: Model, begin_s: float = 0.0) -> str:
    """Return the RMS over the window that begins at a time of the run, and the speeds at its end."""
    pitch, forward, faster = judge(run, model, begin_s)
    recorded = float(np.interp(begin_s + WINDOW_S, run.forward.times_s, run.forward.values))
    return f"{pitch:5.2f}°  {forward:5.3f} m/s  {recorded + faster:5.2f} for {recorded:5.2f} m/s"


def judge(run: Recording, model: Model, begin_s: float = 0.0) -> tuple[float, float, float]:
    """Return the RMS of pitch [°] and speed [m/s] over the window, and the simulated excess speed at its end."""
    vehicle, estimate = model
    response = replay(run.command, [vehicle], begin_s + WINDOW_S)
    misfit = compare(response, run, begin_s, begin_s + WINDOW_S, estimate)[0]
    recorded = float(np.interp(begin_s + WINDOW_S, run.forward.times_s, run.forward.values))
    faster = float(estimate.of(response)[0, -1]) - recorded
    return float(np.degrees(misfit.pitch_rms)), misfit.forward_rms, faster


# The picture ----------------------------------------------------------------------------------------------------------


def draw(runs: Sequence[Recording], stamped: Sequence[Recording], path: Path) -> None:
    """Draw a column for each run: command, pitch and forward speed, recorded and simulated."""
    mpl.use("Agg")  # needs no display
    plt.rcParams.update({"font.family": "DejaVu Sans", "font.size": 9.5, "text.color": INK, "axes.labelcolor": INK})
    figure, axes = plt.subplots(
        3, len(runs), figsize=(15, 7.4), sharex=True, sharey="row", height_ratios=(0.55, 1.25, 1), squeeze=False
    )
    for column, run, raw in zip(axes.T, runs, stamped, strict=True):
        _column(column, run, raw)
    for plot, label in zip(
        axes[:, 0], ("command", "pitch, nose down [°]", "forward speed, reported [m/s]"), strict=True
    ):
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
    [misfit] = compare(response, run)
    lead = np.arange(SHOWN_S[0], 0, 0.1)  # the simulated drone hovers until the step
    times, still = np.append(lead, response.times_s), np.zeros_like(lead)
    pairs = (
        (run.pitch, raw.pitch, response.pitch[0], np.degrees(1.0), f"{np.degrees(misfit.pitch_rms):.2f}°", 0.05),
        (run.forward, raw.forward, AR_DRONE_ESTIMATE.of(response)[0], 1.0, f"{misfit.forward_rms:.3f} m/s", 0.92),
    )
    command = run.command.between(*SHOWN_S)
    plots[0].step(command.times_s, command.values, where="post", color=INK, lw=1.4)
    plots[0].set_title(f"{run.name}  ({'judged' if run.name in JUDGED else 'fitted'})", loc="left", fontsize=10)
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
