"""From pictures to weights that fly: python -m terrafix_engines.train PLACES.toml --folder DATA --out OUT [--minutes 9]

The same command goes on where the last one ended. OUT then holds NAME.onnx with its manifest NAME.toml, log.csv, and
the checkpoint. What it says of places held out is a first look; docs/training.md says how to judge the weights."""

import argparse
import sys
from pathlib import Path

import typer

try:
    import torch
except ModuleNotFoundError:
    sys.exit("training needs PyTorch; install it: pip install 'terrafix[train]'")

from terrafix_engines.train.errors import TrainingError
from terrafix_engines.train.export import Words, export
from terrafix_engines.train.ground import read_list, read_places
from terrafix_engines.train.loop import Recipe, Said, Training
from terrafix_engines.train.losses import WEIGHTS
from terrafix_engines.train.views import Sheet, spread_out

UNSTATED = "not stated; the licences of the pictures it was trained on apply"


def main() -> None:
    given = arguments()
    try:
        train(given)
    except TrainingError as error:
        sys.exit(f"{error}")


def train(given: argparse.Namespace) -> None:
    """Raises TrainingError."""
    places = read_list(given.places)
    device = given.device or ("cuda" if torch.cuda.is_available() else "cpu")
    trained, held_out = (
        spread_out(read_places([place for place in places if place.held_out is apart], given.folder), device)
        for apart in (False, True)
    )
    try:
        given.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrainingError(f"{given.out}: cannot be made ({error.strerror}); choose another --out") from None
    recipe = Recipe(given.steps, given.batch, given.width, given.seed, _names(trained), _names(held_out))
    training = Training(recipe, trained, held_out, given.out / "checkpoint.pt", device)
    typer.echo(f"trained on {', '.join(recipe.trained_on)}; held out {', '.join(recipe.held_out)}; on {device}")
    if training.step:
        typer.echo(f"goes on after step {training.step}")
    with (given.out / "log.csv").open("a", encoding="utf-8", buffering=1) as log:
        for said in training.run(60.0 * given.minutes):
            typer.echo(line(said, recipe.steps))
            log.write(row(said))
    words = Words(given.name, given.licence, f"trained on {', '.join(recipe.trained_on)}; step {training.step}")
    path = export(training.network, given.out, words)
    typer.echo(f"written to {path}, with its manifest; judge it: docs/training.md")
    if training.step < recipe.steps:
        typer.echo(f"{recipe.steps - training.step} of {recipe.steps} steps are left: the same command goes on")


def line(said: Said, steps: int) -> str:
    losses = "  ".join(f"{name} {value:.2f}" for name, value in said.losses.items())
    pace = f"  {said.steps_per_s:.1f} steps/s" if said.steps_per_s else ""
    return f"{said.step}/{steps}  {losses}{pace}" + (f"  {said.measured}" if said.measured else "")


def row(said: Said) -> str:
    """Of log.csv: step, the losses in the order of WEIGHTS, places found, tiles found."""
    numbers = [f"{said.losses.get(name, float('nan')):.4f}" for name in WEIGHTS]
    held_out = [f"{said.measured.found:.4f}", f"{said.measured.tiles:.4f}"] if said.measured else ["", ""]
    return ",".join([str(said.step), *numbers, *held_out]) + "\n"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="terrafix_engines.train", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("places", type=Path, metavar="PLACES.toml", help="which pictures show which place")
    parser.add_argument("--folder", type=Path, default=Path(), help="where the paths of the pictures begin")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--name", default="ours", help="of the model: lower case, digits, . - _")
    parser.add_argument("--licence", default=UNSTATED)
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after so long; the same command goes on")
    parser.add_argument("--steps", type=int, default=20_000, help="of the whole training, however often it is stopped")
    parser.add_argument("--batch", type=int, default=32, help="pairs of views a step")
    parser.add_argument("--width", type=int, default=64, help="channels at an eighth of the picture")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", default="", help="cuda or cpu; cuda where there is one")
    return parser.parse_args()


def _names(sheets: list[Sheet]) -> tuple[str, ...]:
    return tuple(sorted({sheet.name for sheet in sheets}))


if __name__ == "__main__":
    main()
