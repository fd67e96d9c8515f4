"""Twenty sessions on a pool of processes, to a table of pandas."""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import stitch
from data_synth.made_session import make

if __name__ == "__main__":
    sessions = []
    for seed in range(20):
        cell = make("blade-table", {}, seed=seed, views=5)  # simulated cells, in place of yours
        clouds, name = [cloud.points for cloud in cell.clouds], f"cell-{seed}"
        sessions.append(stitch.Session.from_arrays(clouds, cell.T_base_flange, mount="eye_in_hand", name=name))
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        table = stitch.batch(sessions, pool).to_pandas()
    print(table[["name", "residual_um", "U_mm", "U_mrad", "error"]])
