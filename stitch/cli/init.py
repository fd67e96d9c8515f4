"""`stitch init FOLDER`: a session from a folder of scans and poses of unknown convention."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import split_names
from stitch.cli.target_options import BallOption, BoardOption

_Folder = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="Scans, and poses beside or below them; or a bag of ROS, MCAP.")
]
_Poses = Annotated[Path | None, typer.Option("--poses", help="File or folder of the poses; default: found.")]
_Columns = Annotated[
    str | None, typer.Option("--columns", help="Names of the columns of numbers: rx,ry,rz,x,y,z; - leaves one out.")
]
_Rotation = Annotated[
    str | None, typer.Option("--rotation", help="xyz-extrinsic, zyx-intrinsic, rotation-vector, quaternion-xyzw …")
]
_Angles = Annotated[str | None, typer.Option("--angles", help="deg or rad.")]
_Unit = Annotated[str | None, typer.Option("--unit", help="Of the poses: mm, m, cm or inch.")]
_CloudUnit = Annotated[str | None, typer.Option("--cloud-unit", help="Of the clouds: mm or m.")]
_Mount = Annotated[str | None, typer.Option("--mount", help="eye_in_hand or eye_to_hand.")]
_Inverse = Annotated[
    bool | None, typer.Option("--inverse/--no-inverse", help="The poses are T_flange_base, or are not.")
]
_Topic = Annotated[str | None, typer.Option("--topic", help="Of a bag: the topic of the scans.")]
_Frames = Annotated[
    str | None, typer.Option("--frames", metavar="BASE,FLANGE[,SCANNER]", help="Of a bag: frames of tf.")
]
_Output = Annotated[
    Path | None,
    typer.Option("-o", "--output", metavar="OUT", help="Folder of the session; default FOLDER, or BAG-session."),
]
_Yes = Annotated[bool, typer.Option("--yes", "-y", help="Guess what cannot be told, do not ask.")]
_Json = Annotated[bool, typer.Option("--json", help="Print the guesses as JSON.")]


def init(
    folder: _Folder,
    poses: _Poses = None,
    columns: _Columns = None,
    rotation: _Rotation = None,
    angles: _Angles = None,
    unit: _Unit = None,
    cloud_unit: _CloudUnit = None,
    mount: _Mount = None,
    inverse: _Inverse = None,
    board: BoardOption = None,
    ball: BallOption = None,
    topic: _Topic = None,
    frames: _Frames = None,
    output: _Output = None,
    yes: _Yes = False,
    as_json: _Json = False,
) -> None:
    """Make a session of a folder of scans and poses; the scans tell which convention the poses are in.

    \b
    Examples:
      stitch init scans
      stitch init scans --poses robot_poses.txt --yes
      stitch init scans --rotation zyx-intrinsic --angles deg --unit mm --mount eye_in_hand -o session
      stitch init drive.mcap --topic /points
    """
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.first_folder import run_init
    from stitch.cli.actions.looked_for import parse_target_options
    from stitch.intake.stated import StatedFolder

    stated = StatedFolder(
        split_names(columns),
        rotation,
        angles,
        length_unit=unit,
        inverse=inverse,
        poses=poses,
        cloud_unit=cloud_unit,
        mount=mount,
        targets=parse_target_options(board, ball),
    )
    run_init(folder, output, stated, topic=topic, frames=frames, yes=yes, as_json=as_json)
