"""Chaos: drones flown at 32 Hz while processes are killed, stopped, starved and flooded, and links fail.

``make chaos`` runs it; ``python -m tests.promises.chaos --help`` says how. Every *lane* is one vehicle, its proxy and
its pilot, in separate processes. Each of them writes what it did to a *journal* (``journal.py``), and ``judge.py``
derives from the journals alone which commands were executed too late, which flights were not requested, which
failsafes were needless, and which were missing. Control lanes fly without faults: their needless failsafes are caused
by the machine.
"""
