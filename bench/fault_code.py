"""Bad inputs: Python files of effects, one's own and a stranger's."""

from collections.abc import Callable, Iterator
from pathlib import Path

from fault_folders import REPORT, REUSE
from fault_room import Case
from fault_sessions import RUN

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
_EFFECT = """import time, sys, numpy as np
from stitch.effects import effect, number, twist
@effect("sensor", k=number("mm", typical=0.02, limit=1.0){more})
def own(points, view, k):
    "x"
    {body}
"""


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
