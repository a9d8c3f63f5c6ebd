"""Several "hosts" on one machine, each with a network, a name and optionally a separate clock, and bad links between.

:class:`~benchmarks.hosts.namespaces.Lab` makes them from the kernel's namespaces; they end with the process that made
them, however it ends. :class:`~benchmarks.hosts.path.Path` is a link that loses, delays and reorders, for every
protocol, in user space, because few kernels include a suitable queueing discipline. It needs Linux, root, and the
programs ``ip``, ``nsenter`` and ``unshare``.
"""
