"""MSP, the MultiWii serial protocol, versions 1 and 2, as used by Betaflight and INAV, in both directions. Pure."""
