"""Ed25519 keys and signatures (RFC 8032) of what is prepared on the ground and trusted in flight.

The library is imported where it computes: the map is opened after a restart in flight, too, and most need no key."""

import base64
import binascii
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from terrafix.core.errors import ConfigError, OutputError, UsageError

PUBLIC_PREFIX = "terrafix-ed25519 "  # one line of text: what it is, the key in base64, whose it is
KEY_BYTES = 32
ID_DIGITS = 16


@dataclass(frozen=True)
class TrustedKey:
    """A public key, 32 bytes as in RFC 8032."""

    raw: bytes

    @cached_property
    def key_id(self) -> str:
        """First half of the sha256 of the key in hexadecimal: short enough to read out, long enough to be unique."""
        return hashlib.sha256(self.raw).hexdigest()[:ID_DIGITS]


def is_signed(key: TrustedKey, message: bytes, signature: bytes) -> bool:
    """Whether ``signature`` is that of the key's owner over ``message``. A malformed key or signature is not."""
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    try:
        Ed25519PublicKey.from_public_bytes(key.raw).verify(signature, message)
    except (InvalidSignature, ValueError, TypeError):
        return False
    return True


def sign(private_key: Path, message: bytes) -> tuple[TrustedKey, bytes]:
    """-> the public key and the signature. Raises UsageError: no private key in the file."""
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
    """Writes a new pair of keys, the private one readable by its owner only. Raises OutputError; overwrites nothing."""
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
    """Raises ConfigError: not a public key as ``generate`` writes it."""
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
    if len(raw) != KEY_BYTES:
        raise ConfigError(f"{path}: not a public key of 'terrafix map keygen'; give its .pub file")
    return TrustedKey(raw)


def trusted_keys(paths: Sequence[str], *, required: bool) -> tuple[TrustedKey, ...] | None:
    """The keys in these files, and in the .pub files of these folders; None when no signature is required.

    Raises ConfigError: a file without a key, or a signature required and nobody trusted."""
    if not required:
        return None
    files = [f for p in map(Path, paths) for f in (sorted(p.glob("*.pub")) if p.is_dir() else [p])]
    if not files:
        raise ConfigError(
            "[map] require_signature is on and trusted_keys names no key; add the .pub file of the signer"
        )
    return tuple(read_public(file) for file in files)
