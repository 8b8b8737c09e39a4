"""Who may do what: tokens with roles in a file that only its owner reads."""

import hmac
import os
import stat
import tomllib
from collections.abc import Mapping
from pathlib import Path

from terrafix.core.errors import ConfigError, UsageError
from terrafix_tools.console.payloads import Role
from terrafix_tools.console.settings import Settings

LOOPBACK = ("127.0.0.1", "::1", "localhost")
MIN_TOKEN = 20  # characters [spec: 100 bits at base 32]


def read_tokens(path: Path) -> dict[str, Role]:
    """TOML with a table [tokens]: NAME = {role = "viewer" or "operator", token = "..."} -> roles by token.

    Raises ConfigError: not readable, or others than its owner may read it, or a token is short."""
    try:
        with path.open("rb") as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            if mode & 0o077:
                raise ConfigError(f"{path}: others may read it (mode {mode:04o}); chmod 600 {path}")
            table = tomllib.load(file)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML ({error})") from None
    entries = table.get("tokens")
    if not isinstance(entries, dict) or not entries:
        raise ConfigError(f'{path}: has no [tokens]; write NAME = {{role = "viewer", token = "..."}} below it')
    return dict(_token(path, name, entry) for name, entry in entries.items())


def _token(path: Path, name: str, entry: object) -> tuple[str, Role]:
    if not isinstance(entry, dict) or set(entry) != {"role", "token"} or entry["role"] not in [*Role]:
        raise ConfigError(f'{path}: [tokens] {name}: write {{role = "viewer" or "operator", token = "..."}}')
    token = entry["token"]
    if not isinstance(token, str) or len(token) < MIN_TOKEN or not token.isascii():
        raise ConfigError(f"{path}: [tokens] {name}: a token has at least {MIN_TOKEN} ASCII characters")
    return token, Role(entry["role"])


class Access:
    """Roles by token. Without a tokens file everyone who reaches the service is an operator."""

    def __init__(self, tokens: Mapping[str, Role] | None) -> None:
        self._tokens = tokens

    @property
    def required(self) -> bool:
        return self._tokens is not None

    def role_of(self, token: str) -> Role | None:
        """None: no such token. Compares with every token in constant time."""
        if self._tokens is None:
            return Role.OPERATOR
        given, found = token.encode(), None
        for known, role in self._tokens.items():
            if hmac.compare_digest(known.encode(), given):
                found = role
        return found


def access_of(settings: Settings) -> Access:
    """Beyond this computer the service needs tokens and TLS. Raises UsageError, ConfigError."""
    if (settings.cert is None) != (settings.key is None):
        raise UsageError("--cert and --key belong together; give both, or neither")
    if settings.host not in LOOPBACK:
        if settings.tokens is None:
            raise UsageError(f"--host {settings.host}: reachable from other computers; give --tokens FILE")
        if settings.cert is None:
            raise UsageError(f"--host {settings.host}: tokens would be sent in clear; give --cert and --key")
    return Access(None if settings.tokens is None else read_tokens(settings.tokens))
