"""What a folder holds: clouds, files of poses, a robot's description."""

import codecs
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from natsort import natsorted, ns

from stitch.errors import InputError
from stitch.plugins.intake.inventory import FoundList, choose_list, take_inventory, with_chosen
from stitch.plugins.intake.raw_poses import ARRAYS, RawPoses, read_by_its_program, read_lists, read_raw_poses
from stitch.plugins.intake.refusals import Fix, Refusal, change
from stitch.plugins.intake.scan_headers import poses_in_scans
from stitch.plugins.intake.table_files import WORKBOOKS
from stitch.session.reading.clouds import CLOUD_SUFFIXES
from stitch.session.reading.depth_image import DEPTH_SUFFIXES, is_depth_image
from stitch.session.reading.intrinsics import Intrinsics, find_intrinsics
from stitch.session.reading.scan_files import ptx_scans, read_text_columns
from stitch.session.reading.text_files import readable
from stitch.system.packages import import_extra

# Text files are clouds or tables of poses: a scan has more lines than a campaign has views.
_EITHER = (".txt", ".csv", ".asc")
_CLOUD_LINES = 400
_FEWEST_SCANS, _FEWEST_POINTS = 3, 25
# Bytes of other things are hardly all numbers of such sizes.
_RECORDS = (1e-3, 1e6)
# A recording of a robot is as long as a scan; the names of its columns tell them apart.
_RECORDINGS = 2
_RECORDED, _HEADER = re.compile(rb"tcp|pose|joint|flange|q[wxyz]\b|actual_|quat", re.IGNORECASE), 4096
_DEEPEST = 3
_LARGEST_TABLE_MB = 5.0
_PACKED = (".zip", ".7z", ".rar", ".tar", ".gz", ".tgz", ".xz", ".bz2", ".zst")
# What this program writes itself.
_OWN = {"session.toml": b"stitch-session", "targets.csv": b"target,"}
_OWN |= dict.fromkeys(("views.csv", "points.csv", "frames.csv"), b"view,")
# Robots, pictures and documents.
_DOCUMENTS = (".md", ".html", ".py")
_NO_POSES = (".urdf", ".xacro", ".pdf", ".toml", ".mtl", *_DOCUMENTS)
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# Angles of a turntable in names: scan_020deg, angle_45.5, 120°.
_ANGLE = re.compile(
    r"(?:angle|winkel|rot|turn|table|theta|deg)[a-z]*[_-]?([+-]?\d+(?:[.,]\d+)?)"
    r"|(\d+(?:[.,p]\d+)?)[_ ]?(?:deg|grad|°)",
    re.IGNORECASE,
)
# Tables and descriptions that lie beside such a file are far smaller.
_SMALL_MB = 5.0


def clouds_among(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Files of the kind that most clouds have, and clouds of other kinds."""
    fitting = [f for f in files if f.suffix.lower() in CLOUD_SUFFIXES and _is_cloud(f)] or _short_clouds(files)
    if not fitting:
        return [], []
    kinds = Counter(f.suffix.lower() for f in fitting)
    order = list(CLOUD_SUFFIXES)
    best = max(kinds, key=lambda kind: (kinds[kind], -order.index(kind)))
    return [f for f in fitting if f.suffix.lower() == best], [f for f in fitting if f.suffix.lower() != best]


def _is_cloud(file: Path) -> bool:
    if file.suffix.lower() == ".npy":
        return _is_cloud_array(file) or is_depth_image(file)
    if file.suffix.lower() in DEPTH_SUFFIXES:
        return is_depth_image(file)
    if file.suffix.lower() == ".bin":
        head = np.fromfile(file, "<f4", _HEADER // 4)
        return file.stat().st_size % 16 == 0 and bool(_RECORDS[0] < np.abs(head).max(initial=0.0) < _RECORDS[1])
    if file.suffix.lower() not in _EITHER:
        return True
    with file.open("rb") as stream:
        if _RECORDED.search(stream.readline(_HEADER)):
            return False
        stream.seek(0)
        return sum(1 for _, _ in zip(stream, range(_CLOUD_LINES), strict=False)) == _CLOUD_LINES


def _short_clouds(files: Sequence[Path]) -> list[Path]:
    """Texts named alike that hold points and nothing beside, as profiles do: each more rows than there are files."""
    alike = [f for f in files if f.suffix.lower() in _EITHER]
    kinds = Counter((f.parent, re.sub(r"\d+", "#", f.name)) for f in alike)
    out = []
    for file in alike:
        count = kinds[file.parent, re.sub(r"\d+", "#", file.name)]
        with suppress(InputError, ValueError):
            if count >= _FEWEST_SCANS and len(read_text_columns(file)["x"]) > max(count, _FEWEST_POINTS):
                out.append(file)
    return out


def _is_cloud_array(file: Path) -> bool:
    """An image of points, or more rows than a campaign has views; matrices (V, 4, 4) are poses."""
    try:
        shape = np.load(file, mmap_mode="r", allow_pickle=False).shape or (0,)
    except (ValueError, OSError, EOFError):
        return False
    image = len(shape) == 3 and shape[1:] not in ((4, 4), (3, 4))
    return shape[-1] >= 3 and (image or (len(shape) == 2 and shape[0] >= _CLOUD_LINES))


@dataclass(frozen=True)
class FolderFiles:
    """Files of one folder; clouds in the order of their names, numbers by size."""

    folder: Path
    clouds: tuple[Path, ...]
    urdf: Path | None
    others: tuple[Path, ...] = ()  # clouds of another kind
    lists: tuple[FoundList, ...] = ()  # every list of numbers beside the scans
    rivals: tuple[FoundList, ...] = ()  # those that serve the clouds, the likely one first
    alike: int = 1  # the first so many of them, which nothing but the scans can tell from each other
    chosen: FoundList | None = None  # None: the poses stand in the headers of the scans

    @property
    def poses(self) -> tuple[Path, ...]:
        """One table, or a file for each pose."""
        return self.chosen.files if self.chosen else ()

    @property
    def raw(self) -> RawPoses | None:
        """The rows of the poses."""
        return self.chosen.raw if self.chosen else None

    @property
    def inventory(self) -> tuple[FoundList, ...]:
        """Every list, that of the poses first, and what became of the others."""
        return with_chosen(self.lists, self.chosen) if self.chosen else self.lists

    @property
    def unused(self) -> tuple[Path, ...]:
        """Clouds of another kind and other files of poses."""
        lens = lens_of(self.clouds[0])
        used = (*self.poses, *([lens.source] if lens else []))
        aside = (*self.others, *(f for found in self.lists for f in found.files))
        return tuple(dict.fromkeys(f for f in aside if f not in used))


@readable()
def find_folder_files(
    folder: Path, poses: Path | None = None, accepts: Callable[[RawPoses], bool] = lambda _: False
) -> FolderFiles:
    """Find clouds and poses in a folder and below it.

    Args:
        poses: file or folder of the poses, where a person names it; FILE#LIST for one list of a file.
        accepts: whether what a person has stated makes poses of a list that no layout accepts.

    Raises:
        InputError: no clouds, no poses, or several lists of poses.
    """
    _require_folder(folder)
    file, part = _file_and_part(poses)
    # As a refusal names it: beside the scans.
    file = folder / file if file is not None and not file.exists() and (folder / file).exists() else file
    if file is not None and not file.exists():
        raise Refusal(f"{file}: no such file", Fix("name the file of the poses with --poses FILE", {"poses": "FILE"}))
    files = list_files(folder)
    named = {file, *(file.iterdir() if file is not None and file.is_dir() else ())}
    clouds, other_clouds = clouds_among([f for f in files if f not in named])
    if not clouds:
        raise _no_clouds(folder, files)
    # A recording of the robot is as long as a scan, and the only text beside scans of another kind.
    texts = [f for f in other_clouds if f.suffix.lower() in _EITHER]
    taken = {*clouds, *(other_clouds if len(texts) > _RECORDINGS else set(other_clouds) - {*texts})}
    candidates = [f for f in files if f not in taken and _may_hold_poses(f) and not read_by_its_program(f)]
    open_, alike = list[FoundList](), 1
    inventory: list[FoundList] = []
    if file is not None:
        inventory = open_ = [_stated_list(file, part, taken)]
    elif candidates or (poses_in_scans(clouds) is None and angles_in_names(clouds) is None):
        inventory = take_inventory(candidates, accepts)
        if all(found.why_not for found in inventory):  # what is written for people may hold them all the same
            inventory += take_inventory([f for f in files if f.suffix.lower() in _DOCUMENTS], accepts)
        if inventory or (poses_in_scans(clouds) is None and angles_in_names(clouds) is None):
            open_, alike = choose_list(folder, inventory, clouds)
    urdfs = [f for f in files if f.suffix.lower() == ".urdf"]
    return FolderFiles(
        folder=folder,
        clouds=tuple(clouds),
        urdf=urdfs[0] if len(urdfs) == 1 else None,
        others=tuple(other_clouds),
        lists=tuple(inventory),
        rivals=tuple(open_),
        alike=alike,
        chosen=open_[0] if open_ else None,
    )


def _file_and_part(poses: Path | None) -> tuple[Path | None, str]:
    """FILE and LIST of FILE#LIST; a file whose own name has a # in it is one."""
    if poses is None or poses.exists() or "#" not in poses.name:
        return poses, ""
    name, part = poses.name.rsplit("#", 1)
    return poses.with_name(name), part


def lens_of(cloud: Path) -> Intrinsics | None:
    """Return the camera of a depth image, whose file is used though it holds no pose; None of other scans."""
    with suppress(InputError):
        return find_intrinsics(cloud) if cloud.suffix.lower() in DEPTH_SUFFIXES else None
    return None


def angles_in_names(clouds: Sequence[Path]) -> list[float] | None:
    """Return the angle in each cloud's name, degrees; None where one has none, or two are alike."""
    found = [_ANGLE.search(cloud.stem) for cloud in clouds]
    if len(clouds) < 3 or None in found:
        return None
    angles = [float(re.sub("[,p]", ".", m[1] or m[2])) for m in found if m is not None]
    return angles if len(set(angles)) == len(angles) else None


def _require_folder(folder: Path) -> None:
    if folder.is_dir():
        return
    if not folder.is_file():
        raise Refusal(f"{folder}: no such folder", change(folder, "name the folder of the scans"))
    if folder.suffix.lower() in _PACKED:
        raise Refusal(f"{folder}: is packed", change(folder, "unpack it and name the folder"))
    raise Refusal(f"{folder}: is a file", change(folder, f"name the folder that it lies in, {folder.parent}"))


def _no_clouds(folder: Path, files: Sequence[Path]) -> Refusal:
    """Why, and what to do: an archive that nobody has unpacked, or files of other kinds."""
    packed = next((f for f in files if f.suffix.lower() in _PACKED), None)
    if packed is not None:
        told = f"{folder}: no clouds there, only packed in {packed.relative_to(folder)}"
        return Refusal(told, change(packed, "unpack it there"))
    kinds = Counter(f.suffix.lower() or f.name for f in files).most_common(3)
    there = f", only {', '.join(f'{count} {kind}' for kind, count in kinds)}" if kinds else ""
    words = (
        f"put the scans there as {', '.join(CLOUD_SUFFIXES)}, or the points that a tracker measured beside the poses"
    )
    return Refusal(f"{folder}: no clouds there{there}", change(folder, words))


def list_files(folder: Path, depth: int = 0) -> list[Path]:
    """Return files in a folder and below, hidden ones and folders of runs left out."""
    out = []
    for entry in natsorted(folder.iterdir(), alg=ns.IGNORECASE):
        if entry.name.startswith((".", "~$")) or _is_own(entry):
            continue
        if entry.is_file():
            out.append(entry)
        elif entry.is_dir() and depth < _DEEPEST and not (entry / "result.json").exists():
            out += list_files(entry, depth + 1)
    return out


def _is_own(entry: Path) -> bool:
    """Whether this program wrote a file, as name and beginning say."""
    begins = _OWN.get(entry.name)
    if begins is None or not entry.is_file():
        return False
    with entry.open("rb") as stream:
        # Beside a session; without one, points of this form are what a tracker measured.
        return begins in stream.readline(_HEADER) and (entry.parent / "session.toml").exists()


def _may_hold_poses(file: Path) -> bool:
    """Small files that are arrays, workbooks or text, whatever their ending; a robot's description holds none."""
    suffix = file.suffix.lower()
    if file.stat().st_size > _LARGEST_TABLE_MB * 1e6 or suffix in _NO_POSES:
        return False
    if suffix in (*WORKBOOKS, *ARRAYS):
        return True
    with file.open("rb") as stream:
        start = stream.read(_HEADER)
    return bool(start) and (b"\0" not in start or start.startswith(_UTF16))


def _stated_list(poses: Path, part: str, clouds: set[Path]) -> FoundList:
    """The list that a person names, of a file or of the files of a folder that hold a pose each."""
    if not poses.is_dir():
        if not part:
            return FoundList((poses,), read_raw_poses([poses]), "poses")
        lists = read_lists(poses)
        raw = next((raw for raw in lists if raw.part == part), None)
        if raw is None:
            parts = ", ".join(f"{poses.name}#{raw.part}" for raw in lists if raw.part)
            raise Refusal(
                f"{poses}: has no list {part}", Fix(f"name one of {parts or poses.name}", {"poses": "FILE#LIST"})
            )
        return FoundList((poses,), raw, "poses")
    inside = [f for f in poses.iterdir() if f.is_file() and f not in clouds and _may_hold_poses(f)]
    if not inside:
        named = Fix("name the file or the folder of the poses with --poses FILE", {"poses": "FILE"})
        raise Refusal(f"{poses}: no files of poses there", named)
    files = tuple(natsorted(inside, alg=ns.IGNORECASE))
    return FoundList(files, read_raw_poses(files), "poses")


@contextmanager
def one_scan_a_file(folder: Path) -> Iterator[Path]:
    """Give the folder as it is, or, where a file holds several scans, a passing one with a file for each of them.

    Raises:
        InputError: the package that reads such files is not installed.
    """
    files = list_files(folder) if folder.is_dir() else []
    packed = {file: count for file in files if (count := _scan_count(file)) > 1}
    if not packed:
        yield folder
        return
    with TemporaryDirectory() as scratch:
        unpacked = Path(scratch) / folder.resolve().name
        unpacked.mkdir()
        for file in files:
            if file in packed:
                _unpack(file, packed[file], unpacked)
            elif file.stat().st_size < _SMALL_MB * 1e6:
                shutil.copyfile(file, unpacked / file.name)
        yield unpacked


def _scan_count(file: Path) -> int:
    if file.suffix.lower() == ".e57":
        return int(import_extra("pye57", file, "formats").E57(str(file)).scan_count)
    return len(ptx_scans(file)) if file.suffix.lower() == ".ptx" else 1


def _unpack(file: Path, count: int, folder: Path) -> None:
    """Write each scan, with its pose, to a file of its own, numbered in their order."""
    names = [folder / f"{file.stem}_{i:0{len(str(count - 1))}d}{file.suffix.lower()}" for i in range(count)]
    if file.suffix.lower() == ".ptx":
        for name, lines in zip(names, ptx_scans(file), strict=True):
            name.write_text("\n".join(lines) + "\n", encoding="ascii", errors="replace")
        return
    pye57 = import_extra("pye57", file, "formats")
    source = pye57.E57(str(file))
    for i, name in enumerate(names):
        header = source.get_header(i)
        fields = set(header.point_fields)
        columns = source.read_scan(
            i, ignore_missing_fields=True, transform=False, intensity="intensity" in fields, colors="colorRed" in fields
        )
        posed = header.has_pose()
        with pye57.E57(str(name), mode="w") as written:
            written.write_scan_raw(
                {field: np.asarray(column) for field, column in columns.items()},
                rotation=np.asarray(header.rotation) if posed else None,
                translation=np.asarray(header.translation) if posed else None,
            )
