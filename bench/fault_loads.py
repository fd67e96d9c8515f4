"""Bad inputs: the box that counts, payload and torques, arms of other runs, several sessions at once."""

import csv
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from fault_room import Case
from fault_sessions import RUN, with_key, with_text, with_toml

_SAG = [*RUN, "--effects", "joint_compliance"]
_ARM = [*RUN, "--arm", "a"]
_BOTH = ["run", "s", "t", "-o", "out", "--no-recording"]
_BOXES = (
    "5",
    "[]",
    '"x"',
    "{}",
    "[[0, 0, 0]]",
    "[[9, 9, 9], [0, 0, 0]]",
    "[[0, 0, 0], [0, 9, 9]]",
    "[[nan, 0, 0], [9, 9, 9]]",
    "[[-inf, 0, 0], [9, 9, 9]]",
    '[["-200", "-200", "0"], ["200", "200", "900"]]',
    "[[false, false, false], [true, true, true]]",
    f"[[0, 0, 0], [{'9' * 400}, 9, 9]]",
    "[[-0.2, -0.2, 0.3], [0.2, 0.2, 0.6]]",  # in metres
    "[[-1000, -1000, -900], [1000, 1000, -1]]",  # behind the scanner
)
_TORQUES = [f"j{i}_torque_nm" for i in range(1, 7)]


def boxes() -> Iterator[Case]:
    """[scanner] within."""
    for value in _BOXES:
        yield Case("scanner.within", value[:40], with_toml(with_key("scanner.within", value)))
    wide = "[[-1e6, -1e6, -1e6], [1e6, 1e6, 1e6]]"
    yield Case("a box that is right", wide, with_toml(with_key("scanner.within", wide)), fine=True)


def _columns(names: Sequence[str], rows: Sequence[Sequence[str]]) -> Callable[[Path], list[str]]:
    """Columns more in views.csv of s, whose effect of the arm follows them; the last row goes on to the end."""

    def spoil(room: Path) -> list[str]:
        file = room / "s" / "views.csv"
        head, *views = file.read_text().splitlines()
        own = [*rows, *[rows[-1]] * len(views)]
        told = [",".join([view, *cells]) for view, cells in zip(views, own, strict=False)]
        file.write_text("\n".join([",".join([head, *names]), *told]) + "\n")
        return _SAG

    return spoil


def loads() -> Iterator[Case]:
    """payload_kg and jN_torque_nm."""
    for name, cells in {
        "negative": ["-3"],
        "negative once": ["5", "-3", "5"],
        "a word once": ["5", "x", "5"],
        "empty once": ["5", "", "5"],
        "NaN": ["nan"],
        "a megaton": ["1e9"],
        "words": ["heavy"],
    }.items():
        yield Case("payload_kg", name, _columns(["payload_kg"], [[cell] for cell in cells]))
    still = ["3"] * 6
    for name, names, rows in (
        ("of five joints", _TORQUES[:5], [still[:5]]),
        ("of a joint that is not there", [*_TORQUES, "j7_torque_nm"], [[*still, "3"]]),
        ("empty once", _TORQUES, [still, [*still[:5], ""], still]),
        ("a word once", _TORQUES, [still, [*still[:5], "x"], still]),
        ("1e25", _TORQUES, [["1e25"] * 6]),
    ):
        yield Case("torque columns", name, _columns(names, rows))
    yield Case("loads that are right", "an empty column", _columns(["payload_kg"], [[""]]), fine=True)
    yield Case("loads that are right", "torques of all joints", _columns(_TORQUES, [still, ["4"] * 6]), fine=True)


def arms() -> Iterator[Case]:
    """`run --arm`."""
    for line in ("nowhere", "s", "r", "mine.txt", "."):
        yield Case("arms of other runs", line, lambda room, arm=line: [*RUN, "--arm", arm])
    for more in ("--effects gear_eccentricity", "--hand-eye r"):
        yield Case("arms of other runs", more, lambda room, words=more: [*_ARM, *words.split()])
    changes: dict[str, Callable[[str], str]] = {
        "joint 9": lambda t: t.replace("gear_eccentricity.A3", "gear_eccentricity.A9"),
        "NaN": lambda t: re.sub(r"value = .*", "value = nan", t, count=1),
        "another unit": lambda t: t.replace('unit = "rad"', 'unit = "mm"'),
        "no format": lambda t: t.replace("stitch-model/1", "x"),
    }
    for name, change in changes.items():
        yield Case("arms of other runs", name, with_text("a/model.toml", change, _ARM))
    yield Case("arms of other runs", "no robot", with_toml(lambda t: t[: t.index("[robot]")], _ARM))
    yield Case("arms of other runs", "five joints", _five_joints)
    yield Case("an arm that is right", "", lambda room: _ARM, fine=True)


def _five_joints(room: Path) -> list[str]:
    """The arm of s without its last joint."""
    with_text("s/session.toml", lambda t: re.sub(r"    \{[^}]*\},?\n\]", "]", t), _ARM)(room)
    file = room / "s" / "views.csv"
    rows = list(csv.reader(file.read_text().splitlines()))
    kept = [i for i, name in enumerate(rows[0]) if name[:2] != "j6" and name not in (*"xyz", "qx", "qy", "qz", "qw")]
    file.write_text("\n".join(",".join(row[i] for i in kept) for row in rows) + "\n")
    return _ARM


def sessions_together() -> Iterator[Case]:
    """`run A B` of what is no rig."""
    changes: dict[str, Callable[[str], str]] = {
        "one twice under two names": lambda t: t,
        "another unit": lambda t: t.replace('length_unit = "mm"', 'length_unit = "m"'),
        "another mount": lambda t: t.replace("eye_to_hand", "eye_in_hand"),
        "named as a file of the run": lambda t: t.replace('"t"', '"model.toml"'),
    }
    for name, change in changes.items():
        yield Case("sessions together", name, _beside(change))
    for line in ("s s", "s p", "s mine.txt", "s r", "s nowhere"):
        yield Case("sessions together", line, lambda room, words=line: ["run", *words.split(), "-o", "out"])
    yield Case("a rig that is right", "", lambda room: ["run", "s", "o", "-o", "out", "--no-recording"], fine=True)
    for size in ("nan", "inf", "-3", "1kB", "x"):
        yield Case("--memory", size, lambda room, size=size: [*RUN, "--memory", size])


def _beside(change: Callable[[str], str]) -> Callable[[Path], list[str]]:
    """A changed copy t of s."""

    def spoil(room: Path) -> list[str]:
        shutil.copytree(room / "s", room / "t")
        return with_text("t/session.toml", lambda text: change(text.replace('"s"', '"t"')), _BOTH)(room)

    return spoil
