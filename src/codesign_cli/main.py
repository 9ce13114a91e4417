"""Entry point of the `codesign` command."""

import typer

from codesign_cli import control, sim

app = typer.Typer(
    help="End-effector co-design: simulate, control, record and report fragile-object grasps.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
)
app.add_typer(sim.app, name="sim")
app.add_typer(control.app, name="control")
