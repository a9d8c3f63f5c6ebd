"""For all tests."""

import signal

import pytest

# Before any test module imports them: a failing assertion of the public suites then shows its values.
pytest.register_assert_rewrite("skyloop.transport.conformance", "skyloop.transport.testing", "skyloop.drivers.suite")

# A shell ignores SIGINT for its background jobs, and children inherit that: the commands that the tests start and
# interrupt would never hear of it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
