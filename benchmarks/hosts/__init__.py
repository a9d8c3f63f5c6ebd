"""Several "hosts" on one machine, each with a network, a name and if need be a clock of its own, and bad links between.

:class:`~benchmarks.hosts.namespaces.Lab` makes them of the kernel's namespaces; nothing of them outlives the process
that made it, however that ends. :class:`~benchmarks.hosts.path.Path` is a link that loses, delays and reorders, for
every protocol, in user space, because few kernels come with a queueing discipline that does. It needs Linux, root, and
the programs ``ip``, ``nsenter`` and ``unshare``.
"""
