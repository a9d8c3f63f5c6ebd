"""Vehicles whose response was identified from recorded flights; other parameters have their defaults."""

from __future__ import annotations

from skyloop.sim.parameters import VehicleParameters
from skyloop.sim.rotor_parameters import RotorParameters

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

#: A 5-inch racing quadrotor.
RACER = VehicleParameters(
    mass_kg=0.752,
    radius_m=0.19,
    half_height_m=0.04,
    rotor_radius_m=0.0648,
    rotor_height_m=0.06,
    most_thrust=3.6,
    least_thrust=0.15,
    attitude_frequency_rad_s=22.0,
    attitude_damping=0.8,
    most_angular_acceleration_rad_s2=200.0,
    battery_charge_c=4680.0,
    battery_full_v=16.8,
    battery_empty_v=13.2,
    battery_resistance_ohm=0.02,
    rotors=RotorParameters(
        places_m=((0.075, 0.1), (0.075, -0.1), (-0.075, 0.1), (-0.075, -0.1)),
        inertia_kg_m2=(2.5e-3, 2.1e-3, 4.3e-3),
        thrust_n_s2=1.562522e-6,
        torque_m=0.022,
        idle_speed_rad_s=150.0,
        full_speed_rad_s=2332.0,
        speed_up_s=0.033,
        speed_down_s=0.033,
        rotor_drag_kg=7.0e-5,
        rotor_inflow_kg=7.0e-5,
        body_drag_kg_m=(0.012, 0.012, 0.03),
        efficiency=0.6,
    ),
)

#: A 3DR Iris.
IRIS = VehicleParameters(
    mass_kg=1.52,
    radius_m=0.36,
    half_height_m=0.055,
    rotor_radius_m=0.1,
    rotor_height_m=0.08,
    most_thrust=1.45,
    least_thrust=0.2,
    attitude_frequency_rad_s=12.0,
    attitude_damping=0.8,
    most_angular_acceleration_rad_s2=30.0,
    yaw_time_constant_s=0.2,
    battery_charge_c=18360.0,
    battery_full_v=12.6,
    battery_empty_v=9.9,
    battery_resistance_ohm=0.02,
    rotors=RotorParameters(
        places_m=((0.13, 0.22), (0.13, -0.22), (-0.13, 0.2), (-0.13, -0.2)),
        inertia_kg_m2=(0.0347563, 0.0458929, 0.0977),
        thrust_n_s2=8.54858e-6,
        torque_m=0.016,
        idle_speed_rad_s=100.0,
        full_speed_rad_s=838.0,
        speed_up_s=0.0125,
        speed_down_s=0.025,
        rotor_drag_kg=8.06428e-5,
        rotor_inflow_kg=8.06428e-5,
        body_drag_kg_m=(0.03, 0.03, 0.06),
        efficiency=0.5,
    ),
)

#: A Crazyflie 2.
CRAZYFLIE = VehicleParameters(
    mass_kg=0.028,
    radius_m=0.065,
    half_height_m=0.0145,
    rotor_radius_m=0.0231,
    rotor_height_m=0.02,
    most_thrust=1.5,
    least_thrust=0.3,
    attitude_frequency_rad_s=16.0,
    attitude_damping=0.8,
    most_angular_acceleration_rad_s2=100.0,
    battery_charge_c=900.0,
    battery_full_v=4.2,
    battery_empty_v=3.0,
    battery_resistance_ohm=0.1,
    electronics_power_w=0.5,
    rotors=RotorParameters(
        places_m=((0.0325, 0.0325), (0.0325, -0.0325), (-0.0325, 0.0325), (-0.0325, -0.0325)),
        inertia_kg_m2=(16.571710e-6, 16.655602e-6, 29.261652e-6),
        thrust_n_s2=1.28192e-8,
        torque_m=0.005964552,
        idle_speed_rad_s=380.8359,
        full_speed_rad_s=3052.4,
        speed_up_s=0.04,
        speed_down_s=0.06,
        rotor_drag_kg=9.1785e-7,
        rotor_inflow_kg=10.311e-7,
        body_drag_kg_m=(0.0, 0.0, 0.0),
        efficiency=0.5,
    ),
)
