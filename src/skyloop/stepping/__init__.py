"""Simulated time: proxy, vehicle and application in one process; the clock advances while the application waits.

``replay`` plays a recording in step with its application, ``rehearsal`` flies a simulated drone (on ``host``, a world
without threads). Both share the single thread for everything else (``executor``), the client's time (``scheduler``) and
the transport of packets (``transport``).
"""
