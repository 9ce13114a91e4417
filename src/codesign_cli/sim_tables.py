"""Tables of `codesign sim`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from codesign_sim.bench import Result
    from codesign_sim.object_report import ObjectReport
    from codesign_sim.pads import Parameter
    from codesign_sim.sensitivity import StressGradient
    from codesign_sim.validation import Check


def print_checks(checks: list[Check]) -> None:
    """Expected beside measured, and how many passed."""
    table = Table("case", "expected", "measured", "tolerance", "unit", "verdict")
    for column in table.columns[1:4]:
        column.justify = "right"
    for check in checks:
        verdict = "[green]passed[/]" if check.passed else "[bold red]FAILED[/]"
        table.add_row(
            check.name,
            f"{'>= ' if check.at_least else ''}{check.expected:.5g}",
            f"{check.measured:.5g}",
            f"{check.tolerance:.2g}",
            check.unit,
            verdict,
        )
    console = Console()
    console.print(table)
    failed = sum(not check.passed for check in checks)
    console.print(f"{len(checks) - failed} of {len(checks)} passed")


def print_rates(
    results: Sequence[Result], machine: dict[str, object], ratios: dict[int, float]
) -> None:
    """Rates by case, the machine, and the ratio to the peer where there is one."""
    table = Table("solver", "tets", "envs", "procs", "steps/s", "per CPU s", "held", "kB/env")
    for column in table.columns[1:]:
        column.justify = "right"
    for r in results:
        gpu = "" if r.case.device == "cpu" else f" {r.case.device}"
        table.add_row(
            r.case.solver + gpu,
            f"{r.case.tets:,}",
            str(r.case.envs),
            str(r.case.processes),
            f"{r.wall.median:,.0f}",
            f"{r.cpu.median:,.0f} ({r.cpu.least:,.0f}-{r.cpu.greatest:,.0f})",
            "yes" if r.held else "dropped" if r.lifted else "no",
            f"{r.bytes_per_environment / 1e3:,.0f}",
        )
    console = Console()
    console.print(table)
    console.print("envs per process; rates of all processes together, median (min-max)")
    console.print(", ".join(f"{name} {value}" for name, value in machine.items()))
    for tets, ratio in ratios.items():
        console.print(f"{tets:,} tetrahedra: {ratio:.1f} times MuJoCo flex per CPU second")


def print_gradient(parameters: Sequence[Parameter], gradient: StressGradient) -> None:
    """Derivatives per millimetre or degree."""
    table = Table("parameter", "value", "step", "top-10 %", "median", "unit")
    for column in table.columns[1:5]:
        column.justify = "right"
    for k, p in enumerate(parameters):
        table.add_row(
            p.name,
            f"{p.value / p.scale:g} {p.unit}",
            f"{p.step / p.scale:g} {p.unit}",
            f"{gradient.top10_gradient[k] * p.scale:+.1f}",
            f"{gradient.median_gradient[k] * p.scale:+.1f}",
            f"Pa/{p.unit}",
        )
    console = Console()
    console.print(table)
    console.print(
        f"top-10 % {gradient.top10:.0f} Pa, median {gradient.median:.0f} Pa; "
        f"{gradient.lanes} lanes, {gradient.cpu_seconds:.1f} s of CPU"
    )


def print_object(report: ObjectReport, notes: Sequence[str]) -> None:
    """A mesh's figures, and what was noticed while reading it."""
    table = Table("figure", "value", "unit")
    table.columns[1].justify = "right"
    for figure, value, unit in (
        ("tetrahedra", f"{report.tetrahedra:,}", ""),
        ("nodes", f"{report.nodes:,}", ""),
        ("surface triangles, closed", f"{report.surface_triangles:,}", ""),
        ("size", " x ".join(f"{1e3 * length:.1f}" for length in report.size), "mm"),
        ("volume", f"{1e6 * report.volume:.3f}", "cm^3"),
        ("mass", f"{1e3 * report.mass:.2f}", "g"),
        ("worst quality (1 is regular)", f"{report.worst_quality:.3f}", ""),
        ("largest over smallest tetrahedron", f"{report.volume_ratio:.1f}", ""),
        ("contact points apart, at most", f"{1e3 * report.contact_spacing:.2f}", "mm"),
        ("time step", f"{1e3 * report.time_step:.3f}", "ms"),
    ):
        table.add_row(figure, value, unit)
    console = Console()
    console.print(table)
    for note in notes:
        console.print(note)
