"""Rehearsals of a controller in simulated time; see :mod:`skyloop.stepping.rehearsal`."""

from skyloop.stepping.rehearsal import Radio, rehearse

__all__ = ["Radio", "rehearse"]
