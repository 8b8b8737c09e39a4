"""`terrafix models export`: graphs of this program itself, which need no weights; `terrafix models build`: TensorRT
engines, before the flight, on the computer that will fly."""

import typer

from terrafix.core.errors import ModelError, OutputError
from terrafix_engines import gpu, providers
from terrafix_engines.correlation import export
from terrafix_engines.store import models_folder
from terrafix_tools.models.known import as_model_errors, fetched_models
from terrafix_tools.models.listing import open_complete


def build_all(names: list[str], folder: str) -> None:
    """Raises ModelError when TensorRT is not available or an engine cannot be built."""
    models = fetched_models(names, folder)
    try:
        providers.check(providers.TENSORRT)
    except providers.UnavailableError as error:
        raise ModelError(f"TensorRT cannot be used here: {error}; nothing was built") from None
    typer.echo(f"{gpu.gpu_name()}, TensorRT {gpu.tensorrt_version()}")
    for model in models:
        m = model.manifest
        if not m.presets:
            typer.echo(f"{m.name}: has no preset, no TensorRT engine possible")
            continue
        typer.echo(f"{m.name}: {len(m.presets)} engines; minutes each, unless already built")
        with as_model_errors():
            opened = open_complete(model, build=True)
        if opened.provider != providers.TENSORRT:
            raise ModelError(
                f"{m.name}: no engine ({opened.rejected_providers[0]}); it would be run by {opened.provider}"
            )
        typer.echo(f"{m.name}: ready in {model.engines / opened.sha256[:16]}")


def export_correlation(folder: str, *, fp16: bool) -> None:
    """Raises OutputError when the models folder cannot be written."""
    where = models_folder(folder)
    try:
        paths = export(where, fp16)
    except OSError as error:
        raise OutputError(f"{where}: cannot be written ({error.strerror}); choose another --folder") from None
    for path in paths:
        typer.echo(f"written to {path}")
