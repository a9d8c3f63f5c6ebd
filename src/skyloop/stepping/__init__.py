"""Simulated time: proxy, vehicle and application run in one process; the clock advances while the application waits.

``replay`` plays a recording in step with its application, and ``rehearsal`` flies a simulated drone. ``transport`` has
what both need: simulated time for the client, the transport for packets, and the single thread that runs everything
except the application.
"""
