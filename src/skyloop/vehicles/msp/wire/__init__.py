"""MSP, the MultiWii serial protocol, versions 1 and 2, as Betaflight and INAV speak it. Both ways, pure."""
