"""Commands and feedback on a path that loses, delays and reorders: nothing that arrives waited for a retransmission."""

from __future__ import annotations

import pytest

from benchmarks import network
from benchmarks.measuring.schedule import COMMAND, FEEDBACK, VIDEO
from benchmarks.network import DATAGRAMS, PATH, TCP

pytest.importorskip("zenoh")
SECONDS = 6.0
TRIES = 3
#: A retransmission of TCP takes another round trip, or 200 ms; shorter delays come from a busy machine.
SLACK_US = 8e3
CROWDED_US = 120e3


@pytest.mark.usefixtures("_possible")
def test_at_ten_percent_loss_nothing_waits_for_what_was_lost() -> None:
    ages_us: list[float] = []
    for _ in range(TRIES):
        [found] = network.measure(SECONDS, [0.1], [DATAGRAMS]).cases
        sent = sum(found.channels[name].sent for name in (COMMAND, FEEDBACK))
        arrived = sum(found.channels[name].arrived for name in (COMMAND, FEEDBACK))
        # Lost packets stay lost: five standard deviations off is not chance.
        assert 0.7 < arrived / sent < 0.98
        assert found.channels[VIDEO].arrived, "video is sent reliably, and must arrive"
        summaries = [found.channels[name].age for name in (COMMAND, FEEDBACK)]
        ages_us.append(max(summary.p99_us for summary in summaries if summary is not None))
        if ages_us[-1] < PATH.longest_s * 1e6 + CROWDED_US:
            return
    pytest.fail(f"99th percentiles in {TRIES} tries: {ages_us} µs; the path takes {PATH.longest_s * 1e6} at most")


@pytest.mark.usefixtures("_possible")
def test_by_tcp_alone_commands_wait_for_what_was_lost() -> None:
    """It shows that the test above would notice such waits."""
    [found] = network.measure(4.0, [0.1], [TCP]).cases
    age = found.channels[COMMAND].age
    assert age is not None
    assert age.p99_us > PATH.longest_s * 1e6 + SLACK_US
    assert found.channels[FEEDBACK].share > 0.6, "TCP repeats lost packets; a busy machine drops some too"
