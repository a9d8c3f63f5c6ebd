"""``sim://`` addresses: simulated drones, each in a world of its own or sharing one on a host."""
