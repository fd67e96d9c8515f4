"""What `stitch export --to` does: what a run found, in a format that another program reads."""

import sys
from pathlib import Path

from stitch.cli.terminal.streams import results_stream
from stitch.errors import InputError
from stitch.export.arm_formats import ARM_FORMATS
from stitch.export.arm_model import arm_of_run
from stitch.export.cloud_formats import CLOUD_FORMATS, coloured_cloud
from stitch.export.hand_eye import hand_eye_of_run
from stitch.export.hand_eye_formats import HAND_EYE_FORMATS, ros_launch
from stitch.system.whole_file import whole_file
from stitch.units import MICROMETRES


def export_result(
    run: Path, to: str, output: Path | None, parent: str | None, child: str, effects_file: Path | None, *, trust: bool
) -> None:
    """Write a hand-eye, an arm or a cloud in a format that is known.

    Raises:
        InputError: the run has no such thing, or the format no place for it.
    """
    if to in ARM_FORMATS:
        _export_text(ARM_FORMATS[to](arm_of_run(run, effects_file, trust)), to, output)
    elif to in HAND_EYE_FORMATS:
        eye = hand_eye_of_run(run, parent, child)
        # ROS 1 knows launch files in XML only.
        old = to == "ros" and output is not None and output.suffix in (".launch", ".xml")
        _export_text(ros_launch(eye) if old else HAND_EYE_FORMATS[to](eye), to, output)
    else:
        _export_cloud(run, to, output)


def _export_text(text: str, to: str, output: Path | None) -> None:
    if output is None:
        results_stream().write(text)
        return
    with whole_file(output) as file:
        file.write_text(text, encoding="utf-8")
    print(f"{to} to {output}", file=sys.stderr)


def _export_cloud(run: Path, to: str, output: Path | None) -> None:
    if output is None or output.suffix.lower() != f".{to}":
        raise InputError(f"--to {to}: where to? to fix: name the file with -o NAME.{to}")
    write, lost = CLOUD_FORMATS[to]
    cloud = coloured_cloud(run)
    with whole_file(output) as file:
        write(cloud, file)
    span = cloud.span * MICROMETRES[cloud.length_unit]
    told = [f"{output}: coloured by residual, from dark at 0 to yellow at {span:.3g} µm; grey: one view alone"]
    told += [f"{to} does not hold {lost}"] if lost else []
    print("; ".join(told), file=sys.stderr)
