"""Rehearsals of controllers in simulated time, with delay, loss and noise, and faster than real time."""

from skyloop.stepping.rehearsal import Radio, rehearse

__all__ = ["Radio", "rehearse"]
