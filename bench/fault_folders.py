"""Bad inputs: models and run folders."""

import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from fault_room import Case
from fault_sessions import instead, with_text

REUSE = ["run", "o", "--hand-eye", "r", "-o", "out", "--no-recording"]
REPORT = ["report", "r", "--no-diagnosis"]
_WRONG = {
    "session": 5,
    "hand_eye": [[1, 2], [3]],
    "residual_rms": "x",
    "noise_floor": None,
    "effects": [1],
    "stages": {"a": 1},
    "views": [5],
    "unobservable": [1],
    "repeatability": 7,
    "verdict": [],
    "notes": "n",
    "convergence": [1],
    "heldout_rms": {},
}


def models() -> Iterator[Case]:
    """model.toml as somebody edited it."""
    number = r"-?\d+\.\d+(e-?\d+)?"
    changes: dict[str, Callable[[str], str]] = {
        "hand-eye NaN": lambda t: re.sub(number, "nan", t, count=1),
        "hand-eye infinite": lambda t: re.sub(number, "inf", t, count=1),
        "hand-eye text": lambda t: re.sub(number, '"x"', t, count=1),
        "hand-eye 400 digits": lambda t: re.sub(number, "9" * 400, t, count=1),
        "not rigid": lambda t: re.sub(number, "7.0", t, count=1),
        "no hand-eye": lambda t: t.replace("[hand_eye]", "[hand]"),
        "format": lambda t: t.replace("stitch-model/1", "stitch-model/7"),
        "unit": lambda t: t.replace('"mm"', '"cm"'),
        "mount": lambda t: t.replace("eye_to_hand", "eye_in_hand"),
        "mount of another kind": lambda t: t.replace('"eye_to_hand"', "5"),
        "effect NaN": lambda t: re.sub(r"value = .*", "value = nan", t),
        "effect infinite": lambda t: re.sub(r"value = .*", "value = inf", t),
        "effect text": lambda t: re.sub(r"value = .*", 'value = "x"', t),
        "effect 400 digits": lambda t: re.sub(r"value = .*", f"value = {'9' * 400}", t),
        "effect without value": lambda t: re.sub(r"value = .*", "", t),
        "effect unit": lambda t: re.sub(r"\nunit = .*", '\nunit = "parsec"', t),
        "unknown effect": lambda t: t.replace("range_scale", "range_of_mountains"),
        "effects a list": lambda t: "effects = [1]\n" + t[: t.index("[effects")],
        "targets wrong": lambda t: t + '\n[targets.ball1]\nposition = "x"\n',
        "deep": lambda t: t + "x = " + "[" * 50_000,
        "empty": lambda t: "",
        "sigma NaN": lambda t: (
            re.sub(r"\nsigma = \[[^]]*\]", '\nsigma = "x"', t).replace("covariance", "covar", 0) + "["
        ),
    }
    for name, change in changes.items():
        yield Case("models", name, with_text("r/model.toml", change, REUSE))
    for what in ("pipe", "folder", "dangling link", "device"):
        yield Case("models", what, instead("r/model.toml", what, REUSE))


def _result(change: Callable[[dict[str, Any]], Any], command: list[str]) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        file = room / "r" / "result.json"
        document = json.loads(file.read_text())
        file.write_text(json.dumps(change(document) or document))
        return command

    return spoil


def run_folders() -> Iterator[Case]:
    """Run folders that were edited, cut short, or moved away from their session."""
    for key, value in _WRONG.items():
        yield Case("result.json", f"{key} wrong", _result(lambda d, k=key, v=value: d.update({k: v}), REPORT))
        yield Case("result.json", f"no {key}", _result(lambda d, k=key: d.pop(k) and None, REPORT))
    for value in ("", "/nowhere", "\0", "x" * 100_000, "."):
        yield Case(
            "result.json", f"session {value[:9]!r}", _result(lambda d, v=value: d.update(session=v), ["compare", "r"])
        )
    for name, change in {
        "a list": lambda t: "[1]",
        "cut short": lambda t: t[:300],
        "deep": lambda t: "[" * 100_000,
        "5000 digits": lambda t: '{"a": ' + "9" * 5000 + "}",
        "NaN": lambda t: t.replace('"residual_rms": ', '"residual_rms": NaN, "a": '),
    }.items():
        yield Case("result.json", name, with_text("r/result.json", change, REPORT))
        yield Case("ledger.json", name, with_text("r/ledger.json", change, REPORT))
    for file in ("result.json", "ledger.json", "stitched.ply"):
        for what in ("pipe", "folder", "dangling link", "device", "empty", "noise"):
            yield Case("files of a run", f"{file} {what}", instead(f"r/{file}", what, REPORT))
    for command in ("diagnose", "compare", "next", "report", "add", "drop", "view"):
        more = ["range_scale"] if command in ("add", "drop") else []
        yield Case("not a run", f"{command} a session", lambda room, c=command, m=more: [c, "s", *m])
        yield Case("not a run", f"{command} nothing", lambda room, c=command, m=more: [c, "nowhere", *m])
    yield Case("links out of a run", "pictures", _pictures_elsewhere, writes=("r",))


def _pictures_elsewhere(room: Path) -> list[str]:
    shutil.rmtree(room / "r" / "pictures", ignore_errors=True)
    (room / "private").mkdir()
    (room / "r" / "pictures").symlink_to(room / "private")
    return ["compare", "r"]
