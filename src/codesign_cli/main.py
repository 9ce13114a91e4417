"""Entry point of the `codesign` command."""

import typer

from codesign_cli import (
    bag,
    control,
    demo,
    design,
    graph,
    perception,
    policy,
    report,
    reproduce,
    sim,
)

app = typer.Typer(
    help="End-effector co-design: simulate, control, record and report fragile-object grasps.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
)
app.command()(demo.demo)
app.command()(report.report)
app.add_typer(bag.app, name="bag")
app.add_typer(control.app, name="control")
app.add_typer(design.app, name="design")
app.add_typer(graph.app, name="graph")
app.add_typer(perception.app, name="perception")
app.add_typer(policy.app, name="policy")
app.add_typer(reproduce.app, name="reproduce")
app.add_typer(sim.app, name="sim")
