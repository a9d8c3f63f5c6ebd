"""CRTP's packets, read and written by the driver and by the emulated firmware. Pure."""
