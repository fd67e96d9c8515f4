"""`--board` and `--ball`: what scans are said to show."""

from typing import Annotated

import typer

BoardOption = Annotated[
    list[str] | None,
    typer.Option(
        "--board",
        metavar="BOARD",
        help="charuco:11x8:20:15:DICT_4X4_50 (squares; sides of square and marker, mm), checkerboard:9x6:25 (squares; "
        "side), apriltag:36h11:40; may be repeated.",
    ),
]
BallOption = Annotated[
    list[str] | None, typer.Option("--ball", metavar="RADIUS", help="Radius of balls, mm, or any; may be repeated.")
]
