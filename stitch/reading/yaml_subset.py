"""YAML as calibration tools write it: mappings, lists and numbers; no anchors, no types, no code.

What ROS, OpenCV and vendors of scanners write needs mappings by indentation, lists in brackets or with dashes,
comments, and OpenCV's head and tags (`%YAML:1.0`, `!!opencv-matrix`). Anything else is refused, not guessed.
"""

import re
from pathlib import Path
from typing import Any

from stitch.errors import InputError
from stitch.reading.csv_number import is_number
from stitch.reading.text_file import shortened

_KEY = re.compile(r"""("[^"]*"|'[^']*'|[^\s\[\]{},#:'"][^\[\]{},#:]*?)\s*:(?=\s|$)""")
_TAG = re.compile(r"!!?[\w-]+\s*")
_TOKEN = re.compile(r"""[\[\]{},:]|"[^"]*"|'[^']*'|[^\s\[\]{},:][^\[\]{},:]*""")
_DEEPEST = 50
Line = tuple[int, int, str]  # number, indentation, text


def parse_yaml(file: Path, told: str) -> list[Any]:
    """The documents of a text.

    Raises:
        InputError: what this subset does not know; names the line.
    """
    documents: list[list[Line]] = [[]]
    for number, line in enumerate(told.splitlines(), 1):
        plain = _without_comment(line).rstrip()
        if plain.strip() in ("---", "..."):
            documents.append([])
        elif plain.strip() and not (plain.startswith("%") and number < 3):
            documents[-1].append((number, len(plain) - len(plain.lstrip()), plain.strip()))
    return [_document(file, _joined(file, lines)) for lines in documents if lines]


def _document(file: Path, lines: list[Line]) -> Any:
    block = _Block(file, lines)
    value = block.value(0)
    if block.at < len(lines):
        number, _, text = lines[block.at]
        raise InputError(f"{file} line {number}: {shortened(text)} is no YAML that is known; to fix: use JSON")
    return value


def _without_comment(line: str) -> str:
    return re.sub(r"(^|\s)#.*$", "", line)


def _joined(file: Path, lines: list[Line]) -> list[Line]:
    """A list in brackets that runs over several lines becomes one line."""
    out: list[Line] = []
    open_ = 0
    for number, indent, text in lines:
        if open_ > 0 or (out and text[0] in "[{" and out[-1][2].endswith(":") and indent > out[-1][1]):
            start = out[-1]
            out[-1] = (start[0], start[1], f"{start[2]} {text}")
        else:
            out.append((number, indent, text))
        open_ += sum(text.count(c) for c in "[{") - sum(text.count(c) for c in "]}")
    if open_:
        raise InputError(f"{file} line {out[-1][0]}: a bracket is not closed; to fix: close it")
    return out


class _Block:
    """Reads lines by indentation."""

    def __init__(self, file: Path, lines: list[Line]) -> None:
        self.file, self.lines, self.at = file, lines, 0

    def value(self, depth: int) -> Any:
        """The list, mapping or scalar that begins at the current line."""
        number, indent, text = self.lines[self.at]
        if depth > _DEEPEST:
            raise InputError(f"{self.file} line {number}: nested too deeply; to fix: write plain lists")
        if text == "-" or text.startswith("- "):
            return self._list(indent, depth)
        if _KEY.match(text):
            return self._mapping(indent, depth)
        self.at += 1
        return _inline(self.file, number, text)

    def _list(self, indent: int, depth: int) -> list[Any]:
        out = []
        while self.at < len(self.lines):
            number, own, text = self.lines[self.at]
            if own != indent or not (text == "-" or text.startswith("- ")):
                break
            rest = text[1:].lstrip()
            if not rest:
                self.at += 1
                out.append(self._below(indent, depth))
                continue
            self.lines[self.at] = (number, own + len(text) - len(rest), rest)
            out.append(self.value(depth + 1))
        return out

    def _mapping(self, indent: int, depth: int) -> dict[str, Any]:
        out: dict[str, Any] = {}
        while self.at < len(self.lines):
            number, own, text = self.lines[self.at]
            found = _KEY.match(text)
            if own != indent or found is None:
                break
            rest = _TAG.sub("", text[found.end() :].strip(), count=1) if "!" in text else text[found.end() :].strip()
            self.at += 1
            out[found[1].strip("\"'")] = _inline(self.file, number, rest) if rest else self._below(indent, depth)
        return out

    def _below(self, indent: int, depth: int) -> Any:
        """What is written under a key or a dash; None if nothing is."""
        if self.at >= len(self.lines):
            return None
        _, own, text = self.lines[self.at]
        deeper = own > indent or (own == indent and text.startswith("-"))
        return self.value(depth + 1) if deeper else None


def _inline(file: Path, number: int, text: str) -> Any:
    """A scalar, or a list or mapping in brackets."""
    if text[0] not in "[{":
        return _scalar(text)
    tokens = [token.strip() for token in _TOKEN.findall(text)]
    value, rest = _bracketed(file, number, tokens, 0)
    if rest != len(tokens):
        raise InputError(f"{file} line {number}: text after a closed bracket; to fix: write one value a line")
    return value


def _bracketed(file: Path, number: int, tokens: list[str], at: int, depth: int = 0) -> tuple[Any, int]:
    if depth > _DEEPEST or at >= len(tokens):
        raise InputError(f"{file} line {number}: brackets do not match; to fix: close them")
    if tokens[at] not in ("[", "{"):
        return _scalar(tokens[at]), at + 1
    close = "]" if tokens[at] == "[" else "}"
    items: list[Any] = []
    table: dict[str, Any] = {}
    at += 1
    while at < len(tokens) and tokens[at] != close:
        if tokens[at] == ",":
            at += 1
            continue
        if close == "}" and at + 1 < len(tokens) and tokens[at + 1] == ":":
            table[tokens[at].strip("\"'")], at = _bracketed(file, number, tokens, at + 2, depth + 1)
        else:
            item, at = _bracketed(file, number, tokens, at, depth + 1)
            items.append(item)
    if at >= len(tokens):
        raise InputError(f"{file} line {number}: brackets do not match; to fix: close them")
    return (table if close == "}" else items), at + 1


def _scalar(text: str) -> Any:
    text = text.strip()
    if text[:1] in "\"'" and text[-1:] == text[:1]:
        return text[1:-1]
    return float(text) if is_number(text) else text
