"""Passwords in addresses of cameras: they belong into no log, record or error."""

import re

_IN_ADDRESS = re.compile(r"(\b\w+://[^\s/:@]*):[^\s/]*@")
_NAMED = re.compile(r"((?:user-pw|passw(?:or)?d|pwd)\s*=\s*)(?:\"[^\"]*\"|[^\s&\"!]+)", re.IGNORECASE)


def without_password(text: str) -> str:
    """``text`` with every password of an address, a query or a GStreamer property as ``***``."""
    return _NAMED.sub(r"\1***", _IN_ADDRESS.sub(r"\1:***@", text))
