"""Simulated time: proxy, vehicle and application run in one process; the clock advances while the application waits.

``replay`` plays a recording in step with its application. ``rehearsal`` flies a simulated drone in a world without
threads. Both use the client's simulated time and, from ``transport``, the packet transport and the single thread that
runs everything except the application.
"""
