"""docs/openapi.json, made from the routes and the models of the events: python -m terrafix_tools.console.openapi."""

import json
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from terrafix_tools.console.events import EVENTS
from terrafix_tools.console.routes import router

FILE = Path(__file__).resolve().parents[3] / "docs" / "openapi.json"
VERSION = "1"  # of the interface


def schema() -> dict[str, Any]:
    """The OpenAPI description. The models of the events are among its schemas, which no route names."""
    app = FastAPI(title="Terrafix console", version=VERSION)
    app.include_router(router)
    described = app.openapi()
    template = "#/components/schemas/{model}"
    _, events = models_json_schema([(kind, "serialization") for kind in EVENTS], ref_template=template)
    for name, model in events["$defs"].items():
        described["components"]["schemas"].setdefault(name, model)
    return described


def text() -> str:
    return json.dumps(schema(), indent=1, ensure_ascii=False, sort_keys=True) + "\n"


if __name__ == "__main__":
    FILE.write_text(text(), encoding="utf-8")
