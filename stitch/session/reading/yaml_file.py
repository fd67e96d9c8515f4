"""YAML as calibration tools write it: mappings, lists and numbers; no aliases, no types, no code.

PyYAML splits the text; what a word means is decided here, as YAML's own rules take 1e-3 for text and 9:14 for a
number. OpenCV heads its files with `%YAML:1.0`, which is no directive of YAML.
"""

import re
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import Any

import yaml

from stitch.errors import InputError
from stitch.session.reading.csv_files import is_number

_HEAD_OF_OPENCV = re.compile(r"\A%YAML:.*")
_DEEPEST = 50


def parse_yaml(file: Path, text: str) -> list[Any]:
    """Return the documents of a text, empty ones left out.

    Raises:
        InputError: no YAML, an alias, or lists nested too deeply; names the line.
    """
    events = yaml.parse(_HEAD_OF_OPENCV.sub("", text), Loader=yaml.CBaseLoader)
    try:
        documents = [_value(file, next(events), events) for e in events if isinstance(e, yaml.DocumentStartEvent)]
    except yaml.MarkedYAMLError as error:
        # The mark of a bracket that stays open stands behind the last line.
        line = min(error.problem_mark.line + 1, len(text.splitlines()))
        words = ": ".join(words for words in (error.context, error.problem) if words)
        words = re.sub(r"flow (sequence|mapping)", "list in brackets", words)
        raise InputError(f"{file} line {line}: no YAML that is known ({words}); to fix: correct it there") from None
    except yaml.reader.ReaderError as error:
        line = text.encode()[: error.position].count(b"\n") + 1
        raise InputError(f"{file} line {line}: {error.reason}; to fix: correct it there") from None
    return [document for document in documents if document is not None]


def _value(file: Path, event: yaml.Event, events: Iterator[yaml.Event], depth: int = 0) -> Any:
    """Return the number, text, list or dict that begins with an event of the parser; later events are taken as needed.

    Args:
        depth: of nesting, which is limited.

    Raises:
        InputError: an alias, a key that is no word, or too deep nesting.
    """
    line = f"{file} line {event.start_mark.line + 1}"
    if depth > _DEEPEST:
        raise InputError(f"{line}: nested too deeply; to fix: write plain lists")
    if isinstance(event, yaml.AliasEvent):
        raise InputError(f"{line}: refers to what stands elsewhere (*{event.anchor}); to fix: write it out")
    if isinstance(event, yaml.ScalarEvent):
        return _scalar(event)
    items = takewhile(lambda item: not isinstance(item, yaml.CollectionEndEvent), events)
    if isinstance(event, yaml.SequenceStartEvent):
        return [_value(file, item, events, depth + 1) for item in items]
    table = {}
    for key in items:
        if not isinstance(key, yaml.ScalarEvent):
            raise InputError(f"{file} line {key.start_mark.line + 1}: a key is no word; to fix: write a word there")
        table[key.value] = _value(file, next(events), events, depth + 1)
    return table


def _scalar(event: yaml.ScalarEvent) -> float | str | None:
    """Return a single value as a number if Python reads one, else as text; None where it is empty, without quotes."""
    if event.style:  # in quotes
        return str(event.value)
    return float(event.value) if is_number(event.value) else event.value or None
