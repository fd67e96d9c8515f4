"""Register beside Open3D and small_gicp on 40 simulated cells: the table of other libraries in docs/register.md.

Usage: python bench/register_peers.py [--cells N] [--keep FILE] [--write]

Needs small_gicp beside Open3D (`pip install small_gicp`). The cells are those of `register_weights.py` with seeds of
their own (4800 …), run once. The libraries begin at the same poses and take the same points; pairs are aligned one by
one and joined by a graph of poses, with the settings of `peer_programs.py` but for the distance between partners: 0.4
mm from the start, the best of six settings on two cells of development. They know no prior of the robot.
"""

import argparse
from pathlib import Path
from typing import Any

from peer_programs import open3d_edges, optimised, small_gicp_edges
from register_cells import cell_of
from register_weights import collected, pose_error, table, write
from weighings import CLOSED, DPWVM_STYLE, METHODS

from stitch.fusion.register import register

FIRST = 4800
BEGIN, END = "<!-- peers: begin -->", "<!-- peers: end -->"
DISTANCES = (0.4,)  # mm
PEERS = {"Open3D, robust point to plane": open3d_edges, "small_gicp": small_gicp_edges}


def numbers_of(kind: str, seed: int) -> dict[str, Any]:
    """Pose errors of one cell by both methods of register and by the libraries."""
    cell = cell_of(kind, seed)
    errors = {"robot and hand-eye alone": pose_error(cell, cell.model_poses)}
    for name in (CLOSED, DPWVM_STYLE):
        found = register(
            cell.capture, cell.model_poses, cell.scatter, cell.gate, start=cell.start, method=METHODS[name]
        )
        errors[name] = pose_error(cell, found.poses)
    clouds = [scan.points for scan in cell.capture.scans]
    for name, edges in PEERS.items():
        errors[name] = pose_error(cell, optimised(cell.start, edges(clouds, cell.start, DISTANCES)))
    return {"errors": errors}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=8, help="of each of the five kinds")
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    lines = table(collected(FIRST, options.cells, options.keep, numbers_of))
    print("\n".join(lines))
    if options.write:
        write(lines, BEGIN, END)


if __name__ == "__main__":
    main()
