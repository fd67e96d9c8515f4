"""What `stitch calibrate` says: a hand-eye with its sigmas, the rows of an arm, poses to add."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from stitch.cli.terminal.ledger_summary import show_ledger
from stitch.runs.run import Run
from stitch.system.console import console


def show_robot(result: Run, document: dict[str, Any], lines: list[str], target: Path) -> None:
    """The way, the history, the rows, the poses to add."""
    terminal = console()
    for line in lines:
        terminal.print(line, soft_wrap=True)
    show_ledger(result)
    corrected = document["table"]["effects"]
    table = Table(title="Corrected DH rows" if corrected else "Nominal DH rows", title_justify="left")
    for heading in ("joint", "a", "alpha (°)", "d", "theta (°)"):
        table.add_column(heading, justify="right")
    for i, row in enumerate(document["robot"] or ()):
        table.add_row(str(i + 1), *(f"{row[key]:.5f}" for key in ("a", "alpha_deg", "d", "theta_deg")))
    if document["robot"]:
        terminal.print(table)
    for line in document["table"]["sentences"]:
        terminal.print(line, soft_wrap=True)
    for pose in document["next"]:
        told = ", ".join(f"j{i + 1} {x:.0f}°" for i, x in enumerate(pose))
        terminal.print(f"A pose that would tell most of the rest: {told}.", soft_wrap=True)
    for name in ("model.toml", "robot.toml", "robot.urdf", "report.html"):
        if (target / name).exists():
            terminal.print(f"  {target / name}", soft_wrap=True)


def show_hand_eye(document: dict[str, Any], facts: list[tuple[str, str]]) -> None:
    """The hand-eye with its sigmas, more facts, and the notes, for people."""
    terminal, unit = console(), document["length_unit"]
    mount = "flange" if document["mount"] == "eye_in_hand" else "base"
    table = Table(title=f"{document['session']}: T_{mount}_scanner", title_justify="left", show_header=False)
    for name, text in [*hand_eye_rows(document, unit), *facts]:
        table.add_row(name, text)
    terminal.print(table)
    for note in document["notes"]:
        terminal.print(f"{note}.", soft_wrap=True)


def hand_eye_rows(document: dict[str, Any], unit: str) -> list[tuple[str, str]]:
    """Translation in the mount's axes, rotation matrix, sigmas in both frames."""
    T = np.array(document["hand_eye"])
    sigma = np.array(document["hand_eye_sigma"])
    return [
        (
            "translation",
            f"{length_row(T[:3, 3], unit)} ± {length_row(document['translation_sigma_mount'], unit)} {unit}",
        ),
        ("rotation", "\n".join(" ".join(f"{x:+.6f}" for x in row) for row in T[:3, :3])),
        ("sigma of rotation", f"{', '.join(f'{1e3 * x:.2g}' for x in sigma[:3])} mrad about scanner x, y, z"),
        ("sigma of translation", f"{length_row(sigma[3:], unit)} {unit} along scanner x, y, z"),
    ]


def length_row(values: Any, unit: str = "mm") -> str:
    """Lengths to a micrometre."""
    digits = 6 if unit == "m" else 3
    return ", ".join(f"{x:.{digits}f}" for x in values)
