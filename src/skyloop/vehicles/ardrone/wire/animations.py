"""The drone's animations by name: their numbers and, of flight animations, how long they last.

Names and order: ``ardrone_api.h`` of the AR.Drone SDK 2.0.1; durations: what its applications ask for.
"""

from __future__ import annotations

from typing import Final

LED_ANIMATIONS: Final = (
    "blink_green_red",
    "blink_green",
    "blink_red",
    "blink_orange",
    "snake_green_red",
    "fire",
    "standard",
    "red",
    "green",
    "red_snake",
    "blank",
    "right_missile",
    "left_missile",
    "double_missile",
    "front_left_green_others_red",
    "front_right_green_others_red",
    "rear_right_green_others_red",
    "rear_left_green_others_red",
    "left_green_right_red",
    "left_red_right_green",
    "blink_standard",
)
#: Name and duration [ms].
FLIGHT_ANIMATIONS: Final = (
    ("phi_m30_deg", 1000),
    ("phi_30_deg", 1000),
    ("theta_m30_deg", 1000),
    ("theta_30_deg", 1000),
    ("theta_20deg_yaw_200deg", 1000),
    ("theta_20deg_yaw_m200deg", 1000),
    ("turnaround", 5000),
    ("turnaround_godown", 5000),
    ("yaw_shake", 2000),
    ("yaw_dance", 5000),
    ("phi_dance", 5000),
    ("theta_dance", 5000),
    ("vz_dance", 5000),
    ("wave", 5000),
    ("phi_theta_mixed", 5000),
    ("double_phi_theta_mixed", 5000),
    ("flip_ahead", 15),
    ("flip_behind", 15),
    ("flip_left", 15),
    ("flip_right", 15),
)
NO_ANIMATION: Final = "none"
FIRST_FLIP: Final = 16
