"""Tables of the blind benchmark from its rows; every share with its 95 % Wilson interval."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

Row = dict[str, Any]


def tables(rows: Sequence[Row]) -> str:
    """All tables as Markdown; parts without rows are left out."""
    out = []
    for part, table in _TABLES.items():
        own = [r for r in rows if r["part"] == part and r["verdict"] != "not shown"]
        if own:
            out.append(table(own))
    return "\n\n".join(out)


def share(rows: Iterable[Row], hit: Callable[[Row], bool]) -> str:
    """Share of rows with its interval."""
    hits = [bool(hit(r)) for r in rows]
    if not hits:
        return "–"
    low, high = binomtest(sum(hits), len(hits)).proportion_ci(0.95, method="wilson")
    return f"{np.mean(hits):.2f} [{low:.2f}, {high:.2f}] ({sum(hits)}/{len(hits)})"


def _detected(row: Row) -> bool:
    return bool(row["verdict"] != "adequate")


def _right(row: Row) -> bool:
    return row["effect"] in row["named"]


def _effects(rows: list[Row]) -> str:
    lines = [
        "### Effects of the library at multiples of their smallest detectable size\n",
        "| size | detected | right one named, or in the named group, when detected | confident wrong name |",
        "|---:|---|---|---|",
    ]
    for m in sorted({r["multiple"] for r in rows}):
        own = [r for r in rows if r["multiple"] == m]
        wrong = share(own, lambda r: r["verdict"] == "missing_effect" and not _right(r))
        lines.append(f"| {m:g}× | {share(own, _detected)} | {share(filter(_detected, own), _right)} | {wrong} |")
    lines += ["\n| effect | at 0.5× | at 1× | at 2× and 4× | right when detected there | otherwise called |",
              "|---|---|---|---|---|---|"]  # fmt: skip
    for name in sorted({r["effect"] for r in rows}):
        own = [r for r in rows if r["effect"] == name]
        large = [r for r in own if r["multiple"] >= 2]
        seen = [r for r in large if _detected(r)]
        other = sorted({"+".join(r["named"]) or r["verdict"] for r in seen if not _right(r)})
        sizes = [[r for r in own if r["multiple"] == 0.5], [r for r in own if r["multiple"] == 1], large]
        counts = [f"{sum(map(_detected, group))}/{len(group)}" for group in sizes]
        lines.append(f"| {name} | {' | '.join(counts)} | {sum(map(_right, seen))}/{len(seen)} | {', '.join(other)} |")
    return "\n".join(lines) + "\n\n" + _added([r for r in rows if "added" in r])


def _added(rows: list[Row]) -> str:
    z = np.array([v for r in rows for v in r["added"]["z"].values()])
    known = [r for r in rows if "knowing" in r["added"]]
    lines = [
        "### After adding the right effect\n", "| what | figure |", "|---|---|",
        f"| held-out residual falls | {share(rows, lambda r: r['added']['heldout'][1] < r['added']['heldout'][0])} |",
        "| held-out residual within 5 % of a run that knew the effect | "
        + share(known, lambda r: abs(r["added"]["heldout"][1] / r["added"]["knowing"] - 1) < 0.05) + " |",
        f"| amplitudes within 2 sigma | {share([{'z': v} for v in z], lambda r: abs(r['z']) < 2)} |",
        f"| SD of (found − true)/sigma | {np.sqrt(np.mean(z**2)):.2f}, of its middle {_robust(z):.2f}, n = {len(z)} |",
        f"| hand-eye nearer to the truth | {share(rows, lambda r: _ratio(r) < 1)} |",
        f"| hand-eye farther from it, by more than its sigma | {share(rows, _worse)} |",
        f"| hand-eye: χ²/6 of its error, mean | {_chi_square([r['added'] for r in rows]):.2f} |",
        f"| hand-eye error, median, before → after | {_median(rows, 0):.3f} → {_median(rows, 1):.3f} mm |",
    ]  # fmt: skip
    return "\n".join(lines)


def _ratio(row: Row) -> float:
    before, after = row["added"]["hand_eye"]
    return float(after / before)


def _worse(row: Row) -> bool:
    before, after = row["added"]["hand_eye"]
    return bool(after - before > row["added"]["hand_eye_sigma"])


def _median(rows: list[Row], which: int) -> float:
    return float(np.median([r["added"]["hand_eye"][which] for r in rows]))


def _robust(z: np.ndarray) -> float:
    return float(np.subtract(*np.percentile(z, [84.13, 15.87])) / 2)


def _alarms(name: str, rows: list[Row]) -> str:
    return f"| {name} | {share(rows, _detected)} | {_chi_square(rows):.2f} |"


def _chi_square(rows: list[Row]) -> float:
    found = [r["hand_eye_chi_square"] / 6 for r in rows if "hand_eye_chi_square" in r]
    return float(np.mean(found)) if found else float("nan")


def _empty(rows: list[Row]) -> str:
    lines = ["### Nothing hidden\n", "| cells | wrong alarms | hand-eye: χ²/6 of its error, mean |", "|---|---|---:|"]
    for noise in dict.fromkeys(r["noise"] for r in rows):
        lines.append(_alarms(noise or "usual noise", [r for r in rows if r["noise"] == noise]))
    lines.append(_alarms("all of the harder ones", [r for r in rows if r["noise"]]))
    usual = [r for r in rows if not r["noise"]]
    for scene in dict.fromkeys(r["scene"] for r in usual):
        lines.append(_alarms(f"usual noise, {scene}", [r for r in usual if r["scene"] == scene]))
    return "\n".join(lines)


def _aliases(rows: list[Row]) -> str:
    lines = ["### Exact aliases of the hand-eye\n", "| hidden | never a single name | called |", "|---|---|---|"]
    for how in dict.fromkeys(r["how"] for r in rows):
        own = [r for r in rows if r["how"] == how]
        called = sorted({r["verdict"] + (f" ({'+'.join(r['named'])})" if r["named"] else "") for r in own})
        word = f"joint_offset, {how}" if how else "offset of joint 1 alone"
        lines.append(f"| {word} | {share(own, lambda r: r['verdict'] != 'missing_effect')} | {', '.join(called)} |")
    return "\n".join(lines)


def _outside(rows: list[Row]) -> str:
    lines = [
        "### Effects outside the library\n",
        "| hidden | size | unknown_effect | confident wrong name | right covariate among the first three | "
        "the user's own effect is named then | held-out residual within 5 % of the floor after adding it |",
        "|---|---:|---|---|---|---|---|",
    ]
    keys = sorted({(r["effect"], r["multiple"]) for r in rows})
    for name, multiple in [*keys, *(("all", m) for m in sorted({m for _, m in keys}))]:
        own = [r for r in rows if name in ("all", r["effect"]) and r["multiple"] == multiple]
        user = [r for r in own if "user" in r]
        unknown = [r for r in own if r["verdict"] == "unknown_effect"]
        lines.append(
            f"| {name} | {multiple:g}× | {share(own, lambda r: r['verdict'] == 'unknown_effect')} "
            f"| {share(own, lambda r: r['verdict'] == 'missing_effect')} | {share(unknown, _follows)} "
            f"| {share(user, lambda r: len(r['user']['named']) == 1)} "
            f"| {share(user, lambda r: r['user']['heldout'][1] < 1.05 * r['user']['heldout'][2])} |"
        )
    return "\n".join(lines)


def _follows(row: Row) -> bool:
    """The right covariate: the angle of the joint, time (a knock), humidity."""
    if row["effect"] == "third_harmonic":
        joint = next(iter(row["hidden"]["third_harmonic"])).removeprefix("A")
        return any(f.startswith((f"j{joint}", f"joint {joint}")) for f in row["follows"])
    word = {"knock": ("time", "view"), "covariate_bias": ("humidity",)}[row["effect"]]
    return any(w in f for f in row["follows"] for w in word)


def _pairs(rows: list[Row]) -> str:
    both = share(rows, lambda r: set(r["effects"]) <= set(r["found"]))
    one = share(rows, lambda r: bool(set(r["effects"]) & set(r["found"])))
    wrong = share(rows, lambda r: bool(set(r["found"]) - set(r["effects"])))
    return "\n".join([
        "### Two effects at once, `stitch add RUN --suggested`\n", "| what | share |", "|---|---|",
        f"| both found | {both} |", f"| at least one found | {one} |", f"| something else added | {wrong} |",
    ])  # fmt: skip


_TABLES: dict[str, Callable[[list[Row]], str]] = {
    "effects": _effects, "empty": _empty, "aliases": _aliases, "outside": _outside, "pairs": _pairs,
}  # fmt: skip
