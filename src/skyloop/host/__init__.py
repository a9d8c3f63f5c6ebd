"""Many vehicles in one process. Their proxies share threads, and are added and removed while others fly."""
