"""Vehicles whose response was identified from recorded flights, and vehicles modelled at rotor level.

Parameters not given have their defaults. ``docs/rotors.md`` tabulates the sources for the rotor-level vehicles.

Sources: [A] Agilicious, P. Foehn et al., "Agilicious: Open-source and open-hardware agile quadrotor for vision-based
flight", Science Robotics 7(67), 2022: thrust and torque fit, rotor speeds and lag in its library's ``Quadrotor``. [L]
The simulator of "Learning on the Fly", Robotics and Perception Group, University of Zurich, 2025: its default
quadrotor, and, for drag, a comment in its example of a vehicle. [N] L. Bauersfeld et al., "NeuroBEM: Hybrid Aerodynamic
Quadrotor Model", RSS 2021: the same racer's 5.1-inch propellers. [R] F. Furrer, M. Burri, M. Achtelik, R. Siegwart,
"RotorS - A Modular Gazebo MAV Simulator Framework", 2016: ``iris.xacro``. [F] J. Förster, "System Identification of
the Crazyflie 2.0 Nano Quadrocopter", ETH Zurich, 2015. [E] J. Eschmann, D. Albani, G. Loianno, "Data-Driven System
Identification of Quadrotors Subject to Motor Delays", 2024, as used in RotorPy 3.0.0. [D] drone-models 0.1.0, Learning
Systems and Robotics Lab, 2026: attitude responses of three Crazyflies, identified from flights. [B] Bitcraze,
Crazyflie 2.1 data sheet.
"""

from __future__ import annotations

from typing import Final

from skyloop.sim.parameters import RotorParameters, VehicleParameters

#: The Parrot AR.Drone, identified by ``scripts/identify_ardrone.py`` from pitch steps of an AR.Drone 1
#: (``docs/ardrone-model.md``), fitted to five runs and tested on three others.
AR_DRONE = VehicleParameters(
    attitude_frequency_rad_s=10.1,
    attitude_damping=0.65,
    linear_drag_per_s=0.396,
    quadratic_drag_per_m=0.0,  # fitting it together with airspeed_tilt yielded zero
    airspeed_tilt_rad_s2_per_m2=0.0147,
    level_brake_per_s=0.303,
)

#: A 5-inch racing quadrotor with a four-cell battery and a maximum thrust of 4.6 times its weight.
RACER = VehicleParameters(
    mass_kg=0.75,  # [L]
    radius_m=0.19,  # half the diagonal between the rotors, 0.125 m [L], plus a rotor's radius
    half_height_m=0.04,  # estimate
    rotor_radius_m=0.0648,  # 5.1 inch across [N]
    rotor_height_m=0.06,  # estimate
    most_thrust=3.8,  # leaves a sixth of the rotors' thrust for attitude control; estimate
    least_thrust=0.15,  # estimate
    attitude_frequency_rad_s=22.0,  # estimate for rotors with this response
    attitude_damping=0.8,
    most_angular_acceleration_rad_s2=200.0,  # estimate
    battery_charge_c=5400.0,  # 1500 mAh, estimate
    battery_full_v=16.8,
    battery_empty_v=13.2,
    battery_resistance_ohm=0.02,  # estimate
    crash_speed_m_s=6.0,  # estimate for a carbon fibre frame
    rotors=RotorParameters(
        places_m=((0.075, 0.1), (0.075, -0.1), (-0.075, 0.1), (-0.075, -0.1)),  # [L]
        inertia_kg_m2=(2.410e-3, 1.800e-3, 3.759e-3),  # [L]
        thrust_n_s2=1.562522e-6,  # [A]
        torque_m=1.908873e-8 / 1.562522e-6,  # [A]
        idle_speed_rad_s=150.0,  # [A]
        full_speed_rad_s=2332.4,  # 8.5 N per rotor [L]
        speed_up_s=0.033,  # [A]
        speed_down_s=0.033,
        rotor_drag_kg=6.2e-5,  # 0.26 and 0.28 N per m/s forward and left [L], at the sum of speeds in hover, 4340 rad/s
        rotor_inflow_kg=9.7e-5,  # 0.42 N per m/s up [L]
        body_drag_kg_m=(0.006, 0.006, 0.015),  # 100 and 250 cm² with a drag coefficient of 1; estimate
        efficiency=0.6,  # estimate
        rotor_inertia_kg_m2=5.64e-6,  # [L]
    ),
)

#: A 3DR Iris, with a maximum thrust of 1.6 times its weight.
IRIS = VehicleParameters(
    mass_kg=1.52,  # includes the rotors [R]
    radius_m=0.36,  # distance to the rotors [R] plus a rotor's radius
    half_height_m=0.055,  # 110 mm high [R]
    rotor_radius_m=0.1,  # [R]
    rotor_height_m=0.078,  # [R]: half the body's height plus 23 mm
    most_thrust=1.45,  # leaves a tenth of the rotors' thrust for attitude control; estimate
    least_thrust=0.2,  # estimate
    attitude_frequency_rad_s=12.0,  # estimate
    attitude_damping=0.8,
    most_angular_acceleration_rad_s2=30.0,  # estimate
    yaw_time_constant_s=0.2,  # estimate
    battery_charge_c=18360.0,  # 5100 mAh, 3 cells; estimate
    battery_full_v=12.6,
    battery_empty_v=9.9,
    battery_resistance_ohm=0.015,  # estimate
    rotors=RotorParameters(
        places_m=((0.13, 0.22), (0.13, -0.22), (-0.13, 0.2), (-0.13, -0.2)),  # [R]
        inertia_kg_m2=(0.0347563, 0.0458929, 0.0977),  # [R]
        thrust_n_s2=8.54858e-6,  # [R]
        torque_m=0.016,  # [R]
        idle_speed_rad_s=100.0,  # estimate
        full_speed_rad_s=838.0,  # [R]
        speed_up_s=0.0125,  # [R]
        speed_down_s=0.025,  # [R]
        rotor_drag_kg=8.06428e-5,  # [R]
        rotor_inflow_kg=8.06428e-5,  # estimate: same as the drag across the axis
        body_drag_kg_m=(0.03, 0.03, 0.06),  # 500 and 1000 cm² with a drag coefficient of 1; estimate
        efficiency=0.8,  # estimate for about 20 minutes in the air
    ),
)

#: A Crazyflie 2, with a maximum thrust of 1.7 times its weight.
CRAZYFLIE = VehicleParameters(
    mass_kg=0.028,  # [F]
    radius_m=0.069,  # 46 mm to the rotors' axes [F] plus the radius of a rotor
    half_height_m=0.0145,  # 29 mm high [B]
    rotor_radius_m=0.0231,  # 46 mm across [B]
    rotor_height_m=0.02,  # estimate
    most_thrust=1.5,  # leaves a seventh of the rotors' thrust for attitude control; estimate
    least_thrust=0.3,  # estimate
    attitude_frequency_rad_s=17.0,  # together with the damping, gives the mean step response of all three in [D]
    attitude_damping=0.67,
    most_angular_acceleration_rad_s2=150.0,  # estimate
    battery_charge_c=900.0,  # 250 mAh [B]
    battery_full_v=4.2,
    battery_empty_v=3.0,
    battery_resistance_ohm=0.1,  # estimate
    electronics_power_w=0.5,  # estimate
    crash_speed_m_s=5.0,  # estimate for a light vehicle
    rotors=RotorParameters(
        places_m=((0.0325, 0.0325), (0.0325, -0.0325), (-0.0325, 0.0325), (-0.0325, -0.0325)),  # [F]
        inertia_kg_m2=(16.571710e-6, 16.655602e-6, 29.261652e-6),  # [F], the diagonal
        thrust_n_s2=1.28192e-8,  # [F]
        torque_m=0.005964552,  # [F]
        idle_speed_rad_s=380.8359,  # [F], at the minimum command
        full_speed_rad_s=3052.4,  # [F], at a command of 65535
        speed_up_s=0.072,  # [E]
        speed_down_s=0.072,
        rotor_drag_kg=9.1785e-7,  # [F]
        rotor_inflow_kg=10.311e-7,  # [F]
        body_drag_kg_m=(0.0, 0.0, 0.0),  # [F]: all drag increases with the rotors' speed
        efficiency=0.5,  # estimate for 7 minutes in the air [B]
    ),
)

#: Vehicles by their names in addresses, environments and command lines.
VEHICLES: Final = {
    "quadrotor": VehicleParameters(),
    "ardrone": AR_DRONE,
    "racer": RACER,
    "iris": IRIS,
    "crazyflie": CRAZYFLIE,
}
