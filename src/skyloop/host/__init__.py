"""Many vehicles in one process: proxies that share their threads, added and removed while others fly."""
