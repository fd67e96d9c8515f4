"""Stitch robot scans: correct the hand-eye from the scans, register, fuse, and say which effect is missing.

run = stitch.run(stitch.load_session("blade-17"))
print(run.diagnose().sentence)
run = run.add("joint_compliance")
"""

from stitch.pipeline import run, run_rig
from stitch.reading.session_folder import load_session

__all__ = ["load_session", "run", "run_rig"]
