"""Bitcraze's Crazyflie and its relatives: their protocol CRTP, the driver, and emulated firmware."""
