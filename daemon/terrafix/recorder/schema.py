"""Channels of the flight record: one per message type, JSON with a JSON schema. Those of Foxglove: foxglove.py."""

from functools import cache
from typing import Any

import msgspec

from terrafix import messages as m
from terrafix.messages import Message

MESSAGE_TYPES: dict[str, type[Message]] = {t.__name__: t for t in m.ALL_MESSAGES}


@cache
def topic_of(message_type: type[Message]) -> str:
    """Topic of a message type: NavEstimate -> /nav_estimate"""
    name = message_type.__name__
    return "/" + "".join(("_" if i and c.isupper() else "") + c.lower() for i, c in enumerate(name))


TYPE_BY_TOPIC: dict[str, type[Message]] = {topic_of(t): t for t in MESSAGE_TYPES.values()}


def schema_of(message_type: type[Message]) -> bytes:
    """JSON schema in the subset that viewers support: no references, unions or arrays of arrays.

    Arrays of arrays (matched points) are in the data but not in the schema, which allows additional properties."""
    full = msgspec.json.schema(message_type)
    plain = _plain(full, full["$defs"])
    if plain is None:
        raise TypeError(f"{message_type.__name__} has no JSON schema")
    return msgspec.json.encode(plain)


def _plain(node: dict[str, Any], defs: dict[str, Any]) -> dict[str, Any] | None:
    """A schema node without references and unions; None when a viewer could not display it."""
    if "$ref" in node:
        return _plain(defs[node["$ref"].rsplit("/", 1)[-1]], defs)
    if "anyOf" in node:
        known = [n for n in node["anyOf"] if n.get("type") != "null"]
        return _plain(known[0], defs) if len(known) == 1 else None
    if "enum" in node:
        return {"type": "string", "description": ", ".join(node["enum"])}
    kind = node.get("type")
    if kind == "array":
        parts = node.get("prefixItems") or ([node["items"]] if isinstance(node.get("items"), dict) else [])
        item = _plain(parts[0], defs) if parts else {"type": "number"}
        return None if item is None or item["type"] == "array" else {"type": "array", "items": item}
    if kind == "object":
        fields = {name: _plain(child, defs) for name, child in node.get("properties", {}).items()}
        shown = {name: child for name, child in fields.items() if child is not None}
        return {"type": "object", "title": node.get("title", ""), "properties": shown}
    return {"type": kind}
