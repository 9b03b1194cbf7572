"""The command that serves the workbench: inspect."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from levkas.cli.output import (
    CampaignPath,
    DatabasePath,
    refusing,
)

if TYPE_CHECKING:
    from levkas.workbench.server.app import Address


@refusing("inspect")
def inspect(
    campaign: CampaignPath,
    output: DatabasePath = None,
    port: Annotated[
        int, typer.Option(help="Port on this machine; 0 uses any free port.", min=0, max=65535)
    ] = 0,
    no_open: Annotated[
        bool, typer.Option("--no-open", help="Print the address without opening a browser.")
    ] = False,
) -> None:
    """Inspect and correct the registration on screen; corrections are saved in edits.toml.

    Only this machine can open the page. From another one: ssh -L PORT:127.0.0.1:PORT.
    """
    from levkas.workbench.server.app import serve

    def print_address(address: Address) -> None:
        typer.echo(f"The workbench is at {address.url}")
        typer.echo(
            f"From another machine: ssh -L {address.port}:127.0.0.1:{address.port} …, then open "
            "the same address. Press Ctrl-C to stop."
        )

    serve(campaign, output=output, port=port, browse=not no_open, announce=print_address)
    typer.echo("Stopped. Corrections are in edits.toml; `levkas build` applies them.")
