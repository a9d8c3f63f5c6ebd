"""Many vehicles in one process: their proxies share threads, and are added and removed while others fly."""
