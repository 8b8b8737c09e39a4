"""Who may do what at the console."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from console_rig import NEW, Console, batch, settings
from terrafix.core.errors import ConfigError, UsageError
from terrafix_tools.console.access import access_of, read_tokens
from terrafix_tools.console.payloads import Role
from terrafix_tools.console.settings import ServiceLimits

OPERATOR, VIEWER = "operator-" + "o" * 20, "viewer-" + "v" * 20
TOKENS = f"""[tokens]
ground = {{role = "operator", token = "{OPERATOR}"}}
screen = {{role = "viewer", token = "{VIEWER}"}}
"""


def tokens_file(folder: Path, text: str = TOKENS, mode: int = 0o600) -> Path:
    path = folder / "tokens.toml"
    path.write_text(text)
    path.chmod(mode)
    return path


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Console]:
    folder = tmp_path_factory.mktemp("guarded")
    with Console(settings(folder, tokens=tokens_file(folder))) as running:
        yield running


def bearer(token: str) -> dict[str, str]:
    return {"authorization": f"Bearer {token}"}


def test_tokens_have_their_roles(tmp_path: Path) -> None:
    assert read_tokens(tokens_file(tmp_path)) == {OPERATOR: Role.OPERATOR, VIEWER: Role.VIEWER}


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o601, 0o777])
def test_a_tokens_file_that_others_may_use_is_refused(tmp_path: Path, mode: int) -> None:
    with pytest.raises(ConfigError, match="chmod 600"):
        read_tokens(tokens_file(tmp_path, mode=mode))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "tokens = 3",
        "[tokens]",
        '[tokens]\na = {role = "admin", token = "12345678901234567890"}',
        '[tokens]\na = {role = "viewer", token = "short"}',
        '[tokens]\na = {role = "viewer"}',
        "[tokens",
    ],
)
def test_a_tokens_file_that_is_not_valid_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match="tokens"):
        read_tokens(tokens_file(tmp_path, text))


def test_beyond_this_computer_tokens_and_tls_are_required(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--tokens"):
        access_of(settings(tmp_path, host="0.0.0.0"))
    with pytest.raises(UsageError, match="--cert and --key"):
        access_of(settings(tmp_path, host="0.0.0.0", tokens=tokens_file(tmp_path)))
    with pytest.raises(UsageError, match="belong together"):
        access_of(settings(tmp_path, cert=tmp_path / "cert.pem"))
    assert access_of(settings(tmp_path, host="::1")).required is False


@pytest.mark.parametrize(
    "headers", [{}, bearer("wrong"), bearer(OPERATOR[:-1]), {"authorization": f"Basic {OPERATOR}"}]
)
def test_without_a_valid_token_nothing_but_the_page_is_served(guarded: Console, headers: dict[str, str]) -> None:
    for method, path in (
        ("GET", "/health"),
        ("GET", "/flights"),
        ("POST", "/flights"),
        ("GET", "/maps"),
        ("GET", "/x"),
    ):
        answer = guarded.send(method, path, None, headers)
        assert (answer.status, answer.headers["www-authenticate"]) == (401, "Bearer"), path
        assert answer.headers["content-type"] == "application/problem+json"
    assert guarded.send("GET", "/page/", None, headers).status == 200
    assert guarded.send("GET", "/session", None, headers).json == {"required": True, "role": None}


def test_a_viewer_reads_and_an_operator_acts(guarded: Console) -> None:
    assert guarded.send("POST", "/flights", NEW, bearer(VIEWER)).status == 403
    flight_id = guarded.send("POST", "/flights", NEW, bearer(OPERATOR)).json["flight_id"]
    for method, path in (
        ("POST", f"/flights/{flight_id}/complete"),
        ("POST", f"/flights/{flight_id}/hint"),
        ("DELETE", f"/flights/{flight_id}"),
    ):
        assert guarded.send(method, path, None, bearer(VIEWER)).status == 403, path
    assert guarded.upload(flight_id, batch(1), **bearer(VIEWER)).status == 403
    assert guarded.upload(flight_id, batch(1), **bearer(OPERATOR)).status == 202
    assert guarded.send("GET", f"/flights/{flight_id}", None, bearer(VIEWER)).json["images"]["uploaded"] == 10


def test_a_session_cookie_carries_the_role_and_no_script_reads_it(guarded: Console) -> None:
    assert guarded.send("POST", "/session", {"token": "wrong"}).status == 401
    answer = guarded.send("POST", "/session", {"token": VIEWER})
    assert answer.json == {"required": True, "role": "viewer"}
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie and "SameSite=strict" in cookie
    sent = {"cookie": cookie.partition(";")[0]}
    assert guarded.send("GET", "/flights", None, sent).status == 200
    assert guarded.send("POST", "/flights", NEW, sent).status == 403


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://other.example"},
        {"origin": "null"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "same-site"},
    ],
)
def test_a_page_of_another_site_cannot_act(tmp_path: Path, headers: dict[str, str]) -> None:
    with Console(settings(tmp_path)) as console:
        answer = console.send("POST", "/flights", NEW, headers)
        assert answer.status == 403 and console.send("GET", "/flights").json == {"flights": []}
        assert not [name for name in answer.headers if name.lower().startswith("access-control-")]
        own = {"origin": console.url, "sec-fetch-site": "same-origin"}
        assert console.send("POST", "/flights", NEW, own).status == 201


def test_without_tokens_only_names_of_this_computer_are_served(tmp_path: Path) -> None:
    with Console(settings(tmp_path, hosts=("drone.local",))) as console:
        assert console.send("GET", "/flights", None, {"host": "other.example"}).status == 421
        for name in ("localhost:8700", "127.0.0.1", "[::1]:8700", "drone.local"):
            assert console.send("GET", "/flights", None, {"host": name}).status == 200, name


def write_certificate(folder: Path) -> tuple[Path, Path]:
    """-> a certificate of its own signature, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "console")])
    now = datetime.now(UTC)
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = (
        builder.serial_number(1).not_valid_before(now - timedelta(days=1)).not_valid_after(now + timedelta(days=1))
    )
    (folder / "cert.pem").write_bytes(builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))
    text = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    (folder / "key.pem").write_bytes(text)
    return folder / "cert.pem", folder / "key.pem"


@pytest.mark.filterwarnings("ignore:Unverified HTTPS request")
def test_with_a_certificate_it_speaks_tls_and_the_cookie_is_for_tls_only(tmp_path: Path) -> None:
    cert, key = write_certificate(tmp_path)
    with Console(settings(tmp_path, cert=cert, key=key, tokens=tokens_file(tmp_path))) as console:
        assert console.url.startswith("https:")
        assert console.send("GET", "/health", None, bearer(VIEWER)).json["status"] == "ok"
        assert "Secure" in console.send("POST", "/session", {"token": VIEWER}).headers["set-cookie"]


def test_event_streams_are_bounded(tmp_path: Path) -> None:
    with Console(settings(tmp_path, limits=ServiceLimits(event_clients=0))) as console:
        flight_id = console.create()
        assert console.send("GET", f"/flights/{flight_id}/events").status == 429
