"""What is worked out of a run or a diagnosis once, and kept on the object itself as `cached_property` keeps a value.

Both stand in rooms below this one, which cannot name what is made of them here.
"""

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import TypeVar

Subject = TypeVar("Subject")
Value = TypeVar("Value")


def remembered(function: Callable[[Subject], Value]) -> Callable[[Subject], Value]:
    """Return the function with its value kept on what it is asked of; another thread that asks meanwhile waits."""
    key = f"{function.__module__}.{function.__qualname__}"
    lock = RLock()

    @wraps(function)
    def kept(subject: Subject) -> Value:
        with lock:
            values = vars(subject)
            if key not in values:
                values[key] = function(subject)
            value: Value = values[key]
            return value

    return kept
