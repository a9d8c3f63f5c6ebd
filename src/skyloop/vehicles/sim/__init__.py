"""``sim://`` addresses: simulated drones, each in a separate world or sharing a world on a host."""
