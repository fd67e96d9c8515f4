"""Results as values: equal where what they hold is equal, and read as plain data, as a table of Arrow or pandas.

A class of results says where the document of it is made that a command writes, and which list of that document is its
table. The place is a text, as of an entry point: the class stands below the room that writes.
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from functools import partial
from pkgutil import resolve_name
from typing import Any, ClassVar, TypeVar

import numpy as np

from stitch.system.packages import import_extra

Item = TypeVar("Item")


class Value:
    """A base of dataclasses that compare by what they hold, arrays included, and become plain data; NaN equals NaN.

    A subclass names the function that makes its document, as "module:function": `class Run(Value, document=…)`.
    """

    _document: ClassVar[str] = ""  # module:function that returns the document of one
    _table: ClassVar[str] = ""  # key of the document's rows

    def __init_subclass__(cls, document: str = "", table: str = "", **options: Any) -> None:
        super().__init_subclass__(**options)
        cls._document = document or cls._document
        cls._table = table or cls._table

    def to_dict(self) -> dict[str, Any]:
        """Return it as numbers, texts, lists and tables, with the keys of the file that a command writes of it.

        Example:
            >>> stitch.diagnose(run).to_dict()["verdict"]
            'adequate'
        """
        if self._document:
            return dict(resolve_name(self._document)(self))
        return {name: plain(value) for name, value in self._stored().items()}

    def _stored(self) -> dict[str, Any]:
        """Return the fields that count in comparisons, name -> value."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.compare}  # type: ignore[arg-type]

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other) or not isinstance(other, Value):
            return NotImplemented
        return self is other or same(self._stored(), other._stored())

    def __hash__(self) -> int:
        return hash((type(self), *(value for value in self._stored().values() if isinstance(value, str | int))))


class Table(Value):
    """A value that has rows."""

    def rows(self) -> list[dict[str, Any]]:
        """Return the rows of the table, each by the names of its columns.

        Example:
            >>> [row["view"] for row in run.rows()][:2]
            ['v000', 'v001']
        """
        return list(self.to_dict()[self._table])

    def to_arrow(self) -> Any:
        """Return the rows as a pyarrow.Table.

        Example:
            >>> run.to_arrow().num_rows
            5
        """
        return import_extra("pyarrow", "to_arrow", "tables").Table.from_pylist(self.rows())

    def to_pandas(self) -> Any:
        """Return the rows as a pandas.DataFrame.

        Raises:
            InputError: pandas is not installed.

        Example:
            >>> len(run.to_pandas())
            5
        """
        return import_extra("pandas", "to_pandas", "tables").DataFrame(self.rows())


def take_rows(item: Item, index: Any, *names: str) -> Item:
    """Return a copy of a dataclass in which the fields of these names hold only the rows at `index`.

    Args:
        index: whatever indexes the first axis of an array; where a field is a tuple, integers.
        names: fields that hold an array, a dict of arrays, or a tuple. None and () stay as they are.
    """

    def rows(held: Any) -> Any:
        """Return the rows at `index` of the value of one field."""
        if held is None:
            return None
        if isinstance(held, tuple):
            return tuple(held[i] for i in index) if held else ()
        return {name: column[index] for name, column in held.items()} if isinstance(held, dict) else held[index]

    return replace(item, **{name: rows(getattr(item, name)) for name in names})  # type: ignore[type-var]


def same(a: Any, b: Any, within: float = 0.0) -> bool:
    """Return whether two values hold the same at every depth: same types, shapes, keys and numbers; NaN equals NaN.

    Args:
        within: tolerance of numbers, absolute and relative, as `rtol` and `atol` of numpy.allclose; 0: exactly equal.
    """
    if a is b:
        return True
    if isinstance(a, Value) or isinstance(b, Value):
        return bool(a == b)
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        if np.shape(a) != np.shape(b) or np.asarray(a).dtype != np.asarray(b).dtype:
            return False
        if np.asarray(a).dtype.kind not in "fcmM":
            return bool(np.array_equal(a, b))
        return bool(
            np.allclose(a, b, within, within, equal_nan=True) if within else np.array_equal(a, b, equal_nan=True)
        )
    if type(a) is not type(b):
        return False
    if isinstance(a, Mapping):
        return a.keys() == b.keys() and all(same(a[key], b[key], within) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y, within) for x, y in zip(a, b, strict=True))
    if isinstance(a, partial):
        return same((a.func, a.args, a.keywords), (b.func, b.args, b.keywords))
    if is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name), within) for f in fields(a) if f.compare)
    if within and isinstance(a, float):
        return bool(np.isclose(a, b, within, within, equal_nan=True))
    return bool(a == b) or (a != a and b != b)  # the latter: both are NaN


def plain(value: Any) -> Any:
    """Return a value as plain data for JSON: numbers, texts, lists and dicts, at every depth.

    A function or a class becomes its qualified name; any other object its text.
    """
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Value):
        return value.to_dict()
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(inner) for inner in value]
    if is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    return getattr(value, "__qualname__", None) or str(value)
