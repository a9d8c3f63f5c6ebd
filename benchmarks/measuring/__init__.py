"""How delays are measured: one contract for Skyloop, the bare hand-over and other libraries, in turns in one run.

Interpreters that have NumPy and one of those libraries alone import ``contract``, ``schedule``, ``waypoints`` and
``workers``.
"""
