"""`terrafix models build`: engines of TensorRT, on the computer that will fly, before it flies."""

import typer

from terrafix.core.errors import ModelError
from terrafix_engines import gpu, providers
from terrafix_tools.models.known import fetched, plain_errors
from terrafix_tools.models.listing import opened_whole


def build_all(names: list[str], folder: str) -> None:
    """Raises ModelError when there is no TensorRT, or an engine cannot be built."""
    models = fetched(names, folder)
    try:
        providers.check(providers.TENSORRT)
    except providers.UnavailableError as error:
        raise ModelError(f"TensorRT cannot be used here: {error}; nothing was built") from None
    typer.echo(f"{gpu.gpu_name()}, TensorRT {gpu.tensorrt_version()}")
    for model in models:
        m = model.manifest
        if not m.presets:
            typer.echo(f"{m.name}: has no preset, TensorRT is not for it")
            continue
        typer.echo(f"{m.name}: {len(m.presets)} engines; minutes each, unless they are there")
        with plain_errors():
            opened = opened_whole(model, build=True)
        if opened.provider != providers.TENSORRT:
            raise ModelError(f"{m.name}: no engine ({opened.passed_over[0]}); it would be run by {opened.provider}")
        typer.echo(f"{m.name}: ready in {model.engines / opened.sha256[:16]}")
