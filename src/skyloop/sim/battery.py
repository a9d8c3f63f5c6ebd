"""Batteries: charge and voltage under the power that the drones take."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from skyloop.sim.dynamics import column
from skyloop.sim.parameters import VehicleParameters
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
        self.voltage = self.open_voltage()

    def drain(self, power: Floats, period_s: float) -> None:
        """Discharge by ``power``, (n,) [W], over a period."""
        current = power / np.maximum(self.voltage, 1.0)
        np.maximum(self.charge - current * period_s / self._capacity, 0.0, out=self.charge)
        self.voltage = self.open_voltage() - current * self._resistance

    def strength(self) -> Floats:
        """Return the share of the full battery's thrust that is left, (n,): thrust grows with voltage squared."""
        share: Floats = np.clip(self.voltage / self._full, 0.0, 1.0) ** 2
        return share

    def open_voltage(self) -> Floats:
        """Return the voltage without load, (n,) [V]."""
        voltage: Floats = self._empty + (self._full - self._empty) * self.charge
        return voltage
