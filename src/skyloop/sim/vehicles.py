"""Vehicles whose response was identified from recorded flights; other parameters have their defaults."""

from __future__ import annotations

from skyloop.sim.parameters import VehicleParameters

#: The Parrot AR.Drone: identified by ``scripts/identify_ardrone.py`` from the pitch steps of an AR.Drone 1 that are
#: described in ``docs/ardrone-model.md``, fitted to five runs and judged on three that the fit has not seen.
AR_DRONE = VehicleParameters(
    attitude_frequency_rad_s=10.1,
    attitude_damping=0.65,
    linear_drag_per_s=0.396,
    quadratic_drag_per_m=0.0,  # came out as zero beside airspeed_tilt, and was left out
    airspeed_tilt_rad_s2_per_m2=0.0147,
    level_brake_per_s=0.303,
)
