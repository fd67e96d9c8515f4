"""Poses in JSON, YAML and XML: lists, matrices and mappings, however deep, as rows of named numbers."""

import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from typing import Any

from stitch.plugins.intake.pose_formats import PoseRow
from stitch.plugins.intake.pose_tables import parse_number

_LAST_NUMBER = re.compile(r"\d+(?=\D*$)")
# Sizes of a bare list of numbers that can be a pose or joint angles.
_SIZES = (5, 6, 7, 8, 9, 12, 16)
_MATRICES = ((3, 3), (3, 4), (4, 4), (1, 3), (3, 1), (1, 4), (4, 1))


def nested_lists(document: Any, texts: tuple[str, ...] = ()) -> dict[str, list[PoseRow]]:
    """Return lists of rows by their path in a document; numbers without names are called 0, 1, 2 …

    A pose may be a list of numbers, a matrix, or a mapping; poses may stand in a list, or in a mapping by name. Texts
    beside a pose, or above it, belong to its row.
    """
    out: dict[str, list[PoseRow]] = {}
    own = _pose_numbers(document)
    if own is not None:
        out[""] = [((*texts, *_texts(document)), own)]
    if isinstance(document, list) and own is None:
        for item in document:
            for path, rows in nested_lists(item, texts).items():
                out.setdefault(path, []).extend(rows)
    if isinstance(document, dict):
        named = [((str(key), *texts, *_texts(value)), _pose_numbers(value)) for key, value in document.items()]
        direct = [(words, row) for words, row in named if row is not None]
        # gripper_1, target_1, gripper_2 … are two lists.
        stems = Counter(_LAST_NUMBER.sub("#", words[0]) for words, _ in direct)
        several = len(stems) > 1 and (min(stems.values()) > 1 or len({tuple(row) for _, row in direct}) > 1)
        for stem in stems if several else [""]:
            alike = [(words, row) for words, row in direct if not stem or _LAST_NUMBER.sub("#", words[0]) == stem]
            if len(alike) > 1 and len({tuple(row) for _, row in alike}) == 1:
                out[stem.replace("#", "").strip("_- ")] = alike
        of_one_kind = several or len(stems) == 1
        listed = {words[0] for rows in out.values() for words, _ in rows if words and of_one_kind}
        for key, value in ((key, value) for key, value in document.items() if str(key) not in listed):
            below = nested_lists(value, (*texts, *_texts(document)))
            out |= {f"{key}.{path}".strip("."): rows for path, rows in below.items()}
    return out


def xml_document(element: ElementTree.Element) -> Any:
    """An element as JSON would have it: attributes and children by name, several of one name as a list."""
    cells = (element.text or "").split()
    if not len(element) and not element.attrib:
        numbers = [x for cell in cells if (x := parse_number(cell)) is not None]
        return " ".join(cells) if len(numbers) < max(len(cells), 1) else numbers[0] if len(numbers) == 1 else numbers
    out: dict[str, Any] = {}
    for name, cell in element.attrib.items():
        number = parse_number(cell)
        out[name] = cell if number is None else number
    for tag in dict.fromkeys(child.tag for child in element):
        children = [xml_document(child) for child in element if child.tag == tag]
        out[tag] = children[0] if len(children) == 1 else children
    return out


def _pose_numbers(value: Any) -> dict[str, float] | None:
    """The numbers of one pose by name, or None if a value is none."""
    flat = _flat_numbers(value)
    if flat is not None:
        return {str(i): x for i, x in enumerate(flat)} if len(flat) in _SIZES else None
    if not isinstance(value, dict):
        return None
    data = _matrix_numbers(value)
    if data is not None:
        return {str(i): x for i, x in enumerate(data)}
    inner = next((row for v in value.values() if isinstance(v, dict) and (row := _pose_numbers(v)) is not None), None)
    if inner is not None:
        # The pose stands one level deeper, beside a time, a temperature or a name.
        unnamed = all(name.isdigit() for name in inner)
        beside = _ros_stamp(value) | {k: float(x) for k, x in value.items() if _is_number(x)}
        return inner if unnamed else beside | inner
    out = _named_numbers(value)
    return out if len(out) >= _SIZES[0] else None


def _ros_stamp(value: dict[str, Any]) -> dict[str, float]:
    """The time of a message of ROS, 1 or 2, from its header; nothing where none is written."""
    header = value.get("header")
    stamp = header.get("stamp") if isinstance(header, dict) else None
    if not isinstance(stamp, dict):
        return {}
    whole, part = stamp.get("sec", stamp.get("secs")), stamp.get("nanosec", stamp.get("nsecs", 0))
    if not (isinstance(whole, (int, float)) and isinstance(part, (int, float)) and whole > 0):
        return {}
    return {"time_s": whole + 1e-9 * part}


def _matrix_numbers(value: dict[str, Any]) -> list[float] | None:
    """16 numbers that stand alone in a mapping: OpenCV's and Zivid's layouts."""
    inner = [v for v in value.values() if isinstance(v, (list, dict))]
    if len(inner) != 1 and not {"rows", "cols", "data"} <= {*value}:
        lists = [flat for v in inner if (flat := _flat_numbers(v)) is not None and len(flat) == 16]
        return lists[0] if len(lists) == 1 else None
    if len(inner) != 1:
        return None
    flat = _flat_numbers(inner[0])
    if flat is not None:
        return flat if len(flat) in (12, 16) or ("rows" in value and len(flat) in (3, 9)) else None
    return _matrix_numbers(inner[0]) if isinstance(inner[0], dict) else None


def _flat_numbers(value: Any) -> list[float] | None:
    """The numbers of a list, or of a matrix row by row; None if it is neither."""
    if not isinstance(value, list) or not value:
        return None
    if all(_is_number(item) for item in value):
        return [float(item) for item in value]
    rows = [_flat_numbers(item) for item in value if isinstance(item, list) and all(_is_number(x) for x in item)]
    shape = (len(value), *{len(row) for row in rows if row is not None})
    if len(rows) < len(value) or shape not in _MATRICES:
        return None
    return [x for row in rows if row is not None for x in row]


def _named_numbers(value: dict[str, Any], prefix: str = "") -> dict[str, float]:
    """Numbers of a mapping by their path: position.x, rotation.0 …"""
    out: dict[str, float] = {}
    for key, item in value.items():
        name = f"{prefix}{key}"
        flat = _flat_numbers(item)
        if _is_number(item):
            out[name] = float(item)
        elif flat is not None:
            out |= {f"{name}.{i}": x for i, x in enumerate(flat)}
        elif isinstance(item, dict) and name.count(".") < 5:
            out |= _named_numbers(item, f"{name}.")
    return out


def _texts(value: Any) -> tuple[str, ...]:
    """Texts that stand beside the numbers of a pose."""
    return tuple(item for item in value.values() if isinstance(item, str)) if isinstance(value, dict) else ()


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
