"""``mavlink://`` addresses: multirotors with ArduCopter or PX4."""
