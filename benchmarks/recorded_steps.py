"""Pitch steps recorded from a real vehicle, and the same commands flown by simulated vehicles.

A recording is a folder with three text files from the control characterisation of rc500/ardrone_archive_aarons_laptop.
Each line has one sample: Unix time of receipt [s] and a value.

==================  ==================================================================================================
``command_dump``    pitch command, -1 to 1 of the drone's own limit, negative nose down; stamped when sent
``theta_dump``      pitch [millidegrees], negative nose down
``vx_dump``         the drone's own estimate of its forward speed [mm/s]
==================  ==================================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from skyloop.errors import FileFormatError, UsageError
from skyloop.files import read_text
from skyloop.messages import Attitude, Takeoff
from skyloop.messages.geometry import clamped
from skyloop.sim.dynamics import STEP_S
from skyloop.sim.parameters import Limits, VehicleParameters, with_ideal_sensors
from skyloop.sim.simulation import Simulation
from skyloop.sim.streams import Floats
from skyloop.sim.world_file import parse_world

#: Duration of the comparison, from the beginning of a step.
WINDOW_S = 3.0
_MAX_BYTES = 16 << 20  # size limit of a track; an hour at 200 Hz is 15 MB
SAMPLE_PERIOD_S = 0.005  #: interval between samples of the recorded drone
#: Half a command tilted the recorded drone as far as a full one: it tilts fully from this magnitude on.
FULL_TILT_COMMAND = 0.5

_HALL = parse_world("[room]\nsize = [30, 30, 10]\n", "hall")
_SETTLED_S = 4.0  # time after which the simulated drones have taken off and are hovering


@dataclass(frozen=True, slots=True)
class Track:
    """Samples of one quantity: ``times_s`` and ``values``, both of shape (n,), with times that never decrease."""

    times_s: Floats
    values: Floats

    def between(self, begin_s: float, end_s: float) -> Track:
        """Return the samples from one time to another."""
        chosen = (self.times_s >= begin_s) & (self.times_s <= end_s)
        return Track(self.times_s[chosen], self.values[chosen])


@dataclass(frozen=True, slots=True)
class Recording:
    """A recorded flight. Times are in seconds of the clock that stamped them."""

    name: str  #: the folder's name
    command: Track  #: command as recorded, but positive for nose down
    pitch: Track  #: pitch, positive for nose down [rad]
    forward: Track  #: forward speed [m/s]

    def steps(self) -> list[float]:
        """Times at which the command changed [s]."""
        changes = np.flatnonzero(np.diff(self.command.values)) + 1
        return [float(time) for time in self.command.times_s[changes]]

    def since(self, begin_s: float) -> Recording:
        """Return the same recording with times relative to this time."""
        tracks = (self.command, self.pitch, self.forward)
        return Recording(self.name, *(Track(track.times_s - begin_s, track.values) for track in tracks))


@dataclass(frozen=True, slots=True)
class Response:
    """The motion of simulated vehicles, with one row per vehicle."""

    times_s: Floats  #: times after the start of the step
    pitch: Floats  #: pitch, shape (vehicles, samples) [rad]
    forward: Floats  #: forward speed, shape (vehicles, samples) [m/s]


@dataclass(frozen=True, slots=True)
class SpeedEstimate:
    """A first-order model of the recorded drone's speed estimate."""

    lag_s: float  #: time constant [s]
    #: Factor of the estimate. In the recordings, a pitch that reads too low by the same factor looks the same.
    scale: float

    def of(self, response: Response) -> Floats:
        """Return the speed that the vehicles would report, shape (vehicles, samples) [m/s]."""
        share = 1.0 - math.exp(-STEP_S / self.lag_s)
        reported = np.empty_like(response.forward)
        last = response.forward[:, 0]
        for number, forward in enumerate(response.forward.T):
            last = last + share * (forward - last)
            reported[:, number] = last
        return self.scale * reported


#: Fitted, together with the vehicle, by ``scripts/identify_ardrone.py``.
AR_DRONE_ESTIMATE = SpeedEstimate(lag_s=0.124, scale=1.15)


@dataclass(frozen=True, slots=True)
class Misfit:
    """Simulated minus recorded values at the times of the recorded samples: ``pitch`` [rad], ``forward`` [m/s].

    The speed is the one that the vehicle reports.
    """

    pitch: Floats
    forward: Floats

    @property
    def pitch_rms(self) -> float:
        """Root mean square of the misfit in pitch [rad]."""
        return float(np.sqrt(np.mean(self.pitch**2)))

    @property
    def forward_rms(self) -> float:
        """Root mean square of the misfit in speed [m/s]."""
        return float(np.sqrt(np.mean(self.forward**2)))


def read_recording(folder: Path, *, as_stamped: bool = False) -> Recording:
    """Read the recording in a folder.

    Args:
        folder: Folder with the files ``command_dump.dat``, ``theta_dump.dat`` and ``vx_dump.dat``.
        as_stamped: Whether samples keep their times of receipt; otherwise they get plausible sampling times from
            :func:`sample_times`.

    Raises:
        FileFormatError: A file can't be read.
    """
    command, theta, vx = (_read(folder / f"{name}_dump.dat") for name in ("command", "theta", "vx"))
    if not as_stamped:
        theta, vx = (Track(sample_times(track.times_s), track.values) for track in (theta, vx))
    pitch = Track(theta.times_s, np.radians(-theta.values / 1000))
    return Recording(folder.name, Track(command.times_s, -command.values), pitch, Track(vx.times_s, vx.values / 1000))


def _read(path: Path) -> Track:
    lines = read_text(path, "the recorded track", _MAX_BYTES).splitlines()
    rows = []
    for number, line in enumerate(lines, start=1):
        try:
            time_s, value = map(float, line.split())
        except ValueError:
            raise FileFormatError(f"{path}, line {number}: expected a time and a value, got {line!r:.80}") from None
        rows.append((time_s, value))
    table = np.array(rows, dtype=np.float64).reshape(-1, 2)
    if len(table) < 2 or not np.isfinite(table).all() or (np.diff(table[:, 0]) < 0).any():
        raise FileFormatError(f"{path}: expected at least two lines with finite numbers and times that don't fall")
    return Track(table[:, 0], table[:, 1])


def sample_times(received_s: Floats, period_s: float = SAMPLE_PERIOD_S) -> Floats:
    """Estimate the latest possible sampling times from times of receipt.

    Each sample was taken at least one period before the next one. A radio link that stalls and then delivers everything
    at once makes times of receipt useless for dynamics.
    """
    ticks = np.arange(len(received_s)) * period_s
    latest: Floats = np.minimum.accumulate((received_s - ticks)[::-1])[::-1] + ticks
    return latest


def replay(command: Track, vehicles: Sequence[VehicleParameters], duration_s: float = WINDOW_S) -> Response:
    """Fly a command with simulated vehicles in calm air, using sensors without errors.

    Each vehicle hovers and, from time 0 on, gets the command as its pitch set-point. Magnitudes from
    :data:`FULL_TILT_COMMAND` on mean the tilt limit. A command of 0 is a level set-point, which differs from hovering.
    """
    if not vehicles:
        raise UsageError("give at least one vehicle")
    limits = Limits()
    ideal = [with_ideal_sensors(vehicle) for vehicle in vehicles]
    simulation = Simulation(_HALL, len(ideal), seed=0, parameters=ideal, limits=limits)
    drones = range(len(ideal))
    for drone in drones:
        simulation.command(drone, Takeoff())
    simulation.step(round(_SETTLED_S / STEP_S))
    times: Floats = np.arange(round(duration_s / STEP_S) + 1, dtype=np.float64) * STEP_S
    pitch, forward = np.empty((2, len(ideal), len(times)))
    given = None
    for number, value in enumerate(_held(command, times)):
        if value != given:
            given = value
            share = clamped(given / FULL_TILT_COMMAND, 1.0)
            for drone in drones:
                simulation.command(drone, Attitude(pitch=share * limits.tilt_rad))
        for drone in drones:
            truth = simulation.truth(drone)
            pitch[drone, number], forward[drone, number] = truth.pitch_rad, truth.velocity_m_s[0]
        simulation.step()
    return Response(times, pitch, forward)


def _held(command: Track, times_s: Floats) -> list[float]:
    """Return the command in force at these times: the last one before each, or 0 before the first one."""
    last = np.searchsorted(command.times_s, times_s + 1e-9, side="right") - 1
    values = np.where(last < 0, 0.0, command.values[np.maximum(last, 0)])
    return [float(value) for value in values]


def compare(
    response: Response,
    recorded: Recording,
    begin_s: float = 0.0,
    end_s: float = WINDOW_S,
    estimate: SpeedEstimate = AR_DRONE_ESTIMATE,
) -> list[Misfit]:
    """Return how each vehicle differs from a recording, with times like the response's, between two times."""
    pitch, forward = recorded.pitch.between(begin_s, end_s), recorded.forward.between(begin_s, end_s)
    return [
        Misfit(
            np.interp(pitch.times_s, response.times_s, own_pitch) - pitch.values,
            np.interp(forward.times_s, response.times_s, own_forward) - forward.values,
        )
        for own_pitch, own_forward in zip(response.pitch, estimate.of(response), strict=True)
    ]
