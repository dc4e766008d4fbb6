"""`mrcdrl certs`: what is made, what is kept, and who can read it."""

import datetime
import stat
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from mrcdrl.common.errors import ConfigError
from mrcdrl.services.tools.certificates import make
from mrcdrl.services.tools.certs import HOSTS, ROLES, main

DAY = datetime.timedelta(days=1)


def certificate(folder: Path, role: str) -> x509.Certificate:
    return x509.load_pem_x509_certificate((folder / role / "certificate.pem").read_bytes())


@pytest.mark.parametrize("role", ROLES)
def test_a_role_has_what_it_needs_and_no_more(certificates: Path, role: str) -> None:
    own = certificate(certificates, role)
    assert {path.name for path in (certificates / role).iterdir()} == {
        "ca.pem",
        "certificate.pem",
        "key.pem",
    }
    [name] = own.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    assert name.value == role
    authority = x509.load_pem_x509_certificate((certificates / role / "ca.pem").read_bytes())
    own.verify_directly_issued_by(authority)
    assert not own.extensions.get_extension_for_class(x509.BasicConstraints).value.ca


@pytest.mark.parametrize("role", ["ca", *ROLES])
def test_nobody_else_reads_a_key(certificates: Path, role: str) -> None:
    assert stat.S_IMODE((certificates / role / "key.pem").stat().st_mode) == 0o600


@pytest.mark.parametrize("role", ROLES)
def test_only_a_router_may_be_listened_to(certificates: Path, role: str) -> None:
    extensions = certificate(certificates, role).extensions
    purposes = extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert ExtendedKeyUsageOID.CLIENT_AUTH in purposes
    assert (ExtendedKeyUsageOID.SERVER_AUTH in purposes) == (role == "router")


def test_hosts_are_names_and_addresses(certificates: Path) -> None:
    extensions = certificate(certificates, "router").extensions
    names = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    dns = names.get_values_for_type(x509.DNSName)
    addresses = map(str, names.get_values_for_type(x509.IPAddress))
    assert {*dns, *addresses} == set(HOSTS)


def test_what_exists_is_kept_and_what_is_missing_is_made(tmp_path: Path) -> None:
    assert make(tmp_path, ["actor"], HOSTS, DAY) == ["ca", "actor"]
    before = certificate(tmp_path, "actor")
    assert make(tmp_path, ["actor", "learner"], HOSTS, DAY) == ["learner"]
    assert certificate(tmp_path, "actor") == before
    assert make(tmp_path, ["actor", "learner"], HOSTS, DAY) == []


def test_what_has_expired_is_made_again(tmp_path: Path) -> None:
    make(tmp_path, ["actor"], HOSTS, -datetime.timedelta(minutes=30))
    assert make(tmp_path, ["actor"], HOSTS, DAY) == ["ca", "actor"]
    assert make(tmp_path, ["actor"], HOSTS, DAY) == []


def test_a_role_of_another_authority_is_made_again(tmp_path: Path) -> None:
    make(tmp_path, ["actor"], HOSTS, DAY)
    for file in (tmp_path / "ca").iterdir():
        file.unlink()
    assert make(tmp_path, ["actor"], HOSTS, DAY) == ["ca", "actor"]


def test_a_damaged_file_is_one_line(tmp_path: Path) -> None:
    make(tmp_path, ["actor"], HOSTS, DAY)
    (tmp_path / "actor" / "key.pem").write_text("nonsense")
    with pytest.raises(ConfigError, match="remove it to have it made again"):
        make(tmp_path, ["actor"], HOSTS, DAY)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path), "--role", "actor", "--host", "router.example"]) == 0
    assert "made ca, actor" in capsys.readouterr().out
    assert main([str(tmp_path), "--role", "actor"]) == 0
    assert "nothing, all exist" in capsys.readouterr().out


def test_a_role_that_cannot_be_one_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"role '\.\./actor'"):
        main([str(tmp_path), "--role", "../actor"])
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--days", "0"])
