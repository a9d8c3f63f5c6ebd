"""Chaos: drones flown at 32 Hz while what surrounds them is killed, stopped, starved and flooded, and their links fail.

``make chaos`` runs it; ``python -m tests.chaos --help`` says how. Every *lane* is one vehicle, its proxy and its pilot,
in processes of their own. Each of them writes what it did to a *journal* (:mod:`tests.chaos.journal`), and
:mod:`tests.chaos.judge` finds out from the journals alone what was executed too late, what flew though nobody asked for
it, which failsafe was needless, and which one never came. Beside the lanes with faults fly others without: what happens
to them is the machine's doing.
"""
