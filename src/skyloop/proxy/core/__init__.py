"""The proxy's decisions, as pure code: inputs and time are arguments; no threads, sockets, locks or clocks."""
