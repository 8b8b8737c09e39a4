"""From images to weights: python -m terrafix_lab.train PLACES.toml --folder DATA --out OUT [--minutes 60]

The same command resumes an interrupted run. OUT then contains NAME.onnx with its manifest NAME.toml, log.csv, and the
checkpoint. The evaluation on held-out places stops the training; docs/training.md describes how to judge the
weights."""

import argparse
import sys
from pathlib import Path

import typer

try:
    import torch
except ModuleNotFoundError:
    sys.exit("training needs PyTorch; install it: pip install 'terrafix[train]'")

from terrafix_lab.train.errors import TrainingError
from terrafix_lab.train.export import ManifestText, export
from terrafix_lab.train.ground import inputs_of, read_list, read_places
from terrafix_lab.train.loop import Progress, Recipe, Training
from terrafix_lab.train.views import ImageStack, to_device


def main() -> None:
    args = arguments()
    try:
        train(args)
    except TrainingError as error:
        sys.exit(f"{error}")


def train(args: argparse.Namespace) -> None:
    """Trains and exports. Raises TrainingError."""
    places = read_list(args.places)
    device = args.device or ("cuda" if torch.cuda.is_available() else "cpu")
    trained, held_out = (
        to_device(read_places([place for place in places if place.held_out is apart], args.folder), device)
        for apart in (False, True)
    )
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrainingError(f"{args.out}: cannot be made ({error.strerror}); choose another --out") from None
    recipe = Recipe(args.steps, args.batch, args.width, args.seed, _names(trained), _names(held_out))
    training = Training(recipe, trained, held_out, args.out / "checkpoint.pt", device)
    typer.echo(f"trained on {', '.join(recipe.trained_on)}; held out {', '.join(recipe.held_out)}; on {device}")
    if training.step:
        typer.echo(f"resumes after step {training.step}")
    with (args.out / "log.csv").open("a", encoding="utf-8", buffering=1) as log:
        for progress in training.run(60.0 * args.minutes):
            typer.echo(line(progress, recipe.steps))
            log.write(row(progress))
    text_fields = ManifestText(
        args.name, f"trained on {', '.join(recipe.trained_on)}; step {training.step}", inputs_of(places, args.folder)
    )
    path = export(training.best_network(), args.out, text_fields)
    typer.echo(f"written to {path}, with its manifest; judge it: docs/training.md")
    if not training.is_over:
        typer.echo(f"{recipe.steps - training.step} of {recipe.steps} steps are left: the same command resumes")


def line(progress: Progress, steps: int) -> str:
    pace = f"  {progress.steps_per_s:.2f} steps/s" if progress.steps_per_s else ""
    held_out = "" if progress.held_out_nats is None else f"  held out: {progress.held_out_nats:.3f} nats"
    return f"{progress.step}/{steps}  {progress.nats:.3f} nats{pace}{held_out}"


def row(progress: Progress) -> str:
    """A row of log.csv: step, loss, loss on the held-out places."""
    held_out = "" if progress.held_out_nats is None else f"{progress.held_out_nats:.4f}"
    return f"{progress.step},{progress.nats:.4f},{held_out}\n"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="terrafix_lab.train", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("places", type=Path, metavar="PLACES.toml", help="list of places with their images")
    parser.add_argument("--folder", type=Path, default=Path(), help="base of the image paths")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--name", default="ours", help="of the model: lower case, digits, . - _")
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after this time; the same command resumes")
    parser.add_argument("--steps", type=int, default=20_000, help="of the whole training, over all runs")
    parser.add_argument("--batch", type=int, default=8, help="pairs of views a step")
    parser.add_argument("--width", type=int, default=32, help="channels at a quarter of the image resolution")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", default="", help="cuda or cpu; default: cuda if available")
    return parser.parse_args()


def _names(stacks: list[ImageStack]) -> tuple[str, ...]:
    return tuple(sorted({stack.name for stack in stacks}))


if __name__ == "__main__":
    main()
