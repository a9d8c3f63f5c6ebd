"""Batteries: charge and voltage under the motors' power, which grows with thrust to the power 3/2.

Source: momentum theory of a rotor in hover.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from skyloop.sim.dynamics import column
from skyloop.sim.parameters import GRAVITY_M_S2, VehicleParameters
from skyloop.sim.streams import Floats


class Batteries:
    """The drones' batteries.

    Attributes:
        charge: What is left, 0 to 1, (n,).
        voltage: At the terminals, (n,) [V].
    """

    def __init__(self, parameters: Sequence[VehicleParameters], charge: Floats) -> None:
        self.charge = charge.copy()
        self._capacity = column(parameters, lambda p: p.battery_charge_c)
        self._full = column(parameters, lambda p: p.battery_full_v)
        self._empty = column(parameters, lambda p: p.battery_empty_v)
        self._resistance = column(parameters, lambda p: p.battery_resistance_ohm)
        self._hover = column(parameters, lambda p: p.hover_power_w)
        self._electronics = column(parameters, lambda p: p.electronics_power_w)
        self.voltage = self._open_voltage()

    def drain(self, thrust: Floats, period_s: float) -> None:
        """Discharge by what ``thrust`` (per mass, (n,) [m/s²]) takes over a period."""
        power = self._hover * (thrust / GRAVITY_M_S2) ** 1.5 + self._electronics
        current = power / np.maximum(self.voltage, 1.0)
        np.maximum(self.charge - current * period_s / self._capacity, 0.0, out=self.charge)
        self.voltage = self._open_voltage() - current * self._resistance

    def strength(self) -> Floats:
        """Return the share of the full battery's thrust that is left, (n,): thrust grows with voltage squared."""
        share: Floats = np.clip(self.voltage / self._full, 0.0, 1.0) ** 2
        return share

    def _open_voltage(self) -> Floats:
        voltage: Floats = self._empty + (self._full - self._empty) * self.charge
        return voltage
