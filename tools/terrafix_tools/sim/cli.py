"""`terrafix sim`: the world to fly in. Every command imports what it needs when it is called."""

import typer

app = typer.Typer(
    no_args_is_help=True, help="Simulated flights: generated or real ground, vehicle, sensors, autopilot."
)
