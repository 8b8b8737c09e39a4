"""Signed packages: trusted keys, and the reasons for a rejection."""

import sqlite3
import stat
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key

import map_rasters
from map_packages import alter, centre_of
from terrafix.core.errors import ConfigError, MapError, OutputError, UsageError
from terrafix.core.signature import TrustedKey, generate, is_signed, read_public, trusted_keys
from terrafix.map.checksum import write_file_digest
from terrafix.map.package import MapPackage
from terrafix_tools.live import package_for
from terrafix_tools.mapping.build import build
from terrafix_tools.mapping.package.sign import sign_package


@pytest.fixture
def package(tmp_path: Path) -> Path:
    return build(map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(300, 300)), tmp_path / "m.gpkg")


def keys(folder: Path, name: str = "op") -> tuple[Path, Path, TrustedKey]:
    private, public = folder / f"{name}.key", folder / f"{name}.pub"
    return private, public, generate(private, public, "somebody")


def test_signatures_follow_rfc_8032() -> None:
    """Test 2 of RFC 8032, section 7.1."""
    public = bytes.fromhex("3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c")
    signature = bytes.fromhex(
        "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da"
        "085ac1e43e15996e458f3613d0f11d8c387b2eaeb4302aeeb00d291612bb0c00"
    )
    assert is_signed(TrustedKey(public), b"\x72", signature)
    assert not is_signed(TrustedKey(public), b"\x73", signature)
    assert not is_signed(TrustedKey(public), b"\x72", signature[:-1])
    assert not is_signed(TrustedKey(public[:-1]), b"\x72", signature)


def test_a_signed_package_opens_with_a_trusted_key(tmp_path: Path, package: Path) -> None:
    private, public, key = keys(tmp_path)
    before = package.read_bytes()
    assert sign_package(package, private) == key
    opened = MapPackage.open(package, verify=True, trusted=[key])
    assert opened.signed_by == (key.key_id,)
    assert opened.manifest.checksum.encode() in before
    # The signature computed with the library, over the documented bytes.
    loaded = load_pem_private_key(private.read_bytes(), password=None)
    assert isinstance(loaded, Ed25519PrivateKey)
    db = sqlite3.connect(package)
    raw, signature = db.execute("SELECT public_key, signature FROM terrafix_signature").fetchone()
    db.close()
    message = b"terrafix map package\n" + opened.manifest.checksum.encode()
    assert signature == loaded.sign(message)
    Ed25519PublicKey.from_public_bytes(raw).verify(signature, message)
    opened.close()
    assert not package.with_name("m.gpkg-journal").exists()
    assert stat.S_IMODE(private.stat().st_mode) == 0o600
    assert trusted_keys([str(public)], required=True) == (key,) == trusted_keys([str(tmp_path)], required=True)
    assert trusted_keys([str(public)], required=False) is None


def test_unsigned_foreign_and_altered_packages_are_rejected_with_the_reason(tmp_path: Path, package: Path) -> None:
    private, _, key = keys(tmp_path)
    _, _, other = keys(tmp_path, "other")
    MapPackage.open(package).close()
    with pytest.raises(MapError, match=r"not signed.*terrafix map sign"):
        MapPackage.open(package, trusted=[key])
    sign_package(package, private)
    with pytest.raises(MapError, match=rf"signed by {key.key_id}, which is not in .*trusted_keys.*{other.key_id}"):
        MapPackage.open(package, trusted=[other])
    MapPackage.open(package, trusted=[other, key]).close()
    whole = package.read_bytes()
    alter(package, "UPDATE terrafix_manifest SET value = 'mine' WHERE key = 'licence'")
    with pytest.raises(MapError, match="checksum mismatch"):
        MapPackage.open(package)
    package.write_bytes(whole)
    alter(package, "UPDATE terrafix_signature SET signature = zeroblob(64)")
    with pytest.raises(MapError, match="wrong signature"):  # also when no signature is required
        MapPackage.open(package)


def test_a_forged_checksum_does_not_pass_the_signature(tmp_path: Path, package: Path) -> None:
    private, _, key = keys(tmp_path)
    sign_package(package, private)
    other = build(map_rasters.utm(tmp_path / "j.tif", map_rasters.texture(300, 300, seed=9)), tmp_path / "n.gpkg")
    db = sqlite3.connect(package)
    row = db.execute("SELECT key_id, public_key, signature FROM terrafix_signature").fetchone()
    db.close()
    alter(other, "INSERT INTO terrafix_signature (key_id, public_key, signature) VALUES (?, ?, ?)", *row)
    with pytest.raises(MapError, match="wrong signature"):
        MapPackage.open(other, trusted=[key])
    # The attacker's key under the id of the trusted one.
    mine, _, attacker = keys(tmp_path, "attacker")
    alter(other, "DELETE FROM terrafix_signature")
    write_file_digest(other)  # needs no key: the file digest protects against accidents only
    sign_package(other, mine)
    alter(other, "UPDATE terrafix_signature SET key_id = ?", key.key_id)
    with pytest.raises(MapError, match="wrong signature"):
        MapPackage.open(other, trusted=[key])
    assert attacker != key


def test_two_keys_can_sign_and_signing_twice_changes_nothing(tmp_path: Path, package: Path) -> None:
    first, _, one = keys(tmp_path)
    second, _, two = keys(tmp_path, "second")
    sign_package(package, first)
    sign_package(package, second)
    sign_package(package, first)
    opened = MapPackage.open(package, trusted=[two])
    assert set(opened.signed_by) == {one.key_id, two.key_id}
    opened.close()


def test_a_damaged_package_is_not_signed(tmp_path: Path, package: Path) -> None:
    private, _, _ = keys(tmp_path)
    alter(
        package,
        "UPDATE imagery SET tile_data = zeroblob(100) WHERE zoom_level = 1 AND tile_column = 0 AND tile_row = 0",
    )
    with pytest.raises(MapError, match="altered or lost"):
        sign_package(package, private)


def test_an_interrupted_signing_is_detected_and_rolled_back(tmp_path: Path, package: Path) -> None:
    private, _, key = keys(tmp_path)
    db = sqlite3.connect(package)
    db.execute("PRAGMA cache_size = 1")
    db.execute("BEGIN")
    db.execute(
        "INSERT INTO terrafix_signature (key_id, public_key, signature) VALUES ('x', zeroblob(9000), zeroblob(64))"
    )
    db.execute("UPDATE terrafix_manifest SET value = value || '!'")
    journal = package.with_name("m.gpkg-journal").read_bytes()
    half = package.read_bytes()
    db.rollback()
    db.close()
    package.write_bytes(half)
    package.with_name("m.gpkg-journal").write_bytes(journal)  # as after a power failure
    with pytest.raises(MapError, match=r"interrupted.*terrafix map sign"):
        MapPackage.open(package)
    sign_package(package, private)
    MapPackage.open(package, verify=True, trusted=[key]).close()


def test_invalid_keys_are_reported(tmp_path: Path, package: Path) -> None:
    private, public, _ = keys(tmp_path)
    with pytest.raises(OutputError, match="never overwritten"):
        generate(private, public, "")
    with pytest.raises(UsageError, match="key cannot be read"):
        sign_package(package, tmp_path / "none.key")
    with pytest.raises(UsageError, match="not an Ed25519 private key"):
        sign_package(package, public)
    with pytest.raises(ConfigError, match="not a public key"):
        read_public(private)
    with pytest.raises(ConfigError, match="cannot be read"):
        trusted_keys([str(tmp_path / "none.pub")], required=True)
    (tmp_path / "empty").mkdir()
    for paths in ([], [str(tmp_path / "empty")]):
        with pytest.raises(ConfigError, match="names no key"):
            trusted_keys(paths, required=True)


def test_a_run_that_requires_signatures_rejects_an_unsigned_map_before_it_starts(tmp_path: Path, package: Path) -> None:
    private, public, _ = keys(tmp_path)
    config = tmp_path / "my.toml"
    config.write_text(f'[map]\nrequire_signature = true\ntrusted_keys = ["{public}"]\n')
    centre = centre_of(package)
    start = f"{centre.lat_deg},{centre.lon_deg}"
    with pytest.raises(MapError, match="not signed"):
        package_for("/dev/video0", start, package, [config])
    assert package_for("/dev/video0", start, package, []) == (package, None)
    sign_package(package, private)
    assert package_for("/dev/video0", start, package, [config]) == (package, None)
    alter(
        package, "UPDATE imagery SET tile_data = zeroblob(9) WHERE zoom_level = 1 AND tile_column = 0 AND tile_row = 0"
    )
    with pytest.raises(MapError, match="altered or lost"):  # verifies every tile, not only the tile list
        package_for("/dev/video0", start, package, [config])
