"""Create several "hosts" with their own network, name and clock on one machine, joined by bad links.

:class:`~benchmarks.hosts.namespaces.Lab` makes them from the kernel's namespaces; they end with the process that made
them, however that ends. :class:`~benchmarks.hosts.path.Path` is a link that loses, delays and reorders, for every
protocol, in user space, because few kernels include a suitable queueing discipline. It needs Linux, root, and the
programs ``ip``, ``nsenter`` and ``unshare``.
"""
