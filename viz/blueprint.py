"""What the viewer opens on: the result and the verdict first, the way there on further tabs."""

import os

os.environ.setdefault("RERUN_ANALYTICS", "off")
import rerun.blueprint as rrb


def blueprint(changed: bool = False) -> rrb.Blueprint:
    """Result | the model's history | before and after | every iteration; `changed`: an effect came or went."""
    side = rrb.Vertical(
        rrb.TextDocumentView(origin="verdict", name="Verdict"),
        rrb.BarChartView(origin="views", contents=["views/correction_um"], name="Correction per view (µm)"),
        rrb.BarChartView(origin="views", contents=["views/rms_um"], name="Rms per view after register (µm)"),
        row_shares=[3, 1, 1],
    )
    fused = rrb.Spatial3DView(origin="fused", name="Stitched, by disagreement of the views")
    result = rrb.Horizontal(fused, side, column_shares=[3, 2], name="Result")
    pictures = [rrb.Spatial2DView(origin="history/waterfall", name="The error over the history of the model")]
    if changed:
        pictures.append(rrb.Spatial2DView(origin="history/change", name="Where the last change of the model helped"))
    else:
        pictures.append(rrb.Spatial2DView(origin="history/register", name="Before and after register, rms on the part"))
    history = rrb.Vertical(*pictures, name="History of the model")
    compare = rrb.Horizontal(
        rrb.Spatial3DView(origin="before", name="One hand-eye: before register"),
        rrb.Spatial3DView(origin="after", name="After register, same colour scale"),
        name="Before and after",
    )
    scans = rrb.Vertical(
        rrb.Spatial3DView(origin="scans/by_view", name="Scans by view"),
        rrb.Spatial3DView(origin="scans/by_residual", name="Scans by distance from the others"),
    )
    curves = rrb.Vertical(
        rrb.TimeSeriesView(origin="convergence/rms_um", name="Rms (µm)"),
        rrb.TimeSeriesView(origin="convergence/gate_um", name="Gate: partners within (µm)"),
        rrb.Spatial3DView(origin="robot", name="Robot: flange poses in the base frame"),
        rrb.TextLogView(origin="log", name="Stages"),
    )
    steps = rrb.Horizontal(scans, curves, column_shares=[3, 2], name="Every iteration")
    # Opens at the end of the timeline: the result is there, the way back is the slider.
    time = rrb.TimePanel(state="collapsed", timeline="step", play_state="following")
    return rrb.Blueprint(rrb.Tabs(result, history, compare, steps, active_tab=0), time, collapse_panels=True)


def diagnosis_blueprint() -> rrb.Blueprint:
    """Verdict and candidate effects | seen against predicted | aliases | what the poses follow."""

    def picture(name: str, title: str) -> rrb.Spatial2DView:
        return rrb.Spatial2DView(origin=f"diagnosis/{name}", name=title)

    verdict = rrb.Vertical(
        rrb.TextDocumentView(origin="diagnosis/verdict", name="Verdict"),
        rrb.Horizontal(
            picture("candidates", "Candidate effects, best first"), picture("budget", "Where the error comes from")
        ),
        row_shares=[1, 2],
        name="What is missing",
    )
    unexplained = rrb.Vertical(
        picture("shape", "Bins of the covariates that the displacement follows most"),
        picture("views", "Displacement of every view"),
        name="What the poses follow",
    )
    predicted, aliases = picture("added_variable", "Seen against predicted"), picture("aliases", "Aliases")
    return rrb.Blueprint(rrb.Tabs(verdict, predicted, aliases, unexplained, active_tab=0), collapse_panels=True)
