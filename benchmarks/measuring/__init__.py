"""Measuring delays: one contract for Skyloop, the bare hand-over and other libraries, in turns in one run.

Interpreters with only NumPy and one of those libraries import ``contract``, ``schedule``, ``waypoints`` and
``workers``.
"""
