"""``ardrone://`` addresses: the Parrot AR.Drone 1 and 2."""
