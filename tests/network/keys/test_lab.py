"""The authority: what it issues and revokes, its files, and its refusals."""

from __future__ import annotations

import stat
import subprocess
from datetime import timedelta
from pathlib import Path

import pytest

from skyloop.errors import FileFormatError, UnknownNameError, UsageError
from skyloop.network.keys import KeyRole, Lab, Roster, load
from skyloop.network.keys.identity import make_identity
from tests.network.keys.conftest import NOW
from tests.support.systems import has_modes

DAY = timedelta(days=1)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_private_keys_are_readable_by_their_owner_only(lab: Lab, jane: Path) -> None:
    assert mode(lab.directory) == mode(jane) == 0o700
    assert mode(lab.directory / "ca.key") == mode(jane / "identity.key") == 0o600
    assert {path.name for path in jane.iterdir()} == {"ca.pem", "identity.key", "identity.pem", "roster.json"}


def test_an_identity_has_a_name_rights_and_an_expiry(lab: Lab) -> None:
    entry = lab.issue(make_identity("jane", "pilot", "alpha*,bravo"), now=NOW)
    assert entry.identity == make_identity("jane", "pilot", "alpha*,bravo")
    assert entry.expires_at == entry.last_at == NOW + 30 * DAY
    assert lab.roster.entries == (entry,)
    assert lab.roster.number == 2
    assert load(lab.folder("jane"), now=NOW).roster == lab.roster


def test_openssl_accepts_the_certificates(lab: Lab) -> None:
    """Checked by another implementation: the chain, the purposes, the common name and the URI."""
    lab.issue(make_identity("jane", "pilot", "alpha*"), now=NOW)
    lab.issue(make_identity("alpha", "proxy", "alpha"), now=NOW)
    at = ["-attime", str(int(NOW.timestamp()))]

    def openssl(*arguments: str | Path) -> str:
        done = subprocess.run(["openssl", *map(str, arguments)], capture_output=True, text=True, check=False)
        return done.stdout + done.stderr

    authority: list[str | Path] = ["-CAfile", lab.directory / "ca.pem", *at, "-x509_strict"]
    jane, alpha = lab.folder("jane") / "identity.pem", lab.folder("alpha") / "identity.pem"
    if "OpenSSL" not in openssl("version"):
        pytest.skip("openssl is not installed")
    assert "identity.pem: OK" in openssl("verify", *authority, "-purpose", "sslclient", jane)
    assert "unsuitable certificate purpose" in openssl("verify", *authority, "-purpose", "sslserver", jane)
    assert "identity.pem: OK" in openssl("verify", *authority, "-purpose", "sslserver", alpha)
    text = openssl("x509", "-in", jane, "-noout", "-text")
    assert "Subject: CN=jane" in text.replace("CN = ", "CN=")
    assert "URI:urn:skyloop:pilot:alpha*" in text


def test_each_change_reaches_all_folders(lab: Lab, jane: Path) -> None:
    before = load(jane, now=NOW)
    assert before.renewed() is None
    lab.issue(make_identity("alpha", "proxy", "alpha"), now=NOW)
    after = before.renewed()
    assert after is not None
    assert after.roster.number == before.roster.number + 1
    assert [identity.name for identity in after.roster.identities] == ["alpha", "jane"]
    assert (after.identity, after.directory) == (before.identity, before.directory)


def test_a_renewal_keeps_the_name_and_may_change_the_role(lab: Lab, jane: Path) -> None:
    first = (jane / "identity.pem").read_bytes()
    entry = lab.issue(make_identity("jane", "observer"), days=1, now=NOW)
    assert (jane / "identity.pem").read_bytes() != first
    assert load(jane, now=NOW).role is KeyRole.OBSERVER
    assert entry.expires_at == NOW + DAY
    assert entry.last_at == NOW + 30 * DAY  # the first key remains valid


def test_a_key_never_outlives_its_authority(tmp_path: Path) -> None:
    lab = Lab.make(tmp_path / "lab", days=10, now=NOW)
    entry = lab.issue(make_identity("jane", "pilot"), now=NOW)
    assert entry.expires_at == NOW + 10 * DAY


def test_a_revoked_identity_may_not_join_and_its_folder_is_gone(lab: Lab, jane: Path) -> None:
    stays = lab.issue(make_identity("alpha", "proxy", "alpha"), now=NOW)
    entry = lab.revoke("jane")
    assert entry.revoked
    assert lab.roster.identities == [stays.identity]
    assert list(jane.iterdir()) == []


def test_a_revoked_name_is_not_reissued_while_its_lost_key_is_valid(lab: Lab, jane: Path) -> None:
    lab.issue(make_identity("jane", "pilot"), days=2, now=NOW)
    lab.revoke("jane")
    with pytest.raises(UsageError, match=r"valid until 2030-05-31: choose another name"):
        lab.issue(make_identity("jane", "pilot"), now=NOW + 29 * DAY)
    entry = lab.issue(make_identity("jane", "pilot"), now=NOW + 30 * DAY)
    assert not entry.revoked
    assert load(jane, now=NOW + 30 * DAY).name == "jane"


def test_revoking_an_unknown_or_revoked_name_is_refused(lab: Lab, jane: Path) -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'jane'"):
        lab.revoke("jame")
    lab.revoke("jane")
    with pytest.raises(UsageError, match="already revoked"):
        lab.revoke("jane")


def test_a_second_authority_in_one_folder_is_refused(lab: Lab) -> None:
    with pytest.raises(UsageError, match="already has an authority"):
        Lab.make(lab.directory, now=NOW)


@has_modes
def test_a_folder_open_to_others_is_refused(tmp_path: Path) -> None:
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o755)
    with pytest.raises(UsageError, match="chmod 700"):
        Lab.make(tmp_path / "open", now=NOW)


@pytest.mark.parametrize("days", [0, -1, 367, float("nan"), float("inf")])
def test_the_validity_of_a_key_is_limited(lab: Lab, days: float) -> None:
    with pytest.raises(UsageError, match="at most 366 days"):
        lab.issue(make_identity("jane", "pilot"), days=days, now=NOW)


@pytest.mark.parametrize("days", [0, 36501])
def test_the_validity_of_an_authority_is_limited(tmp_path: Path, days: int) -> None:
    with pytest.raises(UsageError, match="1 to 36500 days"):
        Lab.make(tmp_path / "lab", days=days, now=NOW)


def test_an_expired_authority_issues_nothing(lab: Lab) -> None:
    with pytest.raises(UsageError, match="authority expired on 2035-04-30"):
        lab.issue(make_identity("jane", "pilot"), now=NOW + 1825 * DAY)


def test_a_folder_without_an_authority_is_reported(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="skyloop keys init"):
        Lab.open(tmp_path)


@has_modes
def test_an_authority_readable_by_others_is_refused(lab: Lab) -> None:
    (lab.directory / "ca.key").chmod(0o640)
    with pytest.raises(UsageError, match=r"mode 0640.*chmod 600"):
        Lab.open(lab.directory)


def test_an_authority_with_damaged_or_mixed_up_files_is_reported(lab: Lab, jane: Path, tmp_path: Path) -> None:
    other = Lab.make(tmp_path / "other", now=NOW)
    authority = lab.directory / "ca.pem"
    authority.write_bytes((other.directory / "ca.pem").read_bytes())
    with pytest.raises(UsageError, match="does not belong to its certificate"):
        Lab.open(lab.directory)
    authority.write_bytes((jane / "identity.pem").read_bytes())
    with pytest.raises(FileFormatError, match="not the certificate of an authority"):
        Lab.open(lab.directory)
    authority.write_bytes(b"rubbish")
    with pytest.raises(FileFormatError, match="not a certificate in PEM form"):
        Lab.open(lab.directory)
    authority.unlink()
    with pytest.raises(UsageError, match="can't be read"):
        Lab.open(lab.directory)


def test_an_authority_can_be_reopened(lab: Lab, jane: Path) -> None:
    again = Lab.open(lab.directory)
    assert again.roster == lab.roster
    again.issue(make_identity("olga", "observer"), now=NOW)
    assert load(jane, now=NOW).roster.find("olga") is not None


def test_roster_numbers_only_grow(lab: Lab) -> None:
    seen: list[Roster] = [lab.roster]
    for name in ("a", "b", "a"):
        lab.issue(make_identity(name, "pilot"), now=NOW)
        seen.append(lab.roster)
    lab.revoke("b")
    seen.append(lab.roster)
    assert [roster.number for roster in seen] == [1, 2, 3, 4, 5]
    assert [entry.name for entry in seen[-1].entries] == ["a", "b"]
