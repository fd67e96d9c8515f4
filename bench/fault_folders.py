"""Bad inputs: models, run folders, Python files of effects, places for the output, command lines."""

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from fault_room import Case
from fault_sessions import RUN, _instead, _text

REUSE = ["run", "o", "--hand-eye", "r", "-o", "out", "--no-recording"]
REPORT = ["report", "r", "--no-diagnosis"]


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
        yield Case("models", name, _text("r/model.toml", change, REUSE))
    for what in ("pipe", "folder", "dangling link", "device"):
        yield Case("models", what, _instead("r/model.toml", what, REUSE))


def _result(change: Callable[[dict[str, Any]], Any], command: list[str]) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        file = room / "r" / "result.json"
        document = json.loads(file.read_text())
        file.write_text(json.dumps(change(document) or document))
        return command

    return spoil


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
_COMMANDS = """
add r incidence_bias
add r --suggested
drop r range_scale
diagnose r
compare r
next r
report r
report r --no-diagnosis
"""
_RETURNS = """
return None
return points[:-1]
return points.T
return points * np.nan
return points * 1j
return 'x'
return [[1, 2], [3]]
return k
sys.exit(0)
raise SystemExit
exit()
1 / 0
return own(points, view, k)
raise MemoryError
points += 1; return points
assert False, '[/red]'
return points.astype(object)
return points > 0
raise BaseException('b')
return np.full(points.shape, np.inf)
"""
_PLACES = {
    "in the session": "s/run",
    "the session": "s",
    "clouds of the session": "s/clouds",
    "here": ".",
    "above": "..",
    "another session": "o",
    "in another session": "p/x",
    "a file": "mine.txt",
    "below a file": "mine.txt/x",
    "own files": "own",
    "a model alone": "model",
    "run of another session": "q",
    "long": "x" * 300,
    "system": "/proc/stitch",
    "link to a session": "link",
}
_LINES = """
rnu s
run
run nowhere
run s --what
run s --effects nothing
run s --effects range_scale --hand-eye r
run s --hand-eye nowhere
run s --hand-eye p
run s s
run s p -o out
check
check nowhere
check :smile:
add r
add r range_scale
add r nothing
add r incidence_bias --suggested
add r --suggested --at-most x
drop r nothing
drop r incidence_bias
batch nowhere
effects nothing
import nowhere.ls
import s/session.toml
import s
calibrate
calibrate sphere s
calibrate tracker s
calibrate robot nowhere
view s
compare [red]
diagnose r --effects-file nowhere.py
"""


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
        yield Case("result.json", name, _text("r/result.json", change, REPORT))
        yield Case("ledger.json", name, _text("r/ledger.json", change, REPORT))
    for file in ("result.json", "ledger.json", "stitched.ply"):
        for what in ("pipe", "folder", "dangling link", "device", "empty", "noise"):
            yield Case("files of a run", f"{file} {what}", _instead(f"r/{file}", what, REPORT))
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


def _names_code(command: list[str]) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        code = room / "sent.py"
        code.write_text(f"open({str(room / 'executed')!r}, 'w')\n" + _EFFECT.format(body="return points", more=""))
        file = room / "r" / "model.toml"
        file.write_text(f'effects_file = "{code}"\n' + file.read_text())
        return command

    return spoil


def foreign_code() -> Iterator[Case]:
    """A run folder that names a Python file: nothing of it runs until somebody allows it."""
    commands = [REUSE, *(line.split() for line in _COMMANDS.strip().splitlines())]
    for command in commands:
        yield Case("code of a stranger", " ".join(command[:2]), _names_code(command))
    yield Case("code that is allowed", "report", _names_code([*REPORT, "--trust"]), fine=True, writes=("r", "executed"))


_EFFECT = """import time, sys, numpy as np
from stitch.effects import effect, number, twist
@effect("sensor", k=number("mm", typical=0.02, limit=1.0){more})
def own(points, view, k):
    "x"
    {body}
"""


def _effect(text: str, json_out: bool = False) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        (room / "mine.py").write_text(text)
        return [*RUN, "--effects-file", "mine.py", "--effects", "own", *(["--json"] if json_out else [])]

    return spoil


def effects_files() -> Iterator[Case]:
    """A user's effects that raise, end the program, never end, or return what is no displacement."""
    for body in _RETURNS.strip().splitlines():
        yield Case("what an effect returns", body[:40], _effect(_EFFECT.format(body=body, more="")))
    for body in ("while True: pass", "time.sleep(1e6)", "while True: time.sleep(0.1)"):
        yield Case("effects without end", body, _effect(_EFFECT.format(body=body, more="")))
    yield Case("effects without end", "file", _effect("while True: pass"))
    good = _EFFECT.format(body="return points + k", more="")
    for name, text in {
        "syntax": "def (",
        "none in it": "x = 1",
        "exits": "import sys; sys.exit(0)",
        "raises": "raise ValueError('a\\nb')",
        "typical 0": good.replace("0.02", "0"),
        "typical negative": good.replace("0.02", "-1"),
        "typical NaN": good.replace("0.02", "float('nan')"),
        "typical text": good.replace("0.02", "'x'"),
        "limit 0": good.replace("limit=1.0", "limit=0"),
        "unit a number": good.replace('"mm"', "5"),
        "no Spec": good.replace('number("mm", typical=0.02, limit=1.0)', "3"),
        "no docstring": good.replace('    "x"\n', ""),
        "place": good.replace('"sensor"', '"mirror"'),
        "argument": good.replace("view, k", "view, q"),
        "name taken": good.replace("def own", "def range_scale"),
        "needs": good.replace("limit=1.0)", "limit=1.0), needs=('moon',)"),
        "binary": "\0\1",
        "mount": good.replace('"sensor"', '"mount"').replace("points, view", "views").replace("points + k", "k"),
        "links": good.replace('"sensor"', '"links"').replace("points + k", "3"),
    }.items():
        yield Case("effects files", name, _effect(text))
    yield Case("effects files", "folder", lambda room: ["effects", "--effects-file", "s"])
    chatty = good.replace(
        '    "x"\n', '    "x"\n    print("chatty"); sys.stdout.write("more"); import os; os.write(1, b"raw")\n'
    )
    yield Case("an effect that prints", "--json", _effect(chatty, json_out=True), fine=True, holds='{\n "format"')


def outputs() -> Iterator[Case]:
    """Places for the run where something would be lost, or nothing can be written."""
    base = ["run", "s", "--no-recording", "-o"]
    for name, place in _PLACES.items():
        yield Case("places for the run", name, _places([*base, place]))
    writes = ("q", "r", "out")
    yield Case("places that are right", "--force", _places([*base, "q", "--force"]), fine=True, writes=("q/",))
    yield Case("places that are right", "the same run", _places([*base, "r"]), fine=True, writes=("r/",))
    yield Case("places that are right", "link to a run", _places([*base, "linked"]), fine=True, writes=("r/",))
    for size in (3_000, 20_000, 60_000, 120_000):
        for command in (["run", "s", "-o", "out"], ["run", "s", "-o", "r"], ["add", "r", "incidence_bias"]):
            name = f"{command[0]} {size // 1000} kB"
            yield Case("disk full", name, lambda room, c=command: c, largest_file=size, writes=writes)
    for command in (
        ["run", "s", "-o", "r"],
        ["add", "r", "incidence_bias"],
        ["diagnose", "r"],
        ["compare", "r"],
        REPORT,
    ):
        yield Case("two at once", command[0], _held(command))


def _places(command: list[str]) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        (room / "mine.txt").write_text("mine")
        (room / "own").mkdir()
        (room / "own" / "thesis.txt").write_text("mine")
        (room / "model").mkdir()
        shutil.copy(room / "r" / "model.toml", room / "model")
        (room / "link").symlink_to(room / "s")
        (room / "linked").symlink_to(room / "r")
        return command

    return spoil


def _held(command: list[str]) -> Callable[[Path], list[str]]:
    """Another process, this one, is writing into the run."""

    def spoil(room: Path) -> list[str]:
        import fcntl

        held = os.open(room / ".r.lock", os.O_RDWR | os.O_CREAT)
        fcntl.flock(held, fcntl.LOCK_EX)
        return command

    return spoil


def command_lines() -> Iterator[Case]:
    """Words that are no command, options that contradict, terminals without UTF-8."""
    for line in ["", *_LINES.strip().splitlines()]:
        yield Case("command lines", line, lambda room, words=line: words.split())
    for encoding in ("ascii", "latin-1", "cp437"):
        for command in (["effects"], ["compare", "r"], [*RUN]):
            yield Case("terminals without UTF-8", f"{encoding} {command[0]}", lambda room, c=command: c, fine=True,
                       environment={"PYTHONIOENCODING": encoding}, writes=("r", "out"))  # fmt: skip
