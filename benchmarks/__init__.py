"""Benchmarks for Skyloop's developers. Users measure their machine with ``skyloop bench``; none of this is installed.

Run them from the checkout as ``python -m benchmarks.NAME``. ``peers`` compares the delays of Skyloop with those of
other libraries, ``loop`` measures from a frame to its command, ``load`` adds other clients, ``network`` a path that
loses packets, ``swarm`` drones with failing users, ``scale`` more and more proxies and observers. ``video_path``
measures video over mobile uplinks, ``codecs`` the processor time of codecs. ``hosts`` makes several hosts out of one
machine, ``measuring`` is shared code, ``paper`` is the paper's experiment, and ``pages`` puts the figures into the
documentation.
"""
