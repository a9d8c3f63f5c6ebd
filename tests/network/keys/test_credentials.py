"""Reading an identity's folder: every fault and every near expiry is reported; writing one leaves nothing half done."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ed25519

from skyloop.errors import FileFormatError, UsageError
from skyloop.network.keys import Lab, load
from skyloop.network.keys.credentials import expiry_warning, make_directory, write
from skyloop.network.keys.identity import make_identity
from tests.network.keys.conftest import NOW
from tests.support.systems import has_modes

DAY = timedelta(days=1)


def test_the_contents_of_a_good_folder(lab: Lab, jane: Path) -> None:
    credentials = load(jane, now=NOW)
    assert credentials.identity == make_identity("jane", "pilot", "alpha*")
    assert credentials.expires == NOW + 30 * DAY
    for file in (credentials.authority_file, credentials.certificate_file, credentials.key_file):
        assert file.is_absolute()
        assert b"-----BEGIN" in file.read_bytes()
    assert credentials.ends(NOW) == {}


def test_a_link_to_a_folder_and_a_tilde_are_followed(
    jane: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine").symlink_to(jane)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load("~/mine", now=NOW).directory == jane


Damage = Callable[[Path, Path], object]


def _other_kind_of_key(folder: Path) -> None:
    pem = ed25519.Ed25519PrivateKey.generate().private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    (folder / "identity.key").write_bytes(pem)


def _change_roster(folder: Path) -> None:
    path = folder / "roster.json"
    path.write_text(path.read_text().replace('"alpha*"', '"*"'))


def _sign_away(folder: Path) -> None:
    path = folder / "roster.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"signature": "!"}))


@pytest.mark.parametrize(
    ("damage", "kind", "words"),
    [
        (lambda mine, _: shutil.rmtree(mine), UsageError, "there is no folder"),
        (lambda mine, _: (mine / "identity.key").unlink(), UsageError, "the private key .* can't be read"),
        pytest.param(
            lambda mine, _: (mine / "identity.key").chmod(0o644),
            UsageError,
            "open to others .mode 0644.*chmod 600",
            marks=has_modes,
        ),
        (lambda mine, _: (mine / "identity.key").write_bytes(b"x"), FileFormatError, "not an unencrypted private key"),
        (lambda mine, _: _other_kind_of_key(mine), FileFormatError, "not a key made by"),
        (
            lambda mine, other: shutil.copy(other / "identity.key", mine),
            UsageError,
            "does not belong to the certificate",
        ),
        (lambda mine, _: (mine / "identity.pem").unlink(), UsageError, "the certificate .* can't be read"),
        (lambda mine, _: (mine / "identity.pem").write_bytes(b"\xff"), FileFormatError, "not a certificate in PEM"),
        (lambda mine, _: (mine / "ca.pem").write_bytes(b"-----BEGIN"), FileFormatError, "ca.pem is not a certificate"),
        (
            lambda mine, _: shutil.copy(mine / "identity.pem", mine / "ca.pem"),
            FileFormatError,
            "not the certificate of an",
        ),
        (lambda mine, other: shutil.copy(other / "ca.pem", mine), UsageError, "keys of different labs were mixed"),
        (lambda mine, _: (mine / "roster.json").unlink(), UsageError, "the roster .* can't be read"),
        (lambda mine, _: (mine / "roster.json").write_bytes(b"{"), FileFormatError, "is not a roster"),
        (lambda mine, _: (mine / "roster.json").write_bytes(b'{"roster":1}'), FileFormatError, "is not a roster"),
        (lambda mine, _: _sign_away(mine), FileFormatError, "is not a roster"),
        (lambda mine, _: _change_roster(mine), UsageError, "was changed, or is not signed by"),
        (lambda mine, other: shutil.copy(other / "roster.json", mine), UsageError, "is not signed by"),
    ],
)
def test_a_damaged_or_mixed_up_folder_is_reported(
    jane: Path, tmp_path: Path, damage: Damage, kind: type[UsageError], words: str
) -> None:
    other = Lab.make(tmp_path / "other", now=NOW)
    other.issue(make_identity("jane", "pilot", "alpha*"), now=NOW)
    damage(jane, other.folder("jane"))
    with pytest.raises(kind, match=words):
        load(jane, now=NOW)


@pytest.mark.parametrize(
    ("at", "words"),
    [
        (NOW - 2 * DAY, "valid from 2030-04-30 12:00 UTC on.*set the clock"),
        (NOW + 30 * DAY, "the key .* expired on 2030-05-31 12:00 UTC: issue a new one"),
        (NOW + 1825 * DAY, "the lab's authority, .* expired on 2035-04-30"),
    ],
)
def test_a_key_that_is_not_valid_now_is_refused(jane: Path, at: datetime, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        load(jane, now=at)


def test_the_lab_itself_is_not_an_identity(lab: Lab) -> None:
    with pytest.raises(UsageError, match=re.escape(str(lab.directory / "issued" / "NAME"))):
        load(lab.directory, now=NOW)


def test_a_revoked_or_replaced_key_is_refused_once_the_roster_has_it(lab: Lab, jane: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(jane, tmp_path / "copy")
    lab.issue(make_identity("jane", "observer"), now=NOW)
    shutil.copy(lab.directory / "roster.json", copy)
    with pytest.raises(UsageError, match=r"is of jane, pilot of alpha\*, but the roster says jane, observer of \*"):
        load(copy, now=NOW)
    lab.revoke("jane")
    shutil.copy(lab.directory / "roster.json", copy)
    with pytest.raises(UsageError, match="jane was revoked"):
        load(copy, now=NOW)


def test_a_roster_older_than_the_key_is_reported(lab: Lab, tmp_path: Path) -> None:
    old = shutil.copy(lab.directory / "roster.json", tmp_path / "old.json")
    lab.issue(make_identity("jane", "pilot"), now=NOW)
    shutil.copy(old, lab.folder("jane") / "roster.json")
    with pytest.raises(UsageError, match=r"jane is not on the roster.*copy the newest"):
        load(lab.folder("jane"), now=NOW)


def test_an_older_roster_is_ignored_and_a_false_one_is_an_error(lab: Lab, jane: Path, tmp_path: Path) -> None:
    old = shutil.copy(jane / "roster.json", tmp_path / "old.json")
    lab.issue(make_identity("olga", "observer"), now=NOW)
    credentials = load(jane, now=NOW)
    shutil.copy(old, jane / "roster.json")
    assert credentials.renewed() is None
    _change_roster(jane)
    with pytest.raises(UsageError, match="was changed"):
        credentials.renewed()


def test_a_roster_of_another_format_is_reported(lab: Lab, jane: Path) -> None:
    from skyloop.network.keys.credentials import Roster, encode_roster

    content = encode_roster(Roster(9, lab.authority.name, format=2), lab.authority)
    (jane / "roster.json").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"format 2; .* reads 1"):
        load(jane, now=NOW)


@pytest.mark.parametrize(
    ("left", "words"),
    [
        (8 * DAY, ""),
        (7 * DAY + timedelta(seconds=1), ""),
        (7 * DAY, "expires in 7 days, on 2030-05-08 12:00 UTC"),
        (timedelta(hours=30), "expires in 30 h,"),
        (timedelta(hours=1), "expires in 1 h,"),
        (timedelta(0), "expired on 2030-05-01"),
        (-DAY, "expired on 2030-04-30"),
    ],
)
def test_an_expiry_is_announced_a_week_before(left: timedelta, words: str) -> None:
    text = expiry_warning("it", NOW + left, NOW)
    assert bool(text) is bool(words)
    assert words in text


def test_expiries_of_a_key_and_its_authority_are_announced(tmp_path: Path) -> None:
    lab = Lab.make(tmp_path / "lab", days=33, now=NOW)
    lab.issue(make_identity("jane", "pilot"), now=NOW)
    jane = load(lab.folder("jane"), now=NOW)
    assert jane.ends(NOW + 22 * DAY) == {}
    (mine,) = jane.ends(NOW + 24 * DAY).values()
    assert mine.startswith("the key of jane expires in 6 days")
    assert list(jane.ends(NOW + 27 * DAY)) == ["the key of jane", "the lab's authority"]


def test_a_directory_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="can't be created"):
        make_directory(tmp_path / "file" / "keys")


@has_modes
def test_a_directory_that_is_open_to_others(tmp_path: Path) -> None:
    (tmp_path / "keys").mkdir(mode=0o755)
    with pytest.raises(UsageError, match="is open to others"):
        make_directory(tmp_path / "keys")


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "roster").mkdir()
    with pytest.raises(UsageError, match="can't be written"):
        write(tmp_path / "roster", b"x")
    assert [each.name for each in tmp_path.iterdir()] == ["roster"]
