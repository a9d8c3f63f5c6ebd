"""Names of what keeps a flight controller from arming, and of modes. Pure."""

from __future__ import annotations

from typing import Final

from skyloop.vehicles.msp.wire.messages import INAV

#: Betaflight 4.1 (API 1.42) on, from bit 0; ARM_SWITCH is always the last of those that a version has.
BETAFLIGHT_FLAGS: Final = (
    *("NOGYRO", "FAILSAFE", "RXLOSS", "NOT_DISARMED", "BOXFAILSAFE", "RUNAWAY", "CRASH", "THROTTLE", "ANGLE"),
    *("BOOTGRACE", "NOPREARM", "LOAD", "CALIB", "CLI", "CMS", "BST", "MSP", "PARALYZE", "GPS", "RESCUE_SW"),
    *("DSHOT_TELEM", "REBOOT_REQD", "DSHOT_BBANG", "NO_ACC_CAL", "MOTOR_PROTO", "FLIP_SWITCH", "ALT_HOLD_SW"),
    "POS_HOLD_SW",
)
ARM_SWITCH: Final = "ARM_SWITCH"
#: INAV's, by bit.
INAV_FLAGS: Final = {
    6: "GEOZONE",
    7: "FAILSAFE",
    8: "NOT_LEVEL",
    9: "SENSORS_CALIBRATING",
    10: "SYSTEM_OVERLOADED",
    11: "NAVIGATION_UNSAFE",
    12: "COMPASS_NOT_CALIBRATED",
    13: "ACC_NOT_CALIBRATED",
    14: ARM_SWITCH,
    15: "HARDWARE_FAILURE",
    16: "BOXFAILSAFE",
    18: "RC_LINK",
    19: "THROTTLE",
    20: "CLI",
    21: "CMS_MENU",
    22: "OSD_MENU",
    23: "ROLLPITCH_NOT_CENTERED",
    24: "SERVO_AUTOTRIM",
    25: "OOM",
    26: "INVALID_SETTING",
    27: "PWM_OUTPUT_ERROR",
    28: "NO_PREARM",
    29: "DSHOT_BEEPER",
    30: "LANDING_DETECTED",
}
#: What a flag means and what helps, for people; flags that need no more than time are left out of the advice.
MEANINGS: Final = {
    "NOGYRO": "no gyroscope was found",
    "FAILSAFE": "failsafe is active: sticks are received again for half a second first",
    "RXLOSS": "no sticks are received",
    "NOT_DISARMED": "the arm switch was on before sticks were received",
    "BOXFAILSAFE": "the failsafe switch is on",
    "RUNAWAY": "a runaway take-off was stopped: check motor order and propellers",
    "CRASH": "a crash was detected: disarm",
    "THROTTLE": "the throttle is not low",
    "ANGLE": "it is not level",
    "BOOTGRACE": "it has just been switched on",
    "NOPREARM": "the prearm switch is off",
    "LOAD": "its processor is overloaded",
    "CALIB": "its sensors are being calibrated: keep it still",
    "CLI": "its command line is in use: end it",
    "CMS": "its menu is open",
    "MSP": "a configurator keeps it from arming: close that",
    "PARALYZE": "paralyze is active: switch it off and on again",
    "GPS": "it has no GPS fix, and GPS rescue is set up",
    "RESCUE_SW": "the GPS rescue switch is on",
    "DSHOT_TELEM": "motor controllers send no telemetry",
    "REBOOT_REQD": "settings were changed: restart it",
    "DSHOT_BBANG": "the outputs to the motors do not work",
    "NO_ACC_CAL": "its accelerometer was never calibrated",
    "MOTOR_PROTO": "no motor protocol is set",
    "FLIP_SWITCH": "the switch to turn over after a crash is on",
    "ALT_HOLD_SW": "the altitude hold switch is on",
    "POS_HOLD_SW": "the position hold switch is on",
    ARM_SWITCH: "the arm switch is on though it can't be armed: it is switched off and on again",
    "GEOZONE": "it is in a forbidden zone",
    "NOT_LEVEL": "it is not level",
    "SENSORS_CALIBRATING": "its sensors are being calibrated: keep it still",
    "SYSTEM_OVERLOADED": "its processor is overloaded",
    "NAVIGATION_UNSAFE": "navigation is not safe: it waits for GPS, see nav_extra_arming_safety",
    "COMPASS_NOT_CALIBRATED": "its compass was never calibrated",
    "ACC_NOT_CALIBRATED": "its accelerometer was never calibrated",
    "HARDWARE_FAILURE": "a sensor that is set up does not work",
    "RC_LINK": "no sticks are received",
    "INVALID_SETTING": "a setting is invalid: its command line's status names it",
    "NO_PREARM": "the prearm switch is off",
}

# Modes by the names of ``BOXNAMES``: their permanent numbers differ between firmwares.
ARM: Final = "ARM"
ANGLE: Final = "ANGLE"
PREARM: Final = "PREARM"
MSP_OVERRIDE: Final = ("MSP OVERRIDE", "MSP RC OVERRIDE")  #: Betaflight's, INAV's
ARMED_OF_INAV: Final = 1 << 2  #: among the flags of INAV's status


def flag_names(variant: str, flags: int, count: int) -> list[str]:
    """Return what keeps it from arming, by the firmware's own names.

    Args:
        variant: The firmware's four letters.
        flags: A bit each.
        count: How many flags its version has, as it reports; 0: not known.
    """
    names = []
    for bit in range(32):
        if not flags >> bit & 1:
            continue
        if variant == INAV:
            if bit in INAV_FLAGS:
                names.append(INAV_FLAGS[bit])
        elif count and bit == count - 1:
            names.append(ARM_SWITCH)
        else:
            names.append(BETAFLIGHT_FLAGS[bit] if bit < len(BETAFLIGHT_FLAGS) else f"flag {bit}")
    return names


def explained(names: list[str]) -> str:
    """Return names with what they mean, for people."""
    return "; ".join(f"{name} ({MEANINGS[name]})" if name in MEANINGS else name for name in names)
