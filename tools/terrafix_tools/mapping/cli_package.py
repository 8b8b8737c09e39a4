"""The commands `terrafix map info|check|preview|sign|keygen` for existing packages."""

import getpass
from pathlib import Path
from typing import Annotated

import typer

PackageArgument = Annotated[Path, typer.Argument(help="Map package.")]
MissionOption = Annotated[
    Path | None, typer.Option(help="QGroundControl plan or waypoint file that is to be flown over the map.")
]
CameraOption = Annotated[Path | None, typer.Option(help="Camera description (config/cameras) or flight.toml.")]
AglOption = Annotated[
    float | None,
    typer.Option(min=1.0, max=5000.0, help="Height above ground, metres. Default: the mission's, else 100."),
]
LayerOption = Annotated[str | None, typer.Option(help="Layer of the package. Default: the newest.")]


def info(package: PackageArgument) -> None:
    """Verify every tile, then print the contents of a map package as JSON."""
    from terrafix_tools.mapping.check.preview import info

    info(package)


def check(
    package: PackageArgument,
    mission: MissionOption = None,
    camera: CameraOption = None,
    agl: AglOption = None,
    layer: LayerOption = None,
    picture: Annotated[
        Path | None, typer.Option(help="PNG, or HTML page, to write: where on the map frames are placed alone.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Suitability of a map: coverage, resolution, age, share of frames that are placed alone. Fails when the mission
    leaves the map."""
    from terrafix_tools.mapping.check.preview import print_check

    print_check(package, mission, camera, agl, layer, picture, as_json=as_json)


def preview(
    package: PackageArgument,
    out: Annotated[Path, typer.Option(help="PNG to write.")] = Path("preview.png"),
    size: Annotated[int, typer.Option(min=64, max=8192, help="Longer side, pixels.")] = 1024,
    layer: LayerOption = None,
) -> None:
    """The whole map, north up; transparent where it has no imagery."""
    from terrafix_tools.mapping.check.preview import preview

    preview(package, out, size, layer)


def keygen(
    out: Annotated[Path, typer.Option(help="Name of the two files without suffix: OUT.key and OUT.pub.")],
    owner: Annotated[str, typer.Option(help="Owner of the key; a comment in OUT.pub.")] = "",
) -> None:
    """Generate a key pair for signing map packages. Keep OUT.key secret; vehicles get OUT.pub."""
    from terrafix.core.signature import generate

    private, public = out.with_name(f"{out.name}.key"), out.with_name(f"{out.name}.pub")
    key = generate(private, public, owner or getpass.getuser())
    typer.echo(f"{private} (secret) and {public}: key {key.key_id}")


def sign(
    package: PackageArgument, key: Annotated[Path, typer.Option(help="Private key of `terrafix map keygen`.")]
) -> None:
    """Verify every tile, then sign a map package."""
    from terrafix_tools.mapping.package.sign import sign_package

    typer.echo(f"{package}: signed by key {sign_package(package, key).key_id}")


def index(
    packages: Annotated[list[Path], typer.Argument(help="Map packages, all into one index.")],
    *,
    out: Annotated[Path, typer.Option(help="Folder to write.")],
    agl: Annotated[float, typer.Option(min=30.0, max=5000.0, help="Height of the flights above ground, metres.")],
    descriptor: Annotated[
        str, typer.Option(help="pooled-gradient, or a fetched model: xfeat, or one with the role global.")
    ] = "pooled-gradient",
    folder: Annotated[str, typer.Option(help="Models folder.")] = "",
    faiss: Annotated[
        bool, typer.Option("--faiss", help="Make the FAISS index of a small map, too; needs terrafix[faiss].")
    ] = False,
) -> None:
    """Place index for the search of large maps: descriptors of the ground, and FAISS's index over them."""
    from terrafix_tools.mapping.place_index import IndexOptions, write_index

    header = write_index(packages, out, IndexOptions(agl, descriptor, folder, faiss))
    size_mb = sum(file.size_bytes for file in header.files.values()) / 1e6
    typer.echo(f"{out}: {header.count} places of {header.side_m:.0f} m, {size_mb:.0f} MB, by {header.descriptor}")
