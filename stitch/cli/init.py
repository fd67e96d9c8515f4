"""`stitch init FOLDER`: a session from a folder of scans and poses of unknown convention."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.target_options import BallOption, BoardOption
from stitch.errors import InputError


def init(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Scans, and poses beside or below them; or a bag of ROS, MCAP."),
    ],
    poses: Annotated[Path | None, typer.Option("--poses", help="File or folder of the poses; default: found.")] = None,
    columns: Annotated[
        str | None, typer.Option("--columns", help="Names of the columns of numbers: rx,ry,rz,x,y,z; - leaves one out.")
    ] = None,
    rotation: Annotated[
        str | None, typer.Option("--rotation", help="xyz-extrinsic, zyx-intrinsic, rotation-vector, quaternion-xyzw …")
    ] = None,
    angles: Annotated[str | None, typer.Option("--angles", help="deg or rad.")] = None,
    unit: Annotated[str | None, typer.Option("--unit", help="Of the poses: mm, m, cm or inch.")] = None,
    cloud_unit: Annotated[str | None, typer.Option("--cloud-unit", help="Of the clouds: mm or m.")] = None,
    mount: Annotated[str | None, typer.Option("--mount", help="eye_in_hand or eye_to_hand.")] = None,
    inverse: Annotated[
        bool | None, typer.Option("--inverse/--no-inverse", help="The poses are T_flange_base, or are not.")
    ] = None,
    board: BoardOption = None,
    ball: BallOption = None,
    topic: Annotated[str | None, typer.Option("--topic", help="Of a bag: the topic of the scans.")] = None,
    named: Annotated[
        str | None, typer.Option("--frames", metavar="BASE,FLANGE[,SCANNER]", help="Of a bag: frames of tf.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="OUT", help="Folder of the session; default FOLDER, or BAG-session."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Guess what cannot be told, do not ask.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the guesses as JSON.")] = False,
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
    from stitch.cli.actions.first_folder import of_bag, of_scans
    from stitch.cli.actions.looked_for import looked_for
    from stitch.intake.bag_messages import is_bag
    from stitch.intake.stated import Stated

    if is_bag(folder):
        of_bag(folder, output or folder.with_name(f"{folder.stem}-session"), topic, named, as_json)
        return
    if topic or named:
        raise InputError(f"{folder}: --topic and --frames are for bags, which this is not; to fix: leave them out")
    stated = Stated(
        poses,
        tuple(name.strip() for name in columns.split(",")) if columns else (),
        rotation,
        angle_unit=angles,
        length_unit=unit,
        cloud_unit=cloud_unit,
        mount=mount,
        inverse=inverse,
        targets=looked_for(board, ball),
    )
    of_scans(folder, folder if output is None else output, stated, yes, as_json)
