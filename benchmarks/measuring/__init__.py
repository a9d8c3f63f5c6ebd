"""Measure the delays of Skyloop, a bare transfer and other libraries by one contract, in turns in one run.

Interpreters with only NumPy and one of those libraries import ``contract``, ``schedule``, ``waypoints`` and
``workers``.
"""
