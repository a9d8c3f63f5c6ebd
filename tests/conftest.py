"""For all tests."""

import signal

# A shell ignores SIGINT for its background jobs, and children inherit that: the commands that the tests start and
# interrupt would never hear of it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
