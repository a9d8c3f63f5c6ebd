"""``msp://`` addresses: Betaflight and INAV, through the MultiWii serial protocol over TCP or a serial port."""
