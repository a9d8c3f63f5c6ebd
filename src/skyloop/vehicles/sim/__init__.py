"""``sim://``: a simulated drone in a simulated world, alone or with others on the same host."""
