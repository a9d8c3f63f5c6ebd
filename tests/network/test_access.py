"""Zenoh's access control as generated from a roster: each role's rights, checked with Zenoh's own key expressions.

Zenoh's enforcement is tested in tests/promises/security.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from skyloop.network import layout
from skyloop.network.config import FabricSettings, secured
from skyloop.network.keys import Lab, load
from skyloop.network.keys.identity import EGRESS, INGRESS, access_control, make_identity

LAB = [
    make_identity("jane", "pilot", "alpha*"),
    make_identity("olga", "observer", "alpha,bravo"),
    make_identity("hangar", "proxy", "alpha*,bravo"),
    make_identity("hub", "router"),
]
ID = "0123456789abcdef"
CONTROL = access_control(LAB)


def allowed(who: str, flow: str, message: str, key: str) -> bool:
    """Decide like Zenoh: some rule of the subject's policy has a key expression that includes this one."""
    subjects = {subject["id"] for subject in CONTROL["subjects"] if who in subject["cert_common_names"]}
    rules = {rule["id"]: rule for rule in CONTROL["rules"]}
    mine = [
        rules[name] for policy in CONTROL["policies"] if subjects & set(policy["subjects"]) for name in policy["rules"]
    ]
    return any(
        zenoh.KeyExpr(pattern).includes(zenoh.KeyExpr(key))
        for rule in mine
        if flow in rule["flows"] and message in rule["messages"]
        for pattern in rule["key_exprs"]
    )


def operations() -> Iterator[tuple[str, str, str]]:
    """Yield everything that our own ends do at ``alpha``, ``alpha7``, ``bravo`` and ``charlie``, under the name WHO."""
    for name in ("alpha", "alpha7", "bravo", "charlie"):
        for who in ("jane", "olga"):
            for way in (layout.ASK, layout.ORDER, layout.COMMAND):
                yield f"{way} {name} as {who}", "put", layout.upward(way, name, who, ID)
            yield f"join {name} as {who}", "query", layout.join(name, who, ID)
            yield f"live at {name} as {who}", "liveliness_token", layout.app(name, who, ID)
        for message in ("put", "declare_subscriber"):
            yield f"{message} topic {name}", message, layout.topic(name, "feedback")
            yield f"{message} video {name}", message, layout.video(name, "front", "quality=80")
            yield f"{message} to {name}", message, layout.to(name, ID)
        yield f"be {name}", "liveliness_token", layout.alive(name, ID)
        for message in ("declare_queryable", "reply"):
            yield f"{message} info {name}", message, layout.info(name)
            yield f"{message} join {name}", message, layout.join(name, "jane", ID)
        for way in (layout.ASK, layout.ORDER, layout.COMMAND):
            yield f"take {way} {name}", "declare_subscriber", layout.upward(way, name, "*", "*")
        yield f"watch apps {name}", "declare_liveliness_subscriber", layout.app(name, "*", "*")
        yield f"query info {name}", "query", layout.info(name)
    yield "list", "liveliness_query", layout.alive("*", "*")
    yield "watch", "declare_liveliness_subscriber", layout.alive("*", "*")
    yield "query all info", "query", layout.info("*")
    yield "everything", "declare_subscriber", "**"
    yield "all of it", "declare_subscriber", f"{layout.ROOT}/**"
    yield "another's keys", "put", "rt/cmd_vel"
    yield "administration", "query", "@/**"
    yield "delete", "delete", layout.topic("alpha", "feedback")


def permitted(who: str, flow: str) -> set[str]:
    return {what for what, message, key in operations() if allowed(who, flow, message, key)}


ANYBODY = {
    "list",
    "watch",
    "query all info",
    *(f"query info {name}" for name in ("alpha", "alpha7", "bravo", "charlie")),
}


def as_application(who: str, seen: list[str], flown: list[str]) -> set[str]:
    return (
        {f"{deed} {name} as {who}" for name in seen for deed in ("ask", "join", "live at")}
        | {f"{way} {name} as {who}" for name in flown for way in ("order", "command")}
        | {f"declare_subscriber {what} {name}" for name in seen for what in ("topic", "video", "to")}
        | ANYBODY
    )


def as_proxy(names: list[str]) -> set[str]:
    return (
        {f"{message} {what} {name}" for name in names for message in ("put",) for what in ("topic", "video", "to")}
        | {
            f"{message} {what} {name}"
            for name in names
            for message in ("declare_queryable", "reply")
            for what in ("info", "join")
        }
        | {f"take {way} {name}" for name in names for way in ("ask", "order", "command")}
        | {f"{what} {name}" for name in names for what in ("be", "watch apps")}
        | ANYBODY
    )


EVERY = ["alpha", "alpha7", "bravo", "charlie"]


@pytest.mark.parametrize(
    ("who", "may"),
    [
        ("jane", as_application("jane", seen=EVERY, flown=["alpha", "alpha7"])),
        ("olga", as_application("olga", seen=["alpha", "bravo"], flown=[])),
        ("hangar", as_proxy(["alpha", "alpha7", "bravo"])),
        ("stranger", set()),
    ],
)
def test_each_role_may_send_what_it_needs(who: str, may: set[str]) -> None:
    assert permitted(who, INGRESS) == may


def test_a_router_carries_only_skyloops_keys() -> None:
    every = {what for what, _, _ in operations()} - {"everything", "another's keys", "administration"}
    assert permitted("hub", INGRESS) == permitted("hub", EGRESS) == every


@pytest.mark.parametrize(("speaker", "hearer"), [("jane", "hangar"), ("olga", "hangar")])
def test_proxies_receive_what_applications_may_send(speaker: str, hearer: str) -> None:
    served = {what for what in permitted(speaker, INGRESS) if "charlie" not in what} | {"query info charlie"}
    assert served - permitted(hearer, EGRESS) == set()


@pytest.mark.parametrize("hearer", ["jane", "olga"])
def test_applications_receive_what_a_proxy_may_send(hearer: str) -> None:
    lost = permitted("hangar", INGRESS) - permitted(hearer, EGRESS)
    seen = ["alpha", "bravo"] if hearer == "olga" else EVERY
    flown = ["alpha", "alpha7"] if hearer == "jane" else []
    unseen = {what for what in lost if not any(name in what.split() for name in seen)}
    unflown = {f"take {way} {name}" for name in EVERY for way in ("order", "command") if name not in flown}
    assert lost <= unseen | unflown


@pytest.mark.parametrize("hearer", ["jane", "olga"])
def test_applications_do_not_receive_others_packets_to_a_proxy(hearer: str) -> None:
    heard = permitted(hearer, EGRESS)
    assert not any(what.startswith(("ask", "order", "command", "live at")) for what in heard)


def test_without_identities_nothing_passes() -> None:
    control = access_control([])
    assert control["default_permission"] == "deny"
    assert control["enabled"] is True
    assert control["rules"] == control["subjects"] == control["policies"] == []


def test_every_rule_has_a_unique_name_and_one_subject() -> None:
    names = [rule["id"] for rule in CONTROL["rules"]]
    assert len(names) == len(set(names))
    assert sorted(name for policy in CONTROL["policies"] for name in policy["rules"]) == sorted(names)
    assert all(rule["key_exprs"] and rule["messages"] and rule["flows"] for rule in CONTROL["rules"])


def test_a_key_secures_the_settings(tmp_path: Path) -> None:
    lab = Lab.make(tmp_path / "lab")
    lab.issue(make_identity("jane", "pilot", "alpha*"))
    lab.issue(make_identity("eve", "pilot"))
    lab.revoke("eve")
    settings: Any = secured(FabricSettings(listen=("[::]:0",)), load(lab.folder("jane")))
    assert settings.listen == ("[::]:0",)
    assert settings.who == "jane"
    assert settings.tls.key == lab.folder("jane") / "identity.key"
    assert [subject["id"] for subject in settings.access_control["subjects"]] == ["jane"]
