"""Simulated time: proxy, vehicle and application in one process, by a clock that advances while the application waits.

``replay`` plays a recording in step with its application, ``rehearsal`` flies a simulated drone (on ``host``, a world
without threads). Both share the one thread on which everything else runs (``executor``), the client's time
(``scheduler``) and the transport of packets (``transport``).
"""
