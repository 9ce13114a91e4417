"""Reads what `codesign design build` is given, and prints its report."""

from __future__ import annotations

from pathlib import Path

import typer

from codesign_design.build import BuiltFinger, build_finger
from codesign_design.design_file import read_parameters, read_surface, write_text
from codesign_design.printability import PrintReport


def build_from_file(source: Path, unit: str, name: str, poisson: bool = False) -> BuiltFinger:
    """A finger from design parameters (.json) or from a surface file.

    Raises:
        ValueError: not such a file, or no solid in it.
        OSError: cannot be read.
    """
    if source.suffix == ".json":
        space, parameters = read_parameters(source)
        surface, cage, design = space.surface(parameters), space.name, parameters.tolist()
    else:
        surface, cage, design = read_surface(source, unit), "", []
    return build_finger(surface, name, cage, design, poisson=poisson)


def write_page(folder: Path, built: BuiltFinger) -> None:
    """Writes report.html, the report with pictures."""
    from codesign_report.finger_report import finger_page

    left = built.pair.left
    page = finger_page(built.report.as_dict(), left.vertices, left.faces)
    write_text(folder / "report.html", page)


def print_report(report: PrintReport, folder: Path, as_json: bool) -> None:
    """The report as JSON, or a table of what matters with the verdict below."""
    if as_json:
        typer.echo(report.to_json())
        return
    from rich.console import Console
    from rich.table import Table

    mesh, printing, gripper = report.mesh, report.printing, report.gripper
    rows = {
        "faces": f"{mesh.faces:,}",
        "volume": f"{mesh.volume * 1e6:.2f} cm^3",
        "through-holes": str(mesh.genus),
        "wall, thinnest 1 % / median": (
            f"{printing.wall_p1 * 1e3:.2f} / {printing.wall_median * 1e3:.2f} mm"
        ),
        "undersides to support": f"{printing.overhang_area * 1e6:.0f} mm^2",
        "screw holes": " and ".join(f"{d:.2f} mm" for d in report.mount.hole_diameters),
        "opening": f"{gripper.min_width * 1e3:.1f}..{gripper.max_width * 1e3:.1f} mm",
        "contact angle": f"{gripper.contact_angle * 57.29578:.1f} degrees",
        "remeshed": "yes" if report.deviation.remeshed else "no",
        "cut off behind the mount": f"{report.deviation.cut * 1e3:.1f} mm",
    }
    table = Table("", report.name, title="Finger pair")
    for key, value in rows.items():
        table.add_row(key, value)
    console = Console()
    console.print(table)
    for problem in report.problems:
        console.print(f"[red]✗[/] {problem}", soft_wrap=True)
    for advice in report.printing.advice:
        console.print(f"[yellow]![/] {advice}", soft_wrap=True)
    verdict = "[green]valid[/]" if report.valid else "[bold red]not usable[/]"
    console.print(f"{verdict}, files in {folder}", soft_wrap=True)
