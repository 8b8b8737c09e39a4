"""Ed25519 keys and signatures (RFC 8032) of map packages, which are prepared on the ground and trusted in flight.

The cryptography library is imported only in the functions that use it: the map is also opened at a restart in flight,
and most configurations need no key."""

import base64
import binascii
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from terrafix.core.errors import ConfigError, OutputError, UsageError

PUBLIC_PREFIX = "terrafix-ed25519 "  # a public key file is one line: this prefix, the key in base64, the owner
ED25519_KEY_BYTES = 32
ID_DIGITS = 16  # hexadecimal


@dataclass(frozen=True)
class TrustedKey:
    """A public key, 32 bytes as in RFC 8032."""

    raw: bytes

    @cached_property
    def key_id(self) -> str:
        """First ID_DIGITS hexadecimal digits of the sha256 of the key: short enough to read aloud, and unique."""
        return hashlib.sha256(self.raw).hexdigest()[:ID_DIGITS]


def is_signed(key: TrustedKey, message: bytes, signature: bytes) -> bool:
    """Whether ``signature`` is a valid signature of ``message`` by ``key``. False for a malformed key or signature."""
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    try:
        Ed25519PublicKey.from_public_bytes(key.raw).verify(signature, message)
    except (InvalidSignature, ValueError, TypeError):
        return False
    return True


def sign(private_key: Path, message: bytes) -> tuple[TrustedKey, bytes]:
    """Signs ``message`` -> public key, signature. Raises UsageError when the file holds no private key."""
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    try:
        key = serialization.load_pem_private_key(private_key.read_bytes(), password=None)
    except OSError as error:
        raise UsageError(
            f"{private_key}: key cannot be read ({error.strerror}); make one: terrafix map keygen"
        ) from None
    except (ValueError, TypeError, UnsupportedAlgorithm):
        key = None
    if not isinstance(key, Ed25519PrivateKey):
        raise UsageError(
            f"{private_key}: not an Ed25519 private key in PEM without password; make one: terrafix map keygen"
        )
    return TrustedKey(key.public_key().public_bytes_raw()), key.sign(message)


def generate(private_key: Path, public_key: Path, owner: str) -> TrustedKey:
    """Writes a new key pair; the private key file has mode 0600. Raises OutputError, also when a file exists."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    key = Ed25519PrivateKey.generate()
    public = TrustedKey(key.public_key().public_bytes_raw())
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    line = f"{PUBLIC_PREFIX}{base64.b64encode(public.raw).decode()} {owner}\n"
    for path, content, mode in ((private_key, pem, 0o600), (public_key, line.encode(), 0o644)):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
                file.write(content)
        except FileExistsError:
            raise OutputError(f"{path}: exists, and a key is never overwritten; give another name") from None
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
    return public


def read_public(path: Path) -> TrustedKey:
    """Reads a public key file as ``generate`` writes it. Raises ConfigError when it is not one."""
    try:
        text = path.read_text(encoding="ascii")
    except OSError as error:
        raise ConfigError(f"{path}: public key cannot be read ({error.strerror}); check [map] trusted_keys") from None
    except UnicodeDecodeError:
        text = ""
    words = text.split()
    try:
        raw = base64.b64decode(words[1], validate=True) if text.startswith(PUBLIC_PREFIX) and len(words) > 1 else b""
    except binascii.Error:
        raw = b""
    if len(raw) != ED25519_KEY_BYTES:
        raise ConfigError(f"{path}: not a public key of 'terrafix map keygen'; give its .pub file")
    return TrustedKey(raw)


def trusted_keys(paths: Sequence[str], *, required: bool) -> tuple[TrustedKey, ...] | None:
    """The public keys in these files and in the .pub files of these folders; None when no signature is required.

    Raises ConfigError for a file without a key, or when a signature is required and there is no key."""
    if not required:
        return None
    files = [f for p in map(Path, paths) for f in (sorted(p.glob("*.pub")) if p.is_dir() else [p])]
    if not files:
        raise ConfigError(
            "[map] require_signature is on and trusted_keys names no key; add the .pub file of the signer"
        )
    return tuple(read_public(file) for file in files)
