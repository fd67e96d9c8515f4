"""Bad inputs: scans, and the robot's description."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from fault_room import Case
from fault_sessions import RUN, instead, with_key, with_toml
from plyfile import PlyData

_HEADER = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
_PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA {1}\n"
_HUGE = 10**12


def _as(name: str, content: str | bytes, session: str = "s") -> Callable[[Path], list[str]]:
    """The second view's cloud under another name with this content."""

    def spoil(room: Path) -> list[str]:
        (room / session / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        views = room / session / "views.csv"
        views.write_text(views.read_text().replace("clouds/v001.ply", name))
        return RUN

    return spoil


def _points(change: Callable[[np.ndarray], np.ndarray], every: bool = False) -> Callable[[Path], list[str]]:
    """The points (N, 3) of the second view, or of every view, changed."""

    def spoil(room: Path) -> list[str]:
        for file in sorted((room / "s" / "clouds").glob("*.ply") if every else [room / "s" / "clouds" / "v001.ply"]):
            vertex = PlyData.read(str(file))["vertex"]
            new = change(np.column_stack([vertex[axis] for axis in "xyz"]).astype(float))
            lines = "\n".join(" ".join(f"{x:.6f}" for x in row) for row in new)
            file.write_text(_HEADER.format("ascii", len(new)) + lines + "\n")
        return RUN

    return spoil


def _at(row: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(points: np.ndarray) -> np.ndarray:
        points[row, 0] = value
        return points

    return change


def cloud_headers() -> Iterator[Case]:
    """Headers that promise too much, or nothing that can be read."""
    for encoding in ("ascii", "binary_little_endian", "binary_big_endian"):
        for count in (_HUGE, 10**30, 7, -3, "x"):
            yield Case("PLY headers", f"{encoding} {count}", _as("c.ply", _HEADER.format(encoding, count) + "1 2 3\n"))
    lists = _HEADER.format("ascii", 1).replace(
        "end_header", f"element face {_HUGE}\nproperty list uchar int v\nend_header"
    )
    for name, text in {
        "no end": "ply\nformat ascii 1.0\nelement vertex 3\n",
        "no x": _HEADER.format("ascii", 3).replace("float x", "float u") + "1 2 3\n" * 3,
        "faces": lists + "1 2 3\n",
        "another format": _HEADER.format("quaternary", 1) + "1 2 3\n",
        "list of x": _HEADER.format("ascii", 1).replace("float x", "list uchar float x") + "1 2 3 4\n",
    }.items():
        yield Case("PLY headers", name, _as("c.ply", text))
    for encoding in ("ascii", "binary", "binary_compressed", "zip"):
        for count in (_HUGE, 10**30, 50, -1, "x"):
            yield Case(
                "PCD headers", f"{encoding} {count}", _as("c.pcd", _PCD.format(count, encoding) + "1 2 3\n4 5 6\n")
            )
    size = (2**32 - 1).to_bytes(4, "little")
    yield Case(
        "PCD headers",
        "4 GB unpacked",
        _as("c.pcd", _PCD.format(3, "binary_compressed").encode() + size * 2 + b"\xff" * 99),
    )
    yield Case(
        "PCD headers", "large counts", _as("c.pcd", _PCD.format(3, "binary").replace("COUNT 1", f"COUNT {_HUGE}"))
    )


def clouds() -> Iterator[Case]:
    """Scans that are no scans, or hold what no scanner measures."""
    for what in ("pipe", "folder", "dangling link", "device", "empty", "noise"):
        yield Case("cloud is no file", what, instead("s/clouds/v001.ply", what, RUN))
    for name, text in {
        "words": "a b c\nd e f\n",
        "two columns": "1 2\n3 4\n",
        "ragged": "1 2 3\n4 5\n",
        "empty": "",
        "comma for point": "1,5;2,5;3,5\n" * 9,
        "header alone": "x,y,z\n",
        "binary": "\x00\x01\x02" * 50,
    }.items():
        yield Case("clouds as text", name, _as("c.csv", text))
    yield Case("clouds as text", "suffix .stl", _as("c.stl", "solid"))
    for value in (1e30, -1e30, 1e9, np.nan, np.inf, 3e38):
        yield Case("single points", f"{value:g}", _points(_at(5, value)))
    yield Case("few points", "none measured", _points(lambda p: p * 0))
    yield Case("few points", "two", _points(lambda p: p[:2]))
    yield Case("few points", "none", _points(lambda p: p[:0]))
    for name, factor in {"metres": 1e-3, "micrometres": 1e3}.items():
        yield Case("clouds in another unit", name, _points(lambda p, f=factor: p * f, every=True))
    yield Case("origin in the volume", "", _origin_in_volume, fine=True)


def _origin_in_volume(room: Path) -> list[str]:
    """The same scans by a scanner whose frame stands where it measures; the hand-eye moved with it."""
    import tomllib

    import tomli_w

    file = room / "s" / "session.toml"
    document = tomllib.loads(file.read_text())
    T = np.array(document["scanner"]["pose"])
    seen = PlyData.read(str(room / "s" / "clouds" / "v000.ply"))["vertex"]
    middle = np.array([np.median(seen[axis]) for axis in "xyz"])
    T[:3, 3] += T[:3, :3] @ middle
    document["scanner"]["pose"] = T.tolist()
    file.write_text(tomli_w.dumps(document))
    return _points(lambda p: p - middle, every=True)(room)


_URDF = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/>
<joint name="j" type="{kind}"><parent link="{parent}"/><child link="b"/><axis xyz="{axis}"/>{more}</joint></robot>"""


def robots() -> Iterator[Case]:
    """URDF and DH rows that describe no arm."""
    laughs = '<!DOCTYPE r [<!ENTITY a "ha">' + "".join(
        f'<!ENTITY {chr(98 + i)} "{f"&{chr(97 + i)};" * 10}">' for i in range(12)
    )
    texts = {
        "no XML": "robot",
        "laughs": laughs + "]><robot>&m;</robot>",
        "outside": '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"/>',
        "prismatic": _URDF.format(kind="prismatic", parent="a", axis="0 0 1", more=""),
        "loop": _URDF.format(kind="revolute", parent="b", axis="0 0 1", more=""),
        "no axis": _URDF.format(kind="revolute", parent="a", axis="0 0 0", more=""),
        "words": _URDF.format(kind="revolute", parent="a", axis="x y z", more=""),
        "no link": "<robot><joint name='j' type='revolute'/></robot>",
        "mimic": _URDF.format(kind="revolute", parent="a", axis="0 0 1", more='<mimic joint="k"/>'),
        "deep": "<a>" * 100_000,
        "huge": _URDF.format(kind="revolute", parent="a", axis="1e400 0 0", more=""),
    }
    for name, text in texts.items():
        yield Case("URDF", name, _urdf(text))
    for name, rows in {
        "no rows": "[]",
        "a number": "5",
        "words": '["a"]',
        "unknown key": "[{ alpha = 3 }]",
        "text": '[{ a = "x" }]',
        "NaN": "[{ a = nan }]",
        "negative mass": "[{ mass = -2 }]",
        "400 digits": f"[{{ a = {'9' * 400} }}]",
        "deep": f"[{{ a = {'[' * 90}{']' * 90} }}]",
        "one joint": "[{ a = 5 }]",
    }.items():
        yield Case("DH rows", name, with_toml(with_key("robot.joints", rows)))


def _urdf(text: str) -> Callable[[Path], list[str]]:
    def spoil(room: Path) -> list[str]:
        (room / "s" / "arm.urdf").write_text(text)
        value = '"arm.urdf"\nbase_link = "a"\nflange_link = "b"'
        return with_toml(with_key("robot.urdf", value))(room)

    return spoil
