"""A document as a table of its keys: one line says how a value is written, what is checked of it, and what it fills.

What writes a document and what reads it follow the same table, so that a key stands in one place.
"""

import json
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stitch.errors import InputError
from stitch.session.reading.text_files import read_text, shortened
from stitch.system.values import plain

Schema = dict[str, Any]


def number(value: float | None) -> float:
    """Return a number that may be null: JSON has no NaN."""
    return float("nan") if value is None else float(value)


@dataclass(frozen=True)
class Kind:
    """A type of values in a document: its JSON Schema, how a value is written as JSON, and how it is read back.

    An empty schema means that stitch only writes the value and never reads it again.
    """

    schema: Schema
    write: Callable[[Any], Any] = plain
    read: Callable[[Any], Any] = lambda value: value


ANYTHING = Kind({})  # that stitch does not read again
TEXT = Kind({"type": "string"})
NUMBER = Kind({"type": "number"})
NUMBER_OR_NULL = Kind({"type": ["number", "null"]}, read=number)
COUNT = Kind({"type": "integer", "minimum": 0})


def list_of(kind: Kind, length: int | None = None) -> Kind:
    """Return the kind of a list with items of one kind, read as a tuple.

    Args:
        length: number of items; None: any.
    """
    exact = {} if length is None else {"minItems": length, "maxItems": length}
    return Kind(
        {"type": "array", "items": kind.schema, **exact},
        lambda values: [kind.write(value) for value in values],
        lambda values: tuple(kind.read(value) for value in values),
    )


def table_of(kind: Kind) -> Kind:
    """Return the kind of a JSON object with any keys and values of one kind, read as a dictionary."""
    return Kind(
        {"type": "object", "additionalProperties": kind.schema},
        lambda values: {key: kind.write(value) for key, value in values.items()},
        lambda values: {key: kind.read(value) for key, value in values.items()},
    )


def array_of(*shape: int) -> Kind:
    """Return the kind of an array of this shape, nested lists in JSON, read as an array of float64."""
    kind = NUMBER
    for length in reversed(shape):
        kind = list_of(kind, length)
    return Kind(kind.schema, plain, lambda rows: np.array(rows, float))


def rows_of(fields: str) -> Kind:
    """Return the kind of a list that is not read again: a row an item, with some of its fields."""
    return Kind({}, Document(*map(Key, fields.split())).rows().write)


TEXTS = list_of(TEXT)
MATRIX = array_of(4, 4)


class Key(NamedTuple):
    """One key of a document."""

    name: str
    kind: Kind = ANYTHING
    attribute: str = ""  # of the source, a.b, if that is called otherwise; when it is read, it fills the field b
    of: type | None = None  # whose field that is, where a document fills several
    write: Callable[[Any], Any] | None = None  # what is written of the source in place of its attribute
    when: Callable[[Any], Any] | None = None  # of the source: else it is not written
    optional: bool = False  # earlier versions lack it


class Document:
    """A document, or a row of one, as a table of its keys in their order."""

    def __init__(self, *keys: Key) -> None:
        self.keys = keys

    @property
    def schema(self) -> Schema:
        """JSON Schema that a document has to match before it is read; keys that are never read are not in it."""
        checked = [key for key in self.keys if key.kind.schema]
        return {
            "type": "object",
            "properties": {key.name: key.kind.schema for key in checked},
            "required": [key.name for key in checked if not key.optional and key.when is None],
        }

    def write(self, source: Any) -> dict[str, Any]:
        """Return the document of an object: each key holds what `write`, or else the attribute, gives of it."""
        return {
            key.name: key.kind.write((key.write or attrgetter(key.attribute or key.name))(source))
            for key in self.keys
            if key.when is None or key.when(source)
        }

    def fields(self, document: dict[str, Any], of: type | None = None) -> dict[str, Any]:
        """Return field -> value, read by its kind, of the keys of a document that fill the fields of a class.

        A key that is optional or conditional may be absent; then its field is too, and the class has a default.

        Args:
            document: JSON that matches the schema.
            of: the class; only keys with this class in `Key.of` are read. None: keys without one.
        """
        return {
            (key.attribute or key.name).rpartition(".")[2]: key.kind.read(document[key.name])
            for key in self.keys
            if key.of is of and key.kind.schema and (key.name in document or not (key.optional or key.when))
        }

    def kind(self, build: Callable[..., Any] = dict) -> Kind:
        """Return the kind of one such object, read as what is built of its fields."""
        return Kind(self.schema, self.write, lambda row: build(**self.fields(row)))

    def or_null(self) -> Kind:
        """Return the kind of one such object that is not read again; null where there is none."""
        return Kind({}, lambda source: None if source is None else self.write(source))

    def rows(self, build: Callable[..., Any] = dict) -> Kind:
        """Return the kind of a list of such objects."""
        return list_of(self.kind(build))


def read_checked(file: Path, schema: Schema) -> Any:
    """Return what a JSON file of a run folder holds, checked by a JSON Schema.

    Raises:
        InputError: no run folder, no JSON, or an entry of another kind than stitch writes.
    """
    # Most commands that write a run read none.
    from jsonschema import Draft202012Validator
    from jsonschema.exceptions import best_match
    from jsonschema.validators import extend

    def items(validator: Any, items: Any, values: Any, schema: Any) -> Iterator[Any]:
        """Check the items of a list as jsonschema does, but a list of numbers at once."""
        # Most of a result are numbers: checked one by one they take as long as reading the whole session.
        all_numbers = isinstance(values, list) and all(type(value) in (int, float) for value in values)
        if not (items == NUMBER.schema and all_numbers):
            yield from Draft202012Validator.VALIDATORS["items"](validator, items, values, schema)

    hint = "name a run folder that `stitch run` wrote"
    if (file.parent / "session.toml").is_file():
        hint = f"this is a session; to fix: `stitch run {shlex.quote(str(file.parent))} -o RUN` first, then name RUN"
    text = read_text(file, hint)
    try:
        document = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: damaged ({shortened(str(error))}); to fix: run `stitch run` again") from None
    wrong = best_match(extend(Draft202012Validator, {"items": items})(schema).iter_errors(document))
    if wrong is not None:
        place = ".".join(str(step) for step in wrong.absolute_path) or "the document"
        raise InputError(f"{file}: damaged ({place}: {shortened(wrong.message, 160)}); to fix: run `stitch run` again")
    return document


def _refuse_constant(word: str) -> float:
    raise ValueError(f"{word} is no number")
