"""The simulated AR.Drone responds like the recorded one, and the model's additions leave other vehicles unchanged."""

from __future__ import annotations

from dataclasses import astuple, fields, replace
from functools import cache
from math import degrees, radians
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.recorded_steps import (
    AR_DRONE_ESTIMATE,
    SAMPLE_PERIOD_S,
    Recording,
    SpeedEstimate,
    Track,
    compare,
    read_recording,
    replay,
    sample_times,
)
from skyloop.errors import FileFormatError, UsageError
from skyloop.messages import AnyAction, Attitude, Hover, Velocity
from skyloop.sim import Limits, Simulation, VehicleParameters, Wind
from skyloop.sim.parameters import GRAVITY_M_S2, with_ideal_sensors
from skyloop.sim.streams import Floats
from skyloop.sim.vehicles import AR_DRONE
from tests.sim.helpers import HALL, IDEAL, flying, steps
from tests.support.pages import rows, section
from tests.support.recordings import recorded

JUDGED = ("0.5sImpulseHalfMagNH1", "0.5sImpulseNH6", "1sImpulseNH1")
FITTED = ("0.4sImpulseNoHover", "0.5sImpulseNH5", "1sImpulseHalfMagNH2", "1sImpulseNH3", "8sStepHalfMagNH1")
HUNG = "1sImpulseNH1"  # here the radio link stalled
EXACT = SpeedEstimate(lag_s=1e-9, scale=1.0)  # a known speed, not an estimate


def folder_of(name: str) -> Path:
    return recorded(f"ardrone-flights/{name}")


@cache
def step_of(name: str) -> Recording:
    """Return a run, with times from its step on."""
    recording = read_recording(folder_of(name))
    return recording.since(recording.steps()[0])


# As recorded ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*FITTED, *JUDGED])
def test_each_step_has_the_recorded_response(name: str) -> None:
    run = step_of(name)
    [misfit] = compare(replay(run.command, [AR_DRONE]), run)
    assert len(misfit.pitch) > 550
    assert degrees(misfit.pitch_rms) < 2.0
    assert misfit.forward_rms < 0.25


@pytest.mark.parametrize("name", JUDGED)
def test_the_default_vehicle_is_less_accurate(name: str) -> None:
    """In runs outside the fit, even for the exact speed."""
    run = step_of(name)
    both = replay(run.command, [AR_DRONE, VehicleParameters()])
    ours, _ = compare(both, run)
    _, default = compare(both, run, estimate=EXACT)
    assert ours.pitch_rms < 0.9 * default.pitch_rms
    assert ours.forward_rms < 0.8 * default.forward_rms


def test_the_default_vehicle_would_not_pass() -> None:
    """The recordings therefore distinguish vehicles."""
    run = step_of(HUNG)
    _, default = compare(replay(run.command, [AR_DRONE, VehicleParameters()]), run)
    assert degrees(default.pitch_rms) > 2.0


def test_the_simulated_drone_is_no_faster_after_three_seconds() -> None:
    """It once was faster by 0.28 m/s on average; runs of the same command end up to 0.35 m/s apart."""
    faster = []
    for name in (*FITTED, *JUDGED):
        run = step_of(name)
        [misfit] = compare(replay(run.command, [AR_DRONE]), run)
        faster.append(float(misfit.forward[-1]))
    assert abs(np.mean(faster)) < 0.12
    assert min(faster) < 0.0
    assert max(faster) < 0.25


def test_half_a_command_tilted_the_recorded_drone_as_far_as_a_whole_one() -> None:
    runs = {name: step_of(name) for name in (*FITTED, *JUDGED)}
    halves = {name for name, run in runs.items() if run.command.values.max() == 0.5}
    tilts = {name: degrees(run.pitch.between(0.2, 0.5).values.max()) for name, run in runs.items()}
    assert halves == {name for name in runs if "HalfMag" in name}
    assert all(11.5 < tilt < 13.5 for tilt in tilts.values())


@pytest.mark.parametrize(("name", "length_s"), [("0.5sImpulseNH5", 0.5), (HUNG, 1.02), ("8sStepHalfMagNH1", 2.02)])
def test_a_run_holds_one_step_and_its_release(name: str, length_s: float) -> None:
    assert step_of(name).steps() == pytest.approx([0.0, length_s], abs=0.001)


# Reading --------------------------------------------------------------------------------------------------------------


def test_signs_and_units_are_ours() -> None:
    run, raw = read_recording(folder_of(HUNG)), np.loadtxt(folder_of(HUNG) / "theta_dump.dat")
    assert run.name == HUNG
    assert run.pitch.values == pytest.approx(np.radians(-raw[:, 1] / 1000))
    assert run.command.values.min() == 0.0
    assert run.forward.values.max() == pytest.approx(2.06, abs=0.01)


def test_times_of_receipt_are_kept_on_demand() -> None:
    raw = np.loadtxt(folder_of(HUNG) / "theta_dump.dat")
    stamped, evened = (read_recording(folder_of(HUNG), as_stamped=flag).pitch.times_s for flag in (True, False))
    assert (stamped == raw[:, 0]).all()
    assert (stamped - evened).max() > 0.3  # the link stalled this long around the step


@given(st.lists(st.floats(0.0, 0.5), min_size=1, max_size=60))
def test_samples_are_a_period_apart_and_never_later_than_received(gaps: list[float]) -> None:
    received: Floats = np.array(gaps, dtype=np.float64).cumsum(dtype=np.float64)
    taken = sample_times(received)
    assert (taken <= received + 1e-9).all()
    assert (np.diff(taken) >= SAMPLE_PERIOD_S - 1e-9).all()
    assert taken[-1] == pytest.approx(received[-1])


def test_a_link_without_jitter_changes_no_time() -> None:
    even: Floats = np.arange(100, dtype=np.float64) * SAMPLE_PERIOD_S
    assert sample_times(even) == pytest.approx(even)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("0.0 1.0\n0.1\n", "line 2: expected a time and a value, got '0.1'"),
        ("0.0 1.0\n0.1 north\n", "line 2"),
        ("0.1 1.0\n0.0 1.0\n", "times that don't fall"),
        ("0.1 nan\n0.2 1.0\n", "finite numbers"),
        ("", "at least two lines"),
    ],
)
def test_an_invalid_recording_is_refused(tmp_path: Path, text: str, complaint: str) -> None:
    for name in ("command", "theta", "vx"):
        (tmp_path / f"{name}_dump.dat").write_text("0.0 0.0\n1.0 0.0\n")
    (tmp_path / "theta_dump.dat").write_text(text)
    with pytest.raises(FileFormatError, match=complaint):
        read_recording(tmp_path)


def test_a_missing_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"command_dump\.dat can't be read: No such file"):
        read_recording(tmp_path)


def test_a_binary_recording_is_named(tmp_path: Path) -> None:
    (tmp_path / "command_dump.dat").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(FileFormatError, match=r"command_dump\.dat is not UTF-8 text"):
        read_recording(tmp_path)


# Replaying ------------------------------------------------------------------------------------------------------------


def constant(value: float) -> Track:
    return Track(np.array([0.0, 10.0]), np.array([value, value]))


def test_a_command_beyond_half_is_the_tilt_limit() -> None:
    half, whole = (replay(constant(value), [IDEAL]) for value in (0.5, 1.0))
    assert (half.pitch == whole.pitch).all()
    assert whole.pitch[0, -1] == pytest.approx(Limits().tilt_rad, abs=0.001)


def test_there_is_no_command_before_the_first_line() -> None:
    late = Track(np.array([1.0, 10.0]), np.array([1.0, 1.0]))
    response = replay(late, [IDEAL])
    assert np.abs(response.pitch[0, response.times_s <= 1.0]).max() < 0.002
    assert response.pitch[0, -1] > 0.2


def test_an_estimate_lags_behind_the_speed_and_scales_it() -> None:
    response = replay(constant(1.0), [IDEAL])
    slow = SpeedEstimate(lag_s=0.1, scale=2.0).of(response)
    assert EXACT.of(response) == pytest.approx(response.forward)
    late = np.interp(response.times_s - 0.1, response.times_s, response.forward[0])  # lags behind a steady increase
    assert slow[0, -200:] == pytest.approx(2.0 * late[-200:], abs=0.02)


def test_an_empty_list_of_vehicles_is_refused() -> None:
    with pytest.raises(UsageError, match="at least one vehicle"):
        replay(constant(1.0), [])


# Additions to the model -----------------------------------------------------------------------------------------------


def fly(simulation: Simulation, action: AnyAction, seconds: float) -> None:
    simulation.command(0, action)
    simulation.step(steps(seconds))


def test_both_additions_are_off_by_default() -> None:
    default = VehicleParameters()
    assert (default.airspeed_tilt_rad_s2_per_m2, default.level_brake_per_s) == (0.0, 0.0)


def test_a_default_vehicle_flies_the_same_next_to_an_ar_drone() -> None:
    alone = Simulation(HALL, 1, seed=3)
    beside = Simulation(HALL, 2, seed=3, parameters=[VehicleParameters(), AR_DRONE])
    for simulation in (alone, beside):
        fly(simulation, Hover(), 0.1)
        for action, seconds in ((Velocity(forward=1.0), 1.0), (Attitude(pitch=0.1, roll=0.05), 1.0)):
            fly(simulation, action, seconds)
    assert alone.truth(0) == beside.truth(0)


@pytest.mark.parametrize(
    ("wind", "pitch_sign", "roll_sign"),
    [((-2.0, 0.0, 0.0), -1, 0), ((2.0, 0.0, 0.0), 1, 0), ((0.0, -2.0, 0.0), 0, 1), ((0.0, 2.0, 0.0), 0, -1)],
)
def test_air_lifts_the_windward_side(wind: tuple[float, float, float], pitch_sign: int, roll_sign: int) -> None:
    tilt = 0.02
    simulation = flying(parameters=replace(IDEAL, airspeed_tilt_rad_s2_per_m2=tilt, linear_drag_per_s=0.0))
    simulation.set_wind(Wind(mean_m_s=wind))
    fly(simulation, Attitude(), 1.0)
    truth = simulation.truth(0)
    airspeed = np.subtract(truth.velocity_m_s, wind)[:2]
    expected = tilt * float(airspeed @ airspeed)
    assert truth.pitch_rad == pytest.approx(pitch_sign * expected, abs=0.01)
    assert truth.roll_rad == pytest.approx(roll_sign * expected, abs=0.01)


def test_a_gale_tilts_no_more_than_three_metres_a_second() -> None:
    simulation = flying(parameters=replace(IDEAL, airspeed_tilt_rad_s2_per_m2=0.01))
    simulation.set_wind(Wind(mean_m_s=(-12.0, 0.0, 0.0)))
    fly(simulation, Attitude(), 0.8)
    assert simulation.truth(0).pitch_rad == pytest.approx(-0.09, abs=0.003)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_brake_fades_as_the_set_point_grows(share: float) -> None:
    """A drone that flies to the right and gets a pure pitch command leans left by the whole brake."""
    brake, limit = 0.3, Limits().tilt_rad
    simulation = flying(parameters=replace(IDEAL, level_brake_per_s=brake))
    fly(simulation, Velocity(left=-1.0), 2.0)
    simulation.command(0, Attitude(pitch=share * limit))
    simulation.step(steps(0.6))
    truth = simulation.truth(0)
    forward, left, _ = truth.velocity_m_s
    lean = brake * np.array([left, -forward]) / GRAVITY_M_S2
    assert truth.pitch_rad == pytest.approx(share * limit + (1 - share) * lean[1], abs=radians(0.5))
    assert truth.roll_rad == pytest.approx(lean[0], abs=radians(0.7))
    assert lean[0] < -radians(0.7)


def test_an_ar_drone_holds_its_position_in_hover() -> None:
    simulation = flying(parameters=AR_DRONE, seconds=6.0)
    begin = np.array(simulation.truth(0).position_m)
    simulation.step(steps(10.0))
    assert np.abs(np.array(simulation.truth(0).position_m) - begin).max() < 0.5


def test_hover_stops_an_ar_drone_from_full_tilt() -> None:
    simulation = flying(parameters=with_ideal_sensors(AR_DRONE))
    fly(simulation, Attitude(pitch=Limits().tilt_rad), 1.0)
    assert simulation.truth(0).velocity_m_s[0] > 1.2
    fly(simulation, Hover(), 4.0)
    assert abs(simulation.truth(0).velocity_m_s[0]) < 0.2


# The page -------------------------------------------------------------------------------------------------------------

PAGE = "docs/ardrone-model.md"


def test_the_page_has_the_parameters_of_the_code() -> None:
    table = {row[0].strip("`"): float(row[1]) for row in rows(section(PAGE, "## Model and parameters"))}
    default = VehicleParameters()
    changed = {f.name for f in fields(default) if getattr(AR_DRONE, f.name) != getattr(default, f.name)}
    assert table == {name: getattr(AR_DRONE, name) for name in changed}


def test_the_page_has_the_measured_figures() -> None:
    table = rows(section(PAGE, "## Figures"))
    parts = {**dict.fromkeys(FITTED, "fitted"), **dict.fromkeys(JUDGED, "judged")}
    assert {row[0]: row[1] for row in table if row[1] in ("fitted", "judged")} == parts
    for name, _, pitch, forward, last, real in table[: len(parts)]:
        run = step_of(name)
        response = replay(run.command, [AR_DRONE])
        [misfit] = compare(response, run)
        reported, recorded = AR_DRONE_ESTIMATE.of(response)[0, -1], np.interp(3.0, *astuple(run.forward))
        assert reported == pytest.approx(float(last.removesuffix(" m/s")), abs=0.011)
        assert recorded == pytest.approx(float(real.removesuffix(" m/s")), abs=0.011)
        assert degrees(misfit.pitch_rms) == pytest.approx(float(pitch.rstrip("°")), abs=0.011)
        assert misfit.forward_rms == pytest.approx(float(forward.removesuffix(" m/s")), abs=0.0011)
