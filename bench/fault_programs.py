"""Bad inputs: robot programs, and what `stitch export` is asked for."""

from collections.abc import Callable, Iterator
from pathlib import Path

from fault_room import Case

# The second point is where the first one is: within reach of the arm.
_KRL = """DEF t()
PTP {A1 -12.586,A2 -62.529,A3 -62.05,A4 68.642,A5 20.952,A6 -36.507}
LIN {X -481.815,Y 132.142,Z 684.153,A 17.154,B -13.472,C -29.927}
END
"""
_LS = """/PROG T
/POS
P[1]{
   GP1:
\tUF : 0, UT : 0,
\tX = -481.815 mm,\tY = 132.142 mm,\tZ = 684.153 mm,
\tW = -29.927 deg,\tP = -13.472 deg,\tR = 17.154 deg
};
/END
"""
_UR = "def t():\n  movel(p[-0.481815, 0.132142, 0.684153, -0.5, -0.3, 0.2])\nend\n"
_STATED = "--frame 0,0,0,0,0,0 --tool 0,0,0,0,0,0"
_LINES = """
export a --program t.src
export a --program t.src -o c.src
export a --program t.src -o c.txt
export a --program t.src -o t.src
export a --program t.src -o nowhere/c.src
export a --program nowhere.src -o c.src
export a --program p -o c.src
export r --program t.src -o c.src STATED
export s --program t.src -o c.src STATED
export a --program t.src -o c.src --frame 1,2 --tool 0,0,0,0,0,0
export a --program t.src -o c.src --frame 0,0,0,0,0,nan --tool 0,0,0,0,0,0
export a --program t.src -o c.src --frame 1e300,0,0,0,0,0 --tool 0,0,0,0,0,0
export a --program t.src -o c.src STATED --limit nan
export a --program t.src -o c.src STATED --limit 0
export a --program t.src -o c.src STATED --limit 1e-6
export a --program t.src -o c.src STATED --near x
export a --program t.src -o c.src STATED --near nan,0,0,0,0,0
export a --program t.src -o c.src STATED --j3 x
export a
export a --to nonsense
export a --to ros --program t.src
export r --to ply
export r --to glb -o nowhere/x.glb
export r --to ply -o s/session.toml
export nowhere --to ros
"""


def _program(text: str | bytes, line: str, file: str = "t.src") -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        (room / file).write_bytes(text if isinstance(text, bytes) else text.encode())
        return line.replace("STATED", _STATED).split()

    return spoil


def programs() -> Iterator[Case]:
    """Programs as editors and people leave them."""
    line = "export a --program t.src -o c.src STATED"
    for name, text in {
        "empty": "",
        "no points": "DEF t()\nEND\n",
        "NaN": _KRL.replace("-481.815", "nan"),
        "400 digits": _KRL.replace("-481.815", "9" * 400),
        "1e29": _KRL.replace("-481.815", "1e29"),
        "a word": _KRL.replace("-481.815", "abc"),
        "decimal comma": _KRL.replace("-481.815", "-481,815"),
        "out of reach": _KRL.replace("-481.815", "-9481.815"),
        "an angle less": _KRL.replace("A 17.154,", ""),
        "a joint less": _KRL.replace(",A6 -36.507", ""),
        "a name alone": _KRL.replace("END", "LIN XP1\nEND"),
        "relative": _KRL.replace("LIN", "LIN_REL"),
        "external axis": _KRL.replace("29.927}", "29.927,E1 300}"),
        "open brace": _KRL.replace("29.927}", "29.927"),
        "arcs alone": "DEF t()\nCIRC {X 1,Y 2,Z 3},{X 1,Y 2,Z 3,A 0,B 0,C 0}\nEND\n",
        "binary": bytes(range(256)) * 40,
        "UTF-16": _KRL.encode("utf-16"),
    }.items():
        yield Case("programs", name, _program(text, line))
    for told in _LINES.strip().splitlines():
        yield Case("what is exported", told, _program(_KRL, told))
    for name, text, file in (
        ("decimal comma of a FANUC", _LS.replace("-481.815", "-481,815"), "t.ls"),
        ("decimal comma of a UR", _UR.replace("-0.481815", "-0,481815"), "t.script"),
    ):
        yield Case(
            "programs", name, _program(text, line.replace("t.src", file).replace("c.src", f"c.{file[2:]}"), file)
        )
    umlaut = _KRL.replace("END", "; größer\nEND").encode("cp1252")
    yield Case("programs that are right", "cp1252", _program(umlaut, line), fine=True, writes=("c.src",))
