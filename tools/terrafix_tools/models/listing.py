"""`terrafix models list` and `terrafix models verify`."""

import json
from typing import Any

import typer
from rich.console import Console
from rich.table import Table

from terrafix.core.errors import ModelError
from terrafix_engines import providers
from terrafix_engines.runtime import Model, ModelFileError
from terrafix_engines.store import State, StoredModel, models_folder
from terrafix_tools.models.known import fetched_models, select_models, state_of


def show(folder: str, *, as_json: bool) -> None:
    """Prints every known model. Raises ModelError."""
    models = [(model, state_of(model)) for model in select_models([], folder)]
    if as_json:
        rows = [_row(model, state) for model, state in models]
        typer.echo(
            json.dumps({"folder": str(models_folder(folder)), "providers": provider_errors(), "models": rows}, indent=2)
        )
        return
    table = Table()
    for title in ("name", "what", "state", "MB", "licence"):
        table.add_column(title, justify="right" if title == "MB" else "left")
    for model, state in models:
        m = model.manifest
        table.add_row(m.name, m.title, state.value, f"{m.size_bytes / 1e6:.1f}", m.licence)
    console = Console()
    console.print(table)
    console.print(f"folder: {models_folder(folder)}", highlight=False, soft_wrap=True)
    for provider, reason in provider_errors().items():
        console.print(f"{provider}: {reason or 'can be used'}", highlight=False, soft_wrap=True)


def provider_errors() -> dict[str, str]:
    """Returns provider -> reason why it is not available; empty: available."""
    found = {}
    for provider in providers.PREFERENCE:
        try:
            providers.check(provider)
            found[providers.short_name(provider)] = ""
        except providers.UnavailableError as error:
            found[providers.short_name(provider)] = str(error)
    return found


def verify_all(names: list[str], folder: str) -> None:
    """Prints a line for each model. Raises ModelError when one of them cannot be used."""
    models = fetched_models(names, folder)
    bad = 0
    for model in models:
        try:
            opened = open_complete(model)
        except ModelFileError as error:
            bad += 1
            typer.echo(f"{model.manifest.name}: {error}")
            continue
        rejected = "".join(f"; not run by {one}" for one in opened.rejected_providers)
        typer.echo(f"{model.manifest.name}: as published, run by {providers.short_name(opened.provider)}{rejected}")
    if bad:
        raise ModelError(f"{bad} of {len(models)} models cannot be used")


def open_complete(model: StoredModel, *, prefer: tuple[str, ...] = providers.PREFERENCE, build: bool = False) -> Model:
    """Opens the model with all inputs and outputs of its manifest. Raises ModelFileError."""
    inputs = tuple(tensor.name for tensor in model.manifest.inputs)
    outputs = tuple(tensor.name for tensor in model.manifest.outputs)
    return model.open(inputs, outputs, prefer=prefer, build=build)


def _row(model: StoredModel, state: State) -> dict[str, Any]:
    listed = ("name", "title", "role", "size_bytes", "sha256", "licence", "credit", "source")
    return {key: getattr(model.manifest, key) for key in listed} | {"state": state.value, "path": str(model.path)}
