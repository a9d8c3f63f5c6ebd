"""Runs the public driver suite on a ROS 2 robot, in the environment that has rclpy and no pytest.

    python ros2_suite.py ADDRESS PID

PID is the robot's process, which is stopped and continued as the vehicle that disappears and appears. Prints the
outcome of each test as JSON: "" for passed, "skipped: …", or what failed.
"""

import json
import os
import signal
import sys
import traceback
import unittest

from skyloop.drivers.suite import DriverSuite


class Suite(DriverSuite):
    uri = sys.argv[1]
    connect_timeout_s = 10.0
    takeoff_timeout_s = 10.0

    def vehicle_disappears(self) -> None:
        os.kill(int(sys.argv[2]), signal.SIGSTOP)

    def vehicle_appears(self) -> None:
        os.kill(int(sys.argv[2]), signal.SIGCONT)


def main() -> None:
    outcomes = {}
    for name in sorted(name for name in dir(Suite) if name.startswith("test_")):
        try:
            getattr(Suite(), name)()
            outcomes[name] = ""
        except unittest.SkipTest as skipped:
            outcomes[name] = f"skipped: {skipped}"
        except Exception:  # noqa: BLE001  any failure is reported
            outcomes[name] = traceback.format_exc()
    print(json.dumps(outcomes))


if __name__ == "__main__":
    main()
