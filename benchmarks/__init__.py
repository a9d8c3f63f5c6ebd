"""Benchmarks for Skyloop's developers. Users measure their machine with ``skyloop bench``; none of this is installed.

``python -m benchmarks.NAME``, from the checkout, measures the delays of Skyloop and of other libraries by the same
contract (``peers``), from a frame to its command (``loop``), with others on the same drone (``load``), over a path that
loses packets (``network``), of drones with failing users (``swarm``), of growing numbers of proxies and observers
(``scale``), video over mobile uplinks (``video_path``), and the processor time of codecs (``codecs``). ``hosts`` makes
several hosts of one machine, ``measuring`` is shared code, ``paper`` is the paper's experiment, ``pages`` puts the
figures into the documentation.
"""
