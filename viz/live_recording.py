"""Show a live session in Rerun: each scan at its pose in the colour of its verdict, U, and what was said."""

import os
import sys
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from stitch.api.live import LiveView
from stitch.session.session import SessionData, View
from viz.rrd_file import id_of

os.environ.setdefault("RERUN_ANALYTICS", "off")

# By verdict, distinct to people who do not see red and green alike.
_COLOURS = {
    "waiting": (160, 160, 160),
    "fits": (86, 180, 233),
    "adds_nothing": (230, 159, 0),
    "does_not_belong": (213, 94, 0),
}
# A viewer draws so many points of a scan without delay.
_MOST_POINTS = 20_000


def _open_viewer(stream: rr.RecordingStream) -> None:
    """Open the viewer that came with the library: it lies beside Python, which need not be on the path."""
    path = os.environ.get("PATH", "")
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), path])
    try:
        stream.spawn()
    finally:
        os.environ["PATH"] = path


class RerunLiveRecording:
    """A `stitch.api.live.LiveRecording` that streams to a viewer or a file."""

    def __init__(self, session: SessionData, target: str) -> None:
        self._stream = rr.RecordingStream("stitch", recording_id=id_of(session.name))
        self._count = 0
        if target == "view":
            _open_viewer(self._stream)
        elif target.startswith("rerun"):
            self._stream.connect_grpc(target)
        else:
            self._stream.save(target)
        U = rrb.Vertical(
            rrb.TimeSeriesView(origin="U/mm", name="U of the hand-eye at the part (mm)"),
            rrb.TimeSeriesView(origin="U/mrad", name="U of its rotation (mrad)"),
        )
        seen = rrb.Vertical(
            rrb.Spatial3DView(origin="views", name="Scans as they come"),
            rrb.TextLogView(origin="said", name="What is said of each"),
            row_shares=[3, 1],
        )
        self._stream.send_blueprint(rrb.Blueprint(rrb.Horizontal(seen, U, column_shares=[3, 1]), collapse_panels=True))

    def view(self, view: View, T_reference_scanner: NDArray[np.float64] | None, said: LiveView) -> None:
        """Log one view on the timeline `view`."""
        rec = self._stream
        rec.set_time("view", sequence=self._count)
        self._count += 1
        if view.cloud is not None and T_reference_scanner is not None:
            place = f"views/{rr.escape_entity_path_part(view.name)}"
            every = -(-len(view.cloud.points) // _MOST_POINTS)
            points = view.cloud.points[::every].astype(np.float32)
            T = T_reference_scanner
            rec.log(place, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
            rec.log(place, rr.Points3D(points, colors=[_COLOURS[said.verdict]]))
        rec.log("said", rr.TextLog(str(said), level="WARN" if said.verdict == "does_not_belong" else "INFO"))
        if said.hand_eye is not None:
            rec.log("U/mm", rr.Scalars(said.hand_eye.U.mm))
            rec.log("U/mrad", rr.Scalars(said.hand_eye.U.mrad))
        rec.flush()
