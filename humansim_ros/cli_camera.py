"""The ``humansim camera`` commands: what is in a calibration file, and the same cameras in another form."""

from __future__ import annotations

import typer

app = typer.Typer(help="Look at calibrations, convert them, make rigs of cameras.", no_args_is_help=True)


@app.callback()
def _cameras() -> None:
    """Without this, an app of one command would have no names of commands."""
