"""Simulated time: proxy, vehicle and application in one process; the clock advances while the application waits.

``replay`` plays a recording in step with its application; ``rehearsal`` flies a simulated drone in a world without
threads. Both use the client's simulated time, and the packet transport together with the single thread that runs
everything but the application (``transport``).
"""
