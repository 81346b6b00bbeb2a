"""Certificates: what they say, who may read what, and what is refused."""

from __future__ import annotations

import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID
from typer.testing import CliRunner

from endo3d.services.cli import keys as command
from endo3d.services.runtime.certificates import make_authority, make_host, name_in
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.hosts import Role
from endo3d.services.runtime.identity import identity_of, keys_folder


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def read(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    make_authority(tmp_path / "keys", "bench", 2)
    return tmp_path / "keys"


def test_only_the_owner_reads_keys(folder: Path) -> None:
    make_host(folder, folder / "out", "rig", Role.RIG, [], 2)
    assert mode(folder) == mode(folder / "out") == 0o700
    assert mode(folder / "ca.key") == mode(folder / "out" / "rig.key") == 0o600
    assert not (folder / "out" / "ca.key").exists(), "the authority's key stays where it is"


def test_a_hosts_certificate_says_who_it_is_and_where(folder: Path) -> None:
    certificate = read(make_host(folder, folder, "rig", Role.RIG, ["10.1.2.3", "rig.local", "fe80::1"], 2))
    assert name_in(folder / "rig.pem")[0] == "rig.rig"
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert {str(ip) for ip in names.get_values_for_type(x509.IPAddress)} == {"10.1.2.3", "fe80::1", "127.0.0.1"}
    assert set(names.get_values_for_type(x509.DNSName)) == {"rig", "rig.local", "localhost"}
    usage = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert set(usage) == {ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH}
    read(folder / "rig.pem").verify_directly_issued_by(read(folder / "ca.pem"))
    basic = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
    assert not basic.ca, "a host's certificate signs nobody else's"


def test_nothing_is_overwritten(folder: Path) -> None:
    make_host(folder, folder, "rig", Role.RIG, [], 2)
    with pytest.raises(UserError, match="has a certificate of rig already"):
        make_host(folder, folder, "rig", Role.RIG, [], 2)
    with pytest.raises(UserError, match="has an authority already"):
        make_authority(folder, "bench", 2)


def test_a_key_that_others_may_read_is_refused(folder: Path) -> None:
    make_host(folder, folder, "rig", Role.RIG, [], 2)
    assert identity_of("rig", Role.RIG, folder).key == folder / "rig.key"
    (folder / "rig.key").chmod(0o640)
    with pytest.raises(UserError, match=r"others may read .*rig.key"):
        identity_of("rig", Role.RIG, folder)


def test_a_certificate_of_another_role_or_day_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_host(folder, folder, "rig", Role.VIEWER, [], 2)
    with pytest.raises(UserError, match=r"is of 'viewer.rig', not of 'rig.rig'"):
        identity_of("rig", Role.RIG, folder)
    with pytest.raises(UserError, match=r"no .*left.pem; make it with endo3d keys host left --role rig"):
        identity_of("left", Role.RIG, folder)
    assert name_in(folder / "rig.pem")[1] - datetime.now(UTC) < timedelta(days=2, minutes=1)


def test_by_the_command_line(tmp_path: Path) -> None:
    run = CliRunner().invoke
    folder = str(tmp_path / "keys")
    assert run(command.app, ["init", "bench", "--folder", folder]).exit_code == 0
    made = run(command.app, ["host", "left", "--role", "rig", "--folder", folder, "--out", str(tmp_path / "left")])
    assert made.exit_code == 0, made.output
    assert sorted(path.name for path in (tmp_path / "left").iterdir()) == ["ca.pem", "left.key", "left.pem"]
    assert "PRIVATE" not in made.output
    wrong = run(command.app, ["host", "a/b", "--role", "rig", "--folder", folder])
    assert isinstance(wrong.exception, UserError)


def test_where_keys_lie(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ENDO3D_KEYS", str(tmp_path))
    assert keys_folder() == tmp_path
    assert keys_folder("certificates", tmp_path / "stack") == tmp_path / "stack" / "certificates"
    monkeypatch.delenv("ENDO3D_KEYS")
    assert keys_folder() == Path.home() / ".config/endo3d/keys"
