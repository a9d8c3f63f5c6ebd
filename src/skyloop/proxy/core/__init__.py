"""The proxy's pure decisions: inputs and the time are arguments; there are no threads, sockets, locks or clocks."""
