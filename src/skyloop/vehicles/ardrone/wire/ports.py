"""Where an AR.Drone listens. Source: ``Soft/Common/config.h`` of the AR.Drone SDK 2.0.1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from skyloop.vehicles.ardrone.wire import at, configuration, navdata

VIDEO: Final = 5555


@dataclass(frozen=True, slots=True)
class Ports:
    """The drone's; 0 stands for any free one, where there is a choice."""

    navdata: int = navdata.PORT  #: UDP
    video: int = VIDEO  #: UDP of an AR.Drone 1, TCP of an AR.Drone 2
    at: int = at.PORT  #: UDP
    control: int = configuration.PORT  #: TCP

    @classmethod
    def free(cls) -> Ports:
        """Any free ones."""
        return cls(0, 0, 0, 0)


STANDARD: Final = Ports()
