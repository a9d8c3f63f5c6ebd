"""Proxy, vehicle and application in one process, most often in simulated time.

``replay`` plays a recording in step with its application, and ``rehearsal`` flies a simulated drone. ``transport`` has
what both need: simulated time for the client, the transport for packets, and the single thread that runs everything
except the application. ``in_process`` flies a simulated drone by the computer's clock.
"""
