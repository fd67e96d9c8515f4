"""Figures and pages of the cells, from the jobs in examples/: writes docs/pictures/*.png and cell-*.webp.

Run: python -m bench.docs.cell_pictures. The pages need a Chromium on the path.
"""

import tempfile
from pathlib import Path

from matplotlib.figure import Figure

from bench.docs.report_pictures import call, shot
from stitch.plugins.cells.base_to_base import read_stand, solve_stand
from stitch.plugins.cells.drilling import read_drill_job as read_drilling
from stitch.plugins.cells.drilling import solve_drill_job as solve_drilling
from stitch.plugins.cells.panel import read_panel_job as read_panel
from stitch.plugins.cells.panel import solve_panel_job as solve_panel
from stitch.plugins.cells.window import read_seam_job, solve_seam
from viz.cells import base_to_base, window_seam
from viz.cells.drilling import holes
from viz.cells.panel import shape

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES, PICTURES = ROOT / "examples", ROOT / "docs" / "pictures"


def figures() -> dict[str, Figure]:
    """By the picture's name."""
    stand, drilling = read_stand(EXAMPLES / "base_to_base.toml"), read_drilling(EXAMPLES / "drilling" / "job.toml")
    panel, seam = read_panel(EXAMPLES / "panel" / "job.toml"), read_seam_job(EXAMPLES / "window" / "seam.toml")
    return {
        "base-to-base": base_to_base.plan(stand, solve_stand(stand)),
        "drilling": holes(drilling, solve_drilling(drilling)),
        "panel-clamps": shape(panel, solve_panel(panel)),
        "window-seam": window_seam.cuts(seam, solve_seam(seam)),
    }


def pages() -> None:
    """The top of every cell's page, half as large as it is shown."""
    jobs = {"base": "base_to_base.toml", "drill": "drilling/job.toml", "panel": "panel/job.toml"}
    jobs |= {"fit": "window/fit.toml", "seam": "window/seam.toml"}
    with tempfile.TemporaryDirectory() as folder:
        for command, job in jobs.items():
            page = Path(folder) / f"{command}.html"
            call([command, EXAMPLES / job, "--report", page])
            path = PICTURES / f"cell-{command}.webp"
            shot(page, 1000, 1000).reduce(2).save(path, quality=90, method=6)
            print(path)


def main() -> None:
    pages()
    for name, figure in figures().items():
        figure.savefig(PICTURES / f"{name}.png", dpi=95)
        print(PICTURES / f"{name}.png")


if __name__ == "__main__":
    main()
