"""Two caches: one keeps the most recently used values, one keeps values while an object exists."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

_Key = TypeVar("_Key", bound=Hashable)
_Value = TypeVar("_Value")


class LruCache(Generic[_Key, _Value]):
    """A cache that keeps the most recently used values, up to a number of values and a number of bytes.

    Args:
        max_count: Largest number of values.
        max_bytes: Largest sum of ``nbytes``; if None, there is no limit.
        min_count: Number of values that are cached even if they exceed ``max_bytes``.
        nbytes: Returns the memory of a value; the memory may grow while the value is cached.
    """

    def __init__(
        self,
        max_count: int,
        max_bytes: int | None = None,
        min_count: int = 1,
        nbytes: Callable[[_Value], int] = lambda value: 0,
    ) -> None:
        self._values: dict[_Key, _Value] = {}
        self._max_count, self._max_bytes, self._min_count = max_count, max_bytes, min_count
        self._nbytes = nbytes
        self._lock = threading.RLock()

    def __len__(self) -> int:
        return len(self._values)

    def get(self, key: _Key) -> _Value | None:
        """Return a cached value and mark it as used. Returns None if the key is not cached."""
        with self._lock:
            value = self._values.pop(key, None)
            if value is not None:
                self._values[key] = value
            return value

    def put(self, key: _Key, value: _Value) -> _Value:
        """Cache a value and return it. The least recently used values beyond the limits are dropped."""
        with self._lock:
            self._values.pop(key, None)
            self._values[key] = value
            while len(self._values) > self._max_count or (
                self._max_bytes is not None
                and len(self._values) > self._min_count
                and sum(self._nbytes(one) for one in self._values.values()) > self._max_bytes
            ):
                del self._values[next(iter(self._values))]
            return value

    def get_or_make(self, key: _Key, make: Callable[[], _Value]) -> _Value:
        """Return the cached value of a key. If there is none, make the value and cache it."""
        value = self.get(key)
        return self.put(key, make()) if value is None else value

    def discard(self, key: _Key) -> None:
        """Remove a value from the cache."""
        with self._lock:
            self._values.pop(key, None)


class WeakCache(Generic[_Value]):
    """A cache with one value per object. A value is dropped when its object is freed. Objects are told apart
    by identity, so they need not be hashable. A value must not hold a reference to its object, since then
    neither would ever be freed."""

    def __init__(self) -> None:
        self._entries: dict[int, tuple[weakref.ref[Any], _Value]] = {}

    def __len__(self) -> int:
        return len(self._entries)

    def get(self, owner: object) -> _Value | None:
        """Return the cached value of an object; None if there is none."""
        entry = self._entries.get(id(owner))
        return None if entry is None or entry[0]() is not owner else entry[1]

    def put(self, owner: object, value: _Value) -> _Value:
        """Cache the value of an object, and return the value."""
        key, entries = id(owner), self._entries

        def drop(reference: weakref.ref[Any]) -> None:
            entry = entries.get(key)
            if entry is not None and entry[0] is reference:
                del entries[key]

        entries[key] = weakref.ref(owner, drop), value
        return value
