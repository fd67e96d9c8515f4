"""The arm of one series of measured poses judged on another series, with base and probe of its own.

Run: python bench/kept_arm.py [--every 20 5] [--write]; writes the table of docs/points.md. Needs the measured data
beside the project (two series of one UR10, each with a laser tracker somewhere else).
"""

import argparse
import os
import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.api.pipeline import run, run_rig
from stitch.api.stepwise import suggest
from stitch.model.model_toml import keep_arm_effects
from stitch.output.result_document import model_of
from stitch.run_data import RunData
from stitch.session.reading.session_folder import load_session
from stitch.session.session import SessionData

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("STITCH_SHARED_DATA") or ROOT.parent / "shared" / "data")
PAGE = ROOT / "docs" / "points.md"
SERIES = ("ur10-tmac-A", "ur10-tmac-C")
MARKS = ("<!-- kept arm: begin -->", "<!-- kept arm: end -->")


def every(session: SessionData, step: int) -> SessionData:
    """Every so many views of a session."""
    return replace(session, views=session.views[::step])


def row(name: str, found: RunData) -> str:
    """A line of the table."""
    sigma = 2e3 * np.sqrt(np.diag(found.mount_covariance))[:3].max()
    return f"| {name} | {found.residual_rms:.3f} | {found.heldout_rms:.3f} | {sigma:.2f} |"


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--every", type=int, nargs=2, default=(20, 5), help="every n-th pose of either series")
    parser.add_argument("--write", action="store_true", help="put the table into docs/points.md")
    given = parser.parse_args()
    series = {name: every(load_session(SHARED / name), n) for name, n in zip(SERIES, given.every, strict=True)}
    lines, found = [], {}
    for name, session in series.items():
        began = time.monotonic()
        result, told, _ = suggest(run(session), 5)
        assert result is not None, told
        found[name] = result
        seconds = time.monotonic() - began
        print(f"{name}: {len(session.views)} poses, {', '.join(result.effects)}, {seconds:.0f} s", flush=True)
    lines.append("| poses judged | arm | rms, mm | on poses left out, mm | U of the hand-eye's turn, mrad |")
    lines.append("|---|---|---:|---:|---:|")
    effects = sorted({name for result in found.values() for name in result.effects})
    common = dict(zip(SERIES, run_rig(list(series.values()), effects=effects), strict=True))
    for name, other in zip(SERIES, reversed(SERIES), strict=True):
        session = series[name]
        ways = {
            "nominal": run(session),
            f"of {other} (`--arm`)": run(session, arm=keep_arm_effects(model_of(found[other]))),
            f"common to both (`run A C`: {', '.join(effects)})": common[name],
            "fitted here": found[name],
        }
        lines += [row(f"{name} | {way}", result) for way, result in ways.items()]
    printed = "\n".join(lines)
    print(printed)
    if given.write:
        text = PAGE.read_text(encoding="utf-8")
        block = f"{MARKS[0]}\n{printed}\n{MARKS[1]}"
        PAGE.write_text(re.sub(f"{MARKS[0]}.*{MARKS[1]}", lambda _: block, text, flags=re.S), encoding="utf-8")


if __name__ == "__main__":
    main()
