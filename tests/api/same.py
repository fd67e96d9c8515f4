"""What a person holds of a session, and whether two run folders hold the same."""

import json

import numpy as np

FILES = ("model.toml", "ledger.json", "stitched.ply", "residuals.parquet")


def result_of(folder):
    """result.json without times and paths."""
    document = json.loads((folder / "result.json").read_text())
    del document["session"]
    return document | {"stages": [{**stage, "seconds": None} for stage in document["stages"]]}


def same_folder(a, b):
    """True if two run folders hold the same but for times and paths."""
    return result_of(a) == result_of(b) and all((a / f).read_bytes() == (b / f).read_bytes() for f in FILES)


def taken(session):
    """What a person holds of a session: the arguments of `from_arrays` that give the same."""
    views = session.views
    return {
        "clouds": {view.name: view.cloud for view in views},
        "poses": np.array([view.T_base_flange for view in views]),
        "mount": session.mount,
        "joints": session.joints,
        "robot": session.robot,
        "times": None if views[0].time_s is None else [view.time_s for view in views],
        "covariates": {name: [view.covariates[name] for view in views] for name in views[0].covariates},
        "scanner": session.scanner,
        "unit": session.length_unit,
        "name": session.name,
    }
