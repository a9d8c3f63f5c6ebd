"""``sim://``: a simulated drone in a simulated world, alone or with others of one host."""
