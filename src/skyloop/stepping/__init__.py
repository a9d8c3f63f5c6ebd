"""Proxy, vehicle and application in one process, most often in simulated time.

``replay`` plays a recording in step with its application. ``rehearsal`` flies a simulated drone in a world without
threads. Both use the client's simulated time, which advances while the application waits, and, from ``transport``, the
packet transport and the single thread that runs everything except the application. ``in_process`` flies a simulated
drone by the computer's clock.
"""
