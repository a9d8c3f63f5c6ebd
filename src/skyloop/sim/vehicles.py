"""Vehicles whose response was identified from recorded flights; other parameters have their defaults."""

from __future__ import annotations

from skyloop.sim.parameters import VehicleParameters

#: The Parrot AR.Drone: identified by ``scripts/identify_ardrone.py`` from the pitch steps of an AR.Drone 1 that are
#: described in ``docs/ardrone-model.md``, runs 0.5sImpulseNH5 and 8sStepHalfMagNH1, and judged on 1sImpulseNH1.
AR_DRONE = VehicleParameters(
    attitude_frequency_rad_s=9.74,
    attitude_damping=0.617,
    linear_drag_per_s=0.279,
    quadratic_drag_per_m=0.0,  # came out as zero beside airspeed_tilt, and was left out
    airspeed_tilt_rad_s2_per_m2=0.0111,
    level_brake_per_m=0.117,
)
