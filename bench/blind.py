"""Can the diagnosis be trusted? Hidden effects on simulated cells, judged blind.

Usage: python bench/blind.py [--seeds N] [--scenes a,b] [--empties N] [--part effects,empty] [--out FILE]

Sizes are multiples of the smallest detectable size of each effect in each cell, which is computed from the
same cell with nothing hidden. Every share comes with its 95 % Wilson interval.
"""

import argparse
import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from data_synth.nature import LAWS
from data_synth.scene import load_scene
from data_synth.simulate import Measured, simulate
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.diagnose import diagnose
from stitch.diagnosis.start import evidence_of_state
from stitch.effects import EFFECTS
from stitch.errors import StitchError
from stitch.pipeline import run
from stitch.state import state_of
from stitch.threads import library_threads_off

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from in_memory import session_of

OUTSIDE = ("third_harmonic", "knock", "covariate_bias")
MULTIPLES = (0.5, 1.0, 2.0, 4.0)
_FACTOR = 3.86 + 0.84  # z for 0.05 over two sides and about 20 tests, and for power 0.8


def small(scene_name: str, **changes):
    """A scene with fewer points: evidence counts in views."""
    scene = load_scene(scene_name)
    scanner = replace(scene.scanner, columns=170, rows=170)
    return replace(scene, scanner=scanner, **changes)


def sizes(scene_name: str, seed: int, names, **changes) -> dict[str, float]:
    """Amplitude that is detectable at the least, per effect; absent where the cell cannot show it."""
    scene = small(scene_name, **changes)
    measured = simulate(scene, {}, seed)
    state = state_of(run(session_of(measured)))
    evidence = evidence_of_state(state)
    out = {}
    for name in names:
        told = simulate_parameters(scene, name, seed, measured)
        possible = name in EFFECTS and not state.chain.lacks(EFFECTS[name])
        candidate = candidate_of(evidence, EFFECTS[name]) if possible else None
        if candidate is None or not told:
            continue
        # The grid value nearest to the truth.
        form = min(
            (f for f in candidate.forms if f.keep.sum() == candidate.forms[0].keep.sum()),
            key=lambda f: sum(
                abs(v - told.get(p.name, v)) for p, v in zip(candidate.parameters, f.term.values, strict=True) if p.grid
            ),
        )
        theta = np.array([told.get(p.name, 0.0) for p in candidate.parameters])[form.keep]
        strength = float(np.linalg.norm(evidence.whiten_channel(form.columns) @ theta))
        amplitude = _FACTOR / max(strength, 1e-12)
        believable = all(
            abs(t) * 4 * amplitude < p.limit
            for t, p in zip(theta, [p for p, k in zip(candidate.parameters, form.keep, strict=True) if k], strict=True)
        )
        if believable:
            out[name] = amplitude
    return out


def simulate_parameters(scene, name: str, seed: int, measured: Measured) -> dict[str, float]:
    """What nature would draw for an effect of amplitude 1 in this very cell."""
    from data_synth import nature

    _, told = nature.draw({name: 1.0}, 0.0, measured.plan, np.random.default_rng([seed, 2]))
    return told[name]


def trial(job: tuple) -> dict:
    """One session, diagnosed."""
    scene_name, seed, hidden, changes = job
    library_threads_off()
    start = time.perf_counter()
    measured = simulate(small(scene_name, **changes), hidden, seed)
    try:
        result = run(session_of(measured))
        found = diagnose(state_of(result))
    except StitchError as error:
        return {"scene": scene_name, "seed": seed, "hidden": hidden, "verdict": f"no result: {error}", "named": []}
    ranked = [s.name for s in found.suspects if s.ranked.score.observable]
    return {
        "scene": scene_name, "seed": seed, "hidden": hidden, "verdict": found.verdict, "named": list(found.effects),
        "first": ranked[0] if ranked else None,
        "p": min((s.ranked.adjusted for s in found.suspects if s.name in found.effects), default=1.0),
        "follows": [d.covariate for d in found.depends_on[:3] if d.p_value < 0.05],
        "notes": list(found.notes), "scatter": [found.rotation * 1e6, found.translation * 1e3],
        "seconds": time.perf_counter() - start,
    }  # fmt: skip


def wilson(hits: int, count: int) -> str:
    """Share with its 95 % interval."""
    if not count:
        return "–"
    z, p = 1.96, hits / count
    middle = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z * np.sqrt(p * (1 - p) / count + z * z / (4 * count**2)) / (1 + z * z / count)
    return f"{p:.2f} [{max(middle - half, 0):.2f}, {min(middle + half, 1):.2f}] ({hits}/{count})"


def pooled(jobs: list) -> list[dict]:
    """All trials over the cores."""
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(trial, jobs))


def effects_part(scenes, seeds: int, names, multiples) -> list[dict]:
    """Detection and naming against size."""
    keys = [(scene, seed) for scene in scenes for seed in range(seeds)]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        found = list(pool.map(sizes, *zip(*keys, strict=True), [names] * len(keys)))
    jobs, meta = [], []
    for (scene, seed), amplitudes in zip(keys, found, strict=True):
        for name, least in amplitudes.items():
            for m in multiples:
                jobs.append((scene, seed, {name: least * m}, {}))
                meta.append((name, m))
    rows = pooled(jobs)
    for row, (name, m) in zip(rows, meta, strict=True):
        row |= {"effect": name, "multiple": m}
    print("\n## Effects of the library at multiples of their smallest detectable size\n")
    print("| size | detected | right one first, or in the named group, when detected |\n|---:|---|---|")
    for m in multiples:
        own = [r for r in rows if r["multiple"] == m]
        detected = [r for r in own if r["verdict"] != "adequate"]
        right = [r for r in detected if r["effect"] in r["named"]]
        print(f"| {m:g}× | {wilson(len(detected), len(own))} | {wilson(len(right), len(detected))} |")
    print("\n| effect | detected at 1× | at 2× and above | right | otherwise called |\n|---|---|---|---|---|")
    for name in names:
        own = [r for r in rows if r["effect"] == name]
        if not own:
            print(f"| {name} | no scene can show it | | | |")
            continue
        one = [r for r in own if r["multiple"] == 1.0]
        large = [r for r in own if r["multiple"] >= 2.0]
        detected = [r for r in large if r["verdict"] != "adequate"]
        right = [r for r in detected if name in r["named"]]
        wrong = sorted({"+".join(r["named"]) or r["verdict"] for r in detected if name not in r["named"]})
        share = f"{sum(r['verdict'] != 'adequate' for r in one)}/{len(one)}"
        print(
            f"| {name} | {share} | {len(detected)}/{len(large)} | {len(right)}/{len(detected)} | {', '.join(wrong)} |"
        )
    return rows


def empty_part(scenes, count: int) -> list[dict]:
    """Nothing hidden: any verdict but adequate is a false alarm."""
    calm = [(scenes[i % len(scenes)], 1000 + i, {}, {}) for i in range(count)]
    hard = []
    for i in range(count // 2):
        scene = load_scene(scenes[i % len(scenes)])
        hard.append(
            (scenes[i % len(scenes)], 2000 + i, {}, {"repeatability": tuple(3 * x for x in scene.repeatability)})
        )
    rows = pooled(calm + hard)
    print("\n## Nothing hidden\n\n| cells | wrong alarms |\n|---|---|")
    for word, own in (("usual noise", rows[: len(calm)]), ("three times the repeatability", rows[len(calm) :])):
        alarms = [r for r in own if r["verdict"] != "adequate"]
        print(f"| {word} | {wilson(len(alarms), len(own))} |")
        for r in alarms:
            told = (r["scene"], r["seed"], r["verdict"], r["named"], f"p={r['p']:.1g}", r["follows"], r["notes"])
            print(f"<!-- {told} -->")
    return rows


def main() -> None:
    """Run the parts asked for and print their tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--scenes", default="blade,blade-table,drill-plate")
    parser.add_argument("--empties", type=int, default=100)
    parser.add_argument("--effects", default="")
    parser.add_argument("--multiples", default="0.5,1,2,4")
    parser.add_argument("--part", default="effects,empty")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    scenes = options.scenes.split(",")
    names = options.effects.split(",") if options.effects else [n for n in LAWS if n in EFFECTS]
    rows = []
    if "effects" in options.part:
        rows += effects_part(scenes, options.seeds, names, [float(m) for m in options.multiples.split(",")])
    if "empty" in options.part:
        rows += empty_part(scenes, options.empties)
    if options.out:
        options.out.write_text("\n".join(json.dumps(row) for row in rows) + "\n")


if __name__ == "__main__":
    main()
