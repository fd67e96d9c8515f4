"""What a motion does to the slaves of a panel cell: expected from the model, and true in simulated cells."""

from dataclasses import replace
from itertools import product

import numpy as np
from panel_ready import MASTER, ready_without_panel

from stitch.numerics import frames
from stitch.plugins.cells.panel_model import errors_along_motion, follow


def drift_table() -> list[str]:
    """Expected and true error of the farthest slave after the source's two motions."""
    lines = [
        "Slaves against the master after the source's motions: rms over 200 draws of the model against what 20 "
        "simulated cells do, worst slave and axis.",
        "",
        "| motion | legs repeat / µm | expected / mm | in the cells / mm | expected / ° | in the cells / ° |",
        "|---|---|---|---|---|---|",
    ]
    motions = (("100 mm", False, 100.0), ("2°", True, np.radians(2.0)))
    for leg, (name, turn, step) in product((0.0, 0.004), motions):
        expected, real = [], []
        for seed in range(20):
            r = ready_without_panel(seed)
            r.cell.sizes = replace(r.cell.sizes, leg=leg)
            r.cell.drive(r.T_base_flange)
            if seed == 0:
                e = errors_along_motion(r.stage.models, r.T_base_flange, MASTER, np.array([step]), turn=turn)
                expected = [e.position.max(), np.degrees(e.angle.max())]
            bases = np.array([m.T_world_base for m in r.stage.models])
            change = np.zeros((3, 6, 6))
            for axis in range(3):
                before = r.cell.clamps()
                motion = np.zeros(6)
                motion[axis if turn else 3 + axis] = step
                T = r.T_base_flange[MASTER].copy()
                T[:3, :3] = frames.exp(motion)[:3, :3] @ T[:3, :3]
                T[:3, 3] += frames.exp(motion)[:3, 3]
                r.cell.drive(follow(bases, r.T_base_flange, MASTER, T))
                after = r.cell.clamps()
                relative = [frames.inverse(c[MASTER]) @ c for c in (before, after)]
                change[axis] = frames.log(frames.inverse(relative[0]) @ relative[1])
                r.cell.drive(r.T_base_flange)
            real.append(change)
        rms = np.sqrt((np.array(real) ** 2).mean(0))
        worst = [np.linalg.norm(part, axis=-1).max() for part in (rms[..., 3:], np.degrees(rms[..., :3]))]
        numbers = f"{expected[0]:.3f} | {worst[0]:.3f} | {expected[1]:.4f} | {worst[1]:.4f}"
        lines.append(f"| {name} | {leg * 1e3:g} | {numbers} |")
    return lines
