"""Measurements for Skyloop's developers. Users measure their machine by ``skyloop bench``; none of this is installed.

``python -m benchmarks.NAME``, from the checkout, measures the delays of Skyloop and of other libraries by the same
contract (``peers``), from a frame to its command (``loop``), with others on the same drone (``load``), over a path that
loses packets (``network``), of drones whose users fail (``swarm``), of more and more proxies and observers (``scale``),
video over mobile uplinks (``video_path``), and what codecs take of one core (``codecs``). ``hosts`` makes several hosts
of one machine, ``measuring`` is what they share, ``paper`` is the paper's experiment, ``pages`` puts the figures into
the documentation.
"""
