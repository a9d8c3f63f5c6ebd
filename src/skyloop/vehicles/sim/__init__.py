"""``sim://`` addresses: simulated drones, each in a separate world or sharing one on a host."""
