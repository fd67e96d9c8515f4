"""How much larger must an effect be for the diagnosis than for an oracle that knows which it is, and all variances?

Usage: python bench/power_oracle.py [--held-out] [--draws N] [--effects A,B]

The oracle makes one test at the level of an alarm: χ² over all numbers of the true effect, beside an unknown hand-eye,
under the scatter and noise that the draws really have. Draws are those of bench/unknown_laws.py: poses and points by
data_synth's own laws. Each is of an effect at a multiple of what the oracle detects in eight draws of ten; counted is
what is not called adequate. Some 40 minutes.
"""

import argparse
import time
from dataclasses import replace

import numpy as np
from blind_cells import candidate_of, drawn
from blind_trials import LIBRARY
from ordinary_cells import SCATTER
from scipy.optimize import brentq, isotonic_regression
from scipy.stats import chi2, ncx2
from unknown_cells import Asked, World, asked, seen

from data_synth import nature
from stitch.diagnosis.candidates import Form
from stitch.diagnosis.evidence import gather_evidence
from stitch.diagnosis.score import ScatterLimit
from stitch.diagnosis.thresholds import ALPHA_NAME, IMPLAUSIBLE, POWER
from stitch.effects import EFFECTS
from stitch.effects.contract import missing_need
from stitch.numerics.reml import at_variances
from stitch.observations.linear_model import LinearModel
from stitch.system.threads import library_threads_off

SCENES = ("blade", "drill-plate", "blade-table")
DEVELOPMENT, HELD_OUT = (0, 1), (848, 849)
MULTIPLES = (1.0, 1.5, 2.0, 3.0)
# A number of an effect counts if the views show it at its plausible size as more than a tenth of a sigma.
_SEEN = 0.1


def known(a: Asked) -> LinearModel:
    """The views under the scatter and the noise that they have in truth."""
    variances = np.array([SCATTER[0] ** 2, SCATTER[3] ** 2, a.cell.noise_factor])
    mixed = replace(a.linear.mixed, components=a.linear.mixed.components[:3], further=None)
    return replace(a.linear, mixed=mixed, null=at_variances(mixed, variances), pose_errors=None)


def least(a: Asked, effect: str, true: dict[str, float]) -> float | None:
    """Factor on the parameters `true` that the oracle detects in eight draws of ten; None where a cell cannot."""
    if (
        missing_need(a.cell.measurement, EFFECTS[effect])
        or (candidate := candidate_of(a.linear, EFFECTS[effect])) is None
    ):
        return None
    values = np.array([true.get(p.name, 0.0) for p in candidate.parameters])
    fitted = np.array([not p.grid for p in candidate.parameters])
    whole = [form for form in candidate.forms if form.keep.sum() == fitted.sum()]

    def off(form: Form) -> float:
        return float(np.abs(form.term.values - values)[~fitted].sum())

    form = min(whole, key=off)
    white = known(a).residual(form.columns)
    rank = int((np.linalg.svd(white * form.sizes, compute_uv=False) > _SEEN).sum())
    length = float(np.linalg.norm(white @ values[form.keep]))
    if rank == 0 or length == 0:
        return None
    limit = float(chi2.isf(ALPHA_NAME, rank))
    return float(np.sqrt(brentq(lambda shift: ncx2.sf(limit, rank, shift) - POWER, 1e-3, 1e3))) / length


def found(a: Asked, effect: str, multiple: float, k: int) -> bool | None:
    """Whether something is said to be missing in one draw; None where the cell cannot have or show the effect."""
    rng = np.random.default_rng([a.cell.seed, k, LIBRARY.index(effect), int(100 * multiple)])
    # The same effect at every multiple.
    chance = [a.cell.seed, k, LIBRARY.index(effect)]
    chance_of_law = int(np.random.default_rng(chance).integers(1 << 30))
    true = drawn(a.cell.scene, a.cell.plan, a.cell.measurement, [effect], chance_of_law)[effect]
    size = least(a, effect, true) if true else None
    if size is None:
        return None
    laws = nature.draw({effect: multiple * size}, 1.0, a.cell.plan, np.random.default_rng([chance_of_law, 2]))[0]
    linear = seen(a, World(laws), rng)
    return gather_evidence(linear, a.candidates, ScatterLimit(*IMPLAUSIBLE)).verdict != "adequate"


def row(effect: str, cells: list[Asked], draws: int) -> tuple[str, int, float]:
    """Shares found at every multiple, of how many draws, and the multiple at which eight of ten are; ∞ beyond the
    largest."""
    shares, counts = [], []
    for multiple in MULTIPLES:
        told = [found(cells[k % len(cells)], effect, multiple, k) for k in range(draws)]
        hits = [t for t in told if t is not None]
        counts.append(len(hits))
        shares.append(float(np.mean(hits)) if hits else np.nan)
    rising = np.asarray(isotonic_regression(np.array(shares)).x) if min(counts) else np.zeros(len(MULTIPLES))
    ratio = float(np.interp(POWER, rising, MULTIPLES)) if rising[0] < POWER <= rising[-1] else np.inf
    ratio = MULTIPLES[0] if rising[0] >= POWER else ratio
    above, below = np.isinf(ratio), ratio == MULTIPLES[0]
    told = f"above {MULTIPLES[-1]:g}" if above else f"at most {ratio:g}" if below else f"{ratio:.1f}"
    return f"| {effect} | {min(counts)} | {' | '.join(f'{s:.2f}' for s in shares)} | {told} |", min(counts), ratio


def main() -> None:
    """Print the table, row by row, and the mean."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--held-out", action="store_true")
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--effects", default=",".join(LIBRARY))
    options = parser.parse_args()
    seeds = HELD_OUT if options.held_out else DEVELOPMENT
    with library_threads_off():
        cells = [asked(name, seed) for seed in seeds for name in SCENES]
        print(f"| effect | draws | {' | '.join(f'{m:g}×' for m in MULTIPLES)} | ratio at 80 % |")
        print("|---" * (len(MULTIPLES) + 3) + "|")
        ratios = []
        for effect in options.effects.split(","):
            line, count, ratio = row(effect, cells, options.draws)
            if count:
                print(line, flush=True)
                ratios.append(ratio)
    print(f"\nmedian ratio {np.median(ratios):.2f}; {time.process_time():.0f} s of processor time")


if __name__ == "__main__":
    main()
