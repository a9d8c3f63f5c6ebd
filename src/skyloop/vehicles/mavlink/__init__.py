"""``mavlink://…``: ArduCopter and PX4 multirotors."""
