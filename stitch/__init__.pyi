# What type checkers read in place of __init__.py, which imports a module when a name of it is first used: `as` exports
# a name to them. A test compares the two.

from stitch.api.check import CheckedSession as CheckedSession
from stitch.api.check import check as check
from stitch.api.live import LiveSession as LiveSession
from stitch.api.live import live as live
from stitch.api.run import Run as Run
from stitch.api.session import Session as Session
from stitch.api.session import load_session as load_session
from stitch.api.verbs import add as add
from stitch.api.verbs import compare as compare
from stitch.api.verbs import diagnose as diagnose
from stitch.api.verbs import drop as drop
from stitch.api.verbs import load_run as load_run
from stitch.api.verbs import next_view as next_view
from stitch.api.verbs import report as report
from stitch.api.verbs import run as run
from stitch.api.verbs import run_rig as run_rig
from stitch.diagnosis.diagnosis import Diagnosis as Diagnosis
from stitch.errors import InputError as InputError
from stitch.errors import NoResultError as NoResultError
from stitch.errors import StitchError as StitchError
from stitch.model.model import Model as Model
from stitch.model.model_toml import read_model as read_model
from stitch.plugins.explain.verb import explain as explain
from stitch.plugins.export.verb import export_run as export_run
from stitch.plugins.intake.targets_verb import detect as detect
from stitch.plugins.intake.verb import init as init
from stitch.plugins.metrology.budget import MeasuredFeatures as MeasuredFeatures
from stitch.plugins.metrology.features import Feature as Feature
from stitch.plugins.metrology.planning.verb import plan as plan
from stitch.plugins.metrology.verb import Calibration as Calibration
from stitch.plugins.metrology.verb import calibrate as calibrate
from stitch.plugins.metrology.verb import measure as measure
from stitch.plugins.metrology.verb import verify as verify
from stitch.plugins.metrology.verification import Verification as Verification
from stitch.plugins.watch.report import CellReport as CellReport
from stitch.plugins.watch.verb import Batch as Batch
from stitch.plugins.watch.verb import batch as batch
from stitch.plugins.watch.verb import watch as watch

MODULES: dict[str, str]
__version__: str
