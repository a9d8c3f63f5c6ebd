"""The pure parts of the fabric transport: keys, packets, rights, windows, configuration, requests for video."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError, LinkError, MissingExtraError, UsageError
from skyloop.messages import (
    Annotation,
    Command,
    GetStatistics,
    Hello,
    LogEntry,
    ReleaseAuthority,
    Request,
    RequestAuthority,
    SetParameter,
    Takeoff,
    VehiclePose,
    encode,
)
from skyloop.messages.config import AnyRequest
from skyloop.messages.subscription import FrameFilter, VideoRequest
from skyloop.network import (
    FabricServer,
    FabricSettings,
    TlsFiles,
    config,
    dial,
    discovery,
    layout,
    packets,
)
from skyloop.network.config import Part
from skyloop.network.delivery import ACKNOWLEDGE_AFTER, ACKNOWLEDGE_EVERY_S, AckPolicy, RecentPackets
from skyloop.network.discovery import FORGET_S, UnreachablePeers
from skyloop.network.session import _Pool
from skyloop.transport.base import MAX_TOPIC
from skyloop.transport.testing import header

TOPICS = st.text(min_size=1, max_size=MAX_TOPIC).filter(lambda text: text.isprintable())
TLS = TlsFiles(Path("/k/ca.pem"), Path("/k/identity.pem"), Path("/k/identity.key"))

# --- keys ---


@given(TOPICS)
def test_any_topic_is_one_chunk_of_a_key_and_back(topic: str) -> None:
    key = layout.topic("alpha", topic)
    assert key.startswith("skyloop/1/alpha/topic/")
    assert not set(key.removeprefix("skyloop/1/alpha/topic/")) & set("/*$?#")
    assert layout.parse_topic(key) == topic


def test_the_keys() -> None:
    connection = "0123456789abcdef"
    assert layout.alive("alpha", connection) == "skyloop/1/alpha/alive/0123456789abcdef"
    assert layout.app("alpha", "anna", connection) == "skyloop/1/alpha/app/anna/0123456789abcdef"
    assert layout.video("alpha", "front") == "skyloop/1/alpha/video/front/-"
    form = "encoding=jpeg&quality=80"
    assert layout.video_for("alpha", "front", form, connection) == (
        f"skyloop/1/alpha/video/front/encoding=jpeg&quality=80/{connection}"
    )
    assert layout.parse_alive(layout.alive("alpha", connection)) == ("alpha", connection)
    assert layout.parse_sender(layout.join("alpha", "anna", connection)) == ("join", "anna", connection)
    assert len({layout.new_id() for _ in range(100)}) == 100


@pytest.mark.parametrize(
    "key",
    [
        "",
        "**",
        "skyloop/1/alpha/ask/anyone",
        "skyloop/1/alpha/ask/*/*",
        "skyloop/1/alpha/ask/a$*/0123456789abcdef",
        "skyloop/1/alpha/ask/anna/0123456789ABCDEF",
        "skyloop/1/alpha/ask/anna/0123456789abcdef/x",
    ],
)
def test_keys_without_an_owner(key: str) -> None:
    with pytest.raises(DecodeError):
        layout.parse_sender(key)
    with pytest.raises(DecodeError):
        layout.parse_alive(key)


@pytest.mark.parametrize("who", ["", "a/b", "*", "-x", "ä", "x" * 65])
def test_invalid_identities(who: str) -> None:
    with pytest.raises(UsageError, match="cannot be an identity"):
        FabricSettings(tls=TLS, who=who)


# --- packets ---


@given(st.binary(max_size=80))
def test_parsing_any_bytes_gives_a_message_or_a_decode_error(data: bytes) -> None:
    for parse in (packets.parse, packets.parse_number, packets.parse_published, packets.parse_frame):
        for attempt in (data, b"SKYL\x01\x51\0\0" + len(data).to_bytes(4, "little") + data):
            try:
                parse(attempt)
            except DecodeError:
                continue


@given(TOPICS, st.booleans(), st.integers(0, 2**64 - 1))
def test_packets_round_trip(topic: str, on: bool, number: int) -> None:
    assert packets.parse(packets.subscribe(topic, on)) == packets.Subscribe(topic, on)
    assert packets.parse(packets.taken(topic, number)) == packets.Taken(topic, number)
    assert packets.parse(packets.taken("", number)) == packets.Taken("", number)
    assert packets.parse(packets.seen(topic, number)) == packets.Seen(topic, number)
    assert packets.parse_number(packets.number(number)) == number
    assert packets.parse_published(packets.published(b"12345678", number)) == (b"12345678", number)
    assert packets.parse_frame(packets.frame(b"12345678", number, encode(header(3)))) == (
        b"12345678",
        number,
        header(3),
    )


def test_a_long_reason_is_truncated() -> None:
    message = packets.parse(packets.bye("é" * 1000))
    assert isinstance(message, packets.Bye)
    assert 100 < len(message.reason) <= packets.MAX_REASON


# --- rights ---

BODIES: list[tuple[AnyRequest, str]] = [
    (Hello("me"), layout.ASK),
    (GetStatistics(), layout.ASK),
    (RequestAuthority(), layout.ORDER),
    (ReleaseAuthority(), layout.ORDER),
    (SetParameter("limits.tilt", 1.0, 1), layout.ORDER),
]


@pytest.mark.parametrize(("body", "way"), BODIES)
def test_requests_need_the_right_for_their_effect(body: AnyRequest, way: str) -> None:
    packet = encode(Request(1, body))
    assert layout.way_of(packet) == way
    assert layout.allows(way, packet)
    assert layout.allows(layout.ORDER, packet)
    assert layout.allows(layout.ASK, packet) is (way == layout.ASK)


TAKEOFF = encode(Command(1, 1, 1, 1, Takeoff()))


def test_other_packets_need_the_right_for_their_kind() -> None:
    assert layout.way_of(TAKEOFF) == layout.COMMAND
    assert layout.way_of(encode(Annotation("me", "front", 1, 32, 24))) == layout.ASK
    assert layout.way_of(encode(LogEntry("me", "", 1, text="x"))) == layout.ASK
    assert not layout.allows(layout.ORDER, TAKEOFF)
    assert layout.way_of(encode(VehiclePose(1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))) == layout.ORDER


@given(st.binary(max_size=60))
def test_garbage_needs_no_right_unless_it_looks_like_a_command_or_a_pose(data: bytes) -> None:
    assert layout.way_of(data) == {b"\1": layout.COMMAND, b"\15": layout.ORDER}.get(data[5:6], layout.ASK)


# --- windows ---


def test_acknowledgements_are_sent_now_and_then() -> None:
    policy = AckPolicy()
    told = [number for number in range(1, 101) if policy.count(number, 1)]
    assert told == [ACKNOWLEDGE_AFTER * n for n in range(1, 100 // ACKNOWLEDGE_AFTER + 1)]


def test_on_topics_where_the_newest_counts_acknowledgements_also_follow_the_time() -> None:
    policy = AckPolicy(ACKNOWLEDGE_EVERY_S)
    assert [ms for ms in range(0, 600, 31) if policy.count(ms // 31 + 1, 0, ms / 1000)] == [0, 155, 310, 465]
    assert [number for number in range(21, 101) if policy.count(number, 0, 0.5)] == [48, 80], "many at once"


# --- configuration ---


def test_an_application_with_one_address_waits_only_for_its_proxy() -> None:
    given = FabricSettings(connect=("10.0.0.5",), multicast=False)

    def delay_ms(settings: FabricSettings, part: Part) -> int:
        delay: int = config.make(settings, part)["scouting"]["delay"]
        return delay

    assert delay_ms(given, Part.APP) == 0
    assert delay_ms(FabricSettings(connect=("10.0.0.5",)), Part.APP) == config.SETTLE_MS
    assert delay_ms(FabricSettings(connect=("10.0.0.5", "10.0.0.6"), multicast=False), Part.APP) == config.SETTLE_MS
    assert delay_ms(FabricSettings(), Part.APP) == delay_ms(given, Part.PROXY) == config.SETTLE_MS


def test_an_address_means_two_links_without_keys_and_one_with_keys() -> None:
    plain, secured = FabricSettings(), FabricSettings(tls=TLS, who="anna")
    assert config.endpoints_of(["10.0.0.5:1"], plain) == ["tcp/10.0.0.5:1?rel=1", "udp/10.0.0.5:1?rel=0"]
    assert config.endpoints_of(["10.0.0.5"], secured) == ["quic/10.0.0.5:7447?mixed_rel=1"]
    assert config.endpoints_of(["[::1]"], secured) == ["quic/[::1]:7447?mixed_rel=1"]
    assert config.endpoints_of(["lab.local:80"], secured) == ["quic/lab.local:80?mixed_rel=1"]
    assert config.endpoints_of(["ws/10.0.0.5:1"], plain) == ["ws/10.0.0.5:1"]


@pytest.mark.parametrize("address", ["", ":1", "host:", "host:x", "host:70000", "::1", "[::1", "a:b:1"])
def test_invalid_addresses(address: str) -> None:
    with pytest.raises(UsageError, match="is not a network address"):
        config.endpoints_of([address], FabricSettings())


def test_with_keys_unencrypted_addresses_are_refused() -> None:
    settings = FabricSettings(tls=TLS, who="anna", access_control={"enabled": True})
    made = config.make(settings, Part.PROXY, ["quic/0.0.0.0:1?mixed_rel=1"])
    assert made["transport"]["link"]["protocols"] == ["quic"]
    tls = made["transport"]["link"]["tls"]
    assert tls["enable_mtls"] is True
    assert (tls["root_ca_certificate"], tls["connect_private_key"]) == ("/k/ca.pem", "/k/identity.key")
    assert made["access_control"] == {"enabled": True}


def test_only_applications_connect_to_proxies() -> None:
    def called(part: Part) -> Any:
        return config.make(FabricSettings(), part)["scouting"]["multicast"]["autoconnect"]["peer"]

    assert called(Part.APP) == ["router", "peer"]
    assert called(Part.PROXY) == ["router"]
    assert config.make(FabricSettings(), Part.ROUTER)["mode"] == "router"


def test_a_free_port_replaces_port_0() -> None:
    (address,) = config.listening(FabricSettings(listen=("127.0.0.1:0",)))
    host, _, port = address.rpartition(":")
    assert host == "127.0.0.1"
    assert int(port) > 0
    assert config.listening(FabricSettings(listen=("10.0.0.5:7447", "tcp/1.2.3.4:0"))) == [
        "10.0.0.5:7447",
        "tcp/1.2.3.4:0",
    ]
    with pytest.raises(LinkError, match="cannot listen at"):
        config.listening(FabricSettings(listen=("203.0.113.7:0",)))


def test_an_identity_needs_its_files() -> None:
    with pytest.raises(UsageError, match="needs its certificate"):
        FabricSettings(who="anna")


# --- choice of the network ---


def test_by_default_a_process_stays_on_its_host(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SKYLOOP_NETWORK", raising=False)
    monkeypatch.delenv("SKYLOOP_KEYS", raising=False)
    assert config.choose() is None
    for word in ("", "off", "0", "False"):
        monkeypatch.setenv("SKYLOOP_NETWORK", word)
        assert config.choose() is None
    assert config.choose(network=True) == FabricSettings()
    assert config.choose(network=False) is None
    with pytest.raises(UsageError, match="keys are for the network"):
        config.choose(keys="/somewhere")


def test_the_environment_may_choose_the_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKYLOOP_NETWORK", "multicast")
    assert config.choose() == FabricSettings()
    monkeypatch.setenv("SKYLOOP_NETWORK", "10.0.0.5:7447, lab.local")
    assert config.choose() == FabricSettings(connect=("10.0.0.5:7447", "lab.local"), multicast=False)
    assert config.choose("10.0.0.5,multicast") == FabricSettings(connect=("10.0.0.5",))
    given_ = FabricSettings(connect=("1.2.3.4",))
    assert config.choose(given_) is given_
    with pytest.raises(UsageError, match="is not a network address"):
        config.choose("10.0.0.5:port")


def test_a_given_address_gets_more_time_than_a_discovered_one() -> None:
    def open_ms(*connect: str) -> int:
        made = config.make(FabricSettings(connect=connect), Part.APP)
        return int(made["transport"]["unicast"]["open_timeout"])

    assert open_ms("10.0.0.5") > open_ms()


def test_others_wait_for_an_end_for_its_own_lease(monkeypatch: pytest.MonkeyPatch) -> None:
    def lease_ms() -> object:
        settings = config.choose(network=True)
        assert settings is not None
        return config.make(settings, Part.PROXY)["transport"]["link"]["tx"]["lease"]

    monkeypatch.delenv("SKYLOOP_LEASE_S", raising=False)
    assert lease_ms() == 700
    monkeypatch.setenv("SKYLOOP_LEASE_S", "3")
    assert lease_ms() == 3000
    for wrong in ("long", "nan", "0.1", "60"):
        monkeypatch.setenv("SKYLOOP_LEASE_S", wrong)
        with pytest.raises(UsageError, match=r"must be 0\.7 to 10 seconds"):
            lease_ms()


def test_the_searched_network_is_described_in_words() -> None:
    assert FabricSettings().reach == "multicast"
    assert FabricSettings(connect=("10.0.0.5",), multicast=False).reach == "10.0.0.5"
    assert FabricSettings(multicast=False).reach == "nowhere"


def test_without_zenoh_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    for use in (lambda: dial("alpha"), lambda: FabricServer("alpha")):
        with pytest.raises(MissingExtraError, match=r"skyloop install network"):
            use()


# --- peers to retry ---


def test_a_new_peer_is_tried_once_until_a_proxy_was_reached() -> None:
    unreachable = UnreachablePeers()
    assert unreachable.any_new({"a"}, set(), 0.0)
    assert not unreachable.any_new({"a"}, set(), 1.0)
    assert not unreachable.any_new({"a", "b"}, {"b"}, 1.0)
    assert unreachable.any_new({"a", "b"}, set(), 1.0)
    unreachable.clear()
    assert unreachable.any_new({"a"}, set(), 2.0)
    assert unreachable.any_new({"a"}, set(), 2.0 + FORGET_S)


# --- requests for video ---

REQUESTS = st.builds(
    VideoRequest,
    st.text(min_size=1, max_size=20).filter(lambda text: "?" not in text and text.isprintable()),
    encoding=st.sampled_from(["raw", "jpeg"]),
    quality=st.integers(1, 100),
    max_fps=st.none() | st.sampled_from([0.5, 10.0, 29.97]),
    scale=st.sampled_from([1.0, 0.5, 0.125]),
    part=st.none() | st.sampled_from([(0, 3), (2, 3), (1, 2)]),
)


@given(REQUESTS)
def test_a_request_and_its_topic_are_equivalent(request: VideoRequest) -> None:
    assert VideoRequest.parse(request.topic) == request
    assert VideoRequest.parse(request.plain.topic) == VideoRequest(request.camera)


def test_the_canonical_text() -> None:
    assert VideoRequest("front").topic == "video/front"
    assert VideoRequest("front", quality=30).topic == "video/front"
    assert VideoRequest("front", part=(0, 1)).topic == "video/front"
    full = VideoRequest("front", encoding="jpeg", max_fps=10, part=(0, 3), scale=0.5)
    assert full.topic == "video/front?encoding=jpeg&max_fps=10&part=0%2F3&quality=80&scale=0.5"


@pytest.mark.parametrize(
    "topic",
    [
        "",
        "video/",
        "feedback",
        "video/front?x=1",
        "video/front?scale=2",
        "video/front?scale=nan",
        "video/front?part=1",
        "video/front?part=a/b",
        "video/front?encoding=png",
        "video/front?quality=1.5",
        "video/front?&",
    ],
)
def test_invalid_requests(topic: str) -> None:
    with pytest.raises(UsageError):
        VideoRequest.parse(topic)


@given(st.floats(1.0, 60.0), st.floats(1.0, 200.0), st.integers(10, 300))
def test_a_filter_keeps_to_the_rate_and_uses_it(max_fps: float, fps: float, count: int) -> None:
    chosen = FrameFilter(VideoRequest("front", max_fps=max_fps))
    times = [round(n * 1e9 / fps) for n in range(count)]
    kept = [at for at in times if chosen.wants(0, at)]
    span_s = (kept[-1] - kept[0]) / 1e9
    assert len(kept) - 1 <= span_s * max_fps + 0.2
    if fps <= max_fps:
        assert kept == times
    else:
        assert len(kept) >= (times[-1] / 1e9) * max_fps / 2 - 1


def test_a_filter_restarts_with_its_camera() -> None:
    chosen = FrameFilter(VideoRequest("front", max_fps=1.0))
    assert chosen.wants(0, 10**12)
    assert not chosen.wants(1, 10**12 + 10**8)
    assert chosen.wants(0, 5)


def test_repeated_packets_are_distinguished_from_equal_ones() -> None:
    recent = RecentPackets(depth=2)
    assert [recent.is_new(*packet) for packet in ((1, b"a"), (1, b"a"), (2, b"a"), (0, b"b"), (1, b"a"))] == [
        *(True, False, True, True),
        True,  # forgotten meanwhile
    ]


def test_a_router_forwards_between_proxies_and_applications() -> None:
    """Zenoh assumes that the nodes of one region reach one another without it."""
    settings = FabricSettings(listen=("10.0.0.5",))
    regions = [config.make(settings, part)["region_name"] for part in (Part.PROXY, Part.APP)]
    filters = [south["filters"] for south in config.make(settings, Part.ROUTER)["gateway"]["south"]]
    assert filters == [[{"region_names": [name]}] for name in regions]
    assert len(set(regions)) == 2


def test_a_session_that_does_not_know_a_node_is_retired_once_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    retired: list[object] = []
    answered = {"known", "new"}
    monkeypatch.setattr(discovery, "retire", retired.append)
    monkeypatch.setattr(discovery, "_search", lambda _: answered)
    info = SimpleNamespace(peers_zid=lambda: ["known"], routers_zid=list)
    session: Any = SimpleNamespace(
        settings=SimpleNamespace(multicast=True), opened=time.monotonic() - 60.0, zenoh=SimpleNamespace(info=info)
    )
    discovery.proxy_reached()
    try:
        assert discovery.renew(session)
        assert not discovery.renew(session), "a session was already opened for that node"
        assert retired == [session]
        session.opened = time.monotonic()
        answered.add("another")
        assert not discovery.renew(session), "a young session searches anyway"
    finally:
        discovery.proxy_reached()


def test_the_exit_of_the_process_waits_for_a_session_to_close(monkeypatch: pytest.MonkeyPatch) -> None:
    closing, may_end = threading.Event(), threading.Event()

    def close() -> None:
        closing.set()
        assert may_end.wait(10.0)

    one = SimpleNamespace(
        settings=None, part=Part.APP, retired=False, users=1, close=close, over=lambda now: True, idle_since=0.0
    )
    pool = _Pool()
    pool._sessions.append(one)  # type: ignore[arg-type]
    pool.release(one)  # type: ignore[arg-type]
    assert closing.wait(10.0), "the pool's thread closes it"
    ending = threading.Thread(target=pool.close_all)
    ending.start()
    assert ending.is_alive()
    may_end.set()
    ending.join(10.0)
    assert not ending.is_alive()
    with pytest.raises(LinkError, match="process is exiting"):
        pool.acquire(FabricSettings(), Part.APP)


@pytest.mark.process
@pytest.mark.daily
def test_a_process_may_exit_while_a_session_closes() -> None:
    """``skyloop watch`` ended with exit code 134 and "FATAL: exception not rethrown" (issue 28, C11)."""
    pytest.importorskip("zenoh", reason="needs the extra network: skyloop install network")
    program = (
        "from skyloop.network import FabricSettings, session\n"
        "from skyloop.network.config import Part\n"
        "one = session.acquire(FabricSettings(multicast=False), Part.APP)\n"
        "session.retire(one)\n"
        "session.release(one)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
