"""Regular expressions for names (POSIX extended), matched in time that the pattern cannot make long.

Patterns come from the network. Python's :mod:`re` needs hours for some of a few characters, such as
``(a*)*b``. Here a pattern becomes a set of positions, one for each of its characters, that is moved along the
text: at most positions * positions * characters steps.
"""

from __future__ import annotations

import string
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from humansim_ros.errors import RosError

#: Most characters of a pattern, and most of its positions after repetitions are written out.
MAX_PATTERN, MAX_POSITIONS = 256, 256
#: Most parentheses inside each other, and most parts that are read, repetitions each time.
_MAX_DEPTH, _MAX_PARTS = 20, 2000

#: Symbols before and after each text, for ``^`` and ``$``: no character matches them.
_START, _END = "\0start", "\0end"
_CLASSES: dict[str, Callable[[str], bool]] = {
    "alnum": str.isalnum,
    "alpha": str.isalpha,
    "blank": lambda c: c in " \t",
    "cntrl": lambda c: not c.isprintable(),
    "digit": lambda c: c in string.digits,
    "graph": lambda c: c.isprintable() and c != " ",
    "lower": str.islower,
    "print": str.isprintable,
    "punct": lambda c: c in string.punctuation,
    "space": str.isspace,
    "upper": str.isupper,
    "xdigit": lambda c: c in string.hexdigits,
}


@dataclass(frozen=True)
class _Part:
    """Part of a pattern. ``first``, ``last``: bits of the positions at which it may begin and end.

    ``is_optional``: whether the empty text matches.
    """

    first: int = 0
    last: int = 0
    is_optional: bool = True


@dataclass
class NamePattern:
    """A pattern that is searched in names: it may match any part, as with ``grep -E``.

    ``text``: the pattern. Raises RosError if it is too long or wrong.
    """

    text: str
    _tests: list[Callable[[str], bool]] = field(default_factory=list, init=False, repr=False)
    _next: list[int] = field(default_factory=list, init=False, repr=False)

    def __post_init__(self) -> None:
        if len(self.text) > MAX_PATTERN:
            raise RosError(f"a pattern of {len(self.text)} characters; at most {MAX_PATTERN} are read")
        self._at = self._parts = 0
        self._whole = self._choice(0)
        if self._at < len(self.text):
            raise self._error("a ) without (")
        self._masks: dict[str, int] = {}

    def matches(self, name: str) -> bool:
        """Whether the pattern matches a part of a name."""
        if self._whole.is_optional:
            return True
        active = 0
        for symbol in (_START, *name, _END):
            reachable = self._whole.first
            for position in _bits(active):
                reachable |= self._next[position]
            active = reachable & self._mask(symbol)
            if active & self._whole.last:
                return True
        return False

    def _mask(self, symbol: str) -> int:
        """Bits of the positions that a symbol matches."""
        if symbol not in self._masks:
            self._masks[symbol] = sum(1 << i for i, test in enumerate(self._tests) if test(symbol))
        return self._masks[symbol]

    # --- parser: each function reads a part of the text from self._at on

    def _choice(self, depth: int) -> _Part:
        if depth > _MAX_DEPTH:
            raise self._error(f"more than {_MAX_DEPTH} parentheses inside each other")
        part = self._sequence(depth)
        while self._take("|"):
            other = self._sequence(depth)
            part = _Part(
                part.first | other.first, part.last | other.last, part.is_optional or other.is_optional
            )
        return part

    def _sequence(self, depth: int) -> _Part:
        part = _Part()
        while self._at < len(self.text) and self.text[self._at] not in "|)":
            part = self._joined(part, self._repeated(depth))
        return part

    def _repeated(self, depth: int) -> _Part:
        """A character or group with what follows it: ``*``, ``+``, ``?``, ``{m,n}``."""
        begin = self._at
        self._parts += 1
        if self._parts > _MAX_PARTS:  # of repeated groups that may be empty
            raise self._error("too many repetitions")
        part = self._item(depth)
        while self._at < len(self.text) and self.text[self._at] in "*+?{":
            end = self._at
            low, high = self._counts()
            again = self._at
            copies = [part]
            for _ in range(max(low, high or 1) - 1):
                self._at = begin
                copies.append(self._repeated_until(depth, end))
            self._at = again
            part = self._copies_joined(copies, low, high)
        return part

    def _repeated_until(self, depth: int, end: int) -> _Part:
        """Read a character or group with repetitions that end at a position once more, as new positions."""
        text, self.text = self.text, self.text[:end]
        try:
            return self._repeated(depth)
        finally:
            self.text = text

    def _copies_joined(self, copies: list[_Part], low: int, high: int | None) -> _Part:
        if high is None:
            self._link(copies[-1].last, copies[-1].first)  # the last one any number of times
        elif high == 0:
            return _Part()
        whole = _Part()
        for number, copy in enumerate(copies):
            whole = self._joined(whole, copy if number < low else _Part(copy.first, copy.last))
        return whole

    def _item(self, depth: int) -> _Part:
        character = self.text[self._at]
        self._at += 1
        if character == "(":
            part = self._choice(depth + 1)
            if not self._take(")"):
                raise self._error("a ( without )")
            return part
        if character == "[":
            return self._position(self._bracket())
        if character == ".":
            return self._position(lambda symbol: len(symbol) == 1)
        if character in "^$":
            anchor = _START if character == "^" else _END
            return self._position(lambda symbol: symbol == anchor)
        if character in "*+?{":
            raise self._error(f"a {character} with nothing before it")
        if character == "\\":
            if self._at == len(self.text):
                raise self._error("a \\ at the end")
            character = self.text[self._at]
            self._at += 1
            if character.isalnum():
                raise self._error(f"\\{character} has no meaning in POSIX extended patterns")
        return self._position(lambda symbol: symbol == character)

    def _counts(self) -> tuple[int, int | None]:
        """Least and greatest number of repetitions; None for no limit."""
        sign = self.text[self._at]
        self._at += 1
        if sign != "{":
            return {"*": (0, None), "+": (1, None), "?": (0, 1)}[sign]
        end = self.text.find("}", self._at)
        low, comma, high = self.text[self._at : max(end, self._at)].partition(",")
        numbers = [part for part in (low, high) if part]
        if end < 0 or not low or not all(part.isdecimal() and len(part) < 5 for part in numbers):
            raise self._error("a { that no {m}, {m,} or {m,n} begins with")
        self._at = end + 1
        least, most = int(low), int(high) if high else None if comma else int(low)
        if most is not None and most < least:
            raise self._error(f"{{{least},{most}}} is empty")
        if max(least, most or 0) > MAX_POSITIONS:
            raise self._error(f"more than {MAX_POSITIONS} repetitions")
        return least, most

    def _bracket(self) -> Callable[[str], bool]:
        """Test of a bracket expression, such as ``[^a-z_[:digit:]]``."""
        negated, begin = self._take("^"), self._at
        tests: list[Callable[[str], bool]] = []
        while self._at == begin or not self._take("]"):
            if self.text.startswith("[:", self._at):
                end = self.text.find(":]", self._at)
                name = self.text[self._at + 2 : max(end, self._at + 2)]
                if name not in _CLASSES:
                    raise self._error("a [: that begins none of " + ", ".join(_CLASSES))
                tests.append(_CLASSES[name])
                self._at = end + 2
                continue
            low = high = self._character()
            if self.text.startswith("-", self._at) and not self.text.startswith("-]", self._at):
                self._at += 1
                high = self._character()
            tests.append(lambda symbol, low=low, high=high: low <= symbol <= high)  # type: ignore[misc]
        return lambda symbol: len(symbol) == 1 and any(test(symbol) for test in tests) != negated

    def _character(self) -> str:
        if self._at >= len(self.text):
            raise self._error("a [ without ]")
        self._at += 1
        return self.text[self._at - 1]

    def _take(self, character: str) -> bool:
        found = self.text.startswith(character, self._at)
        self._at += found
        return found

    def _error(self, problem: str) -> RosError:
        return RosError(
            f"the filter is no POSIX extended pattern: {problem}, before character {self._at + 1}"
        )

    # --- positions

    def _position(self, test: Callable[[str], bool]) -> _Part:
        if len(self._tests) == MAX_POSITIONS:
            raise self._error(f"more than {MAX_POSITIONS} characters with repetitions")
        self._tests.append(test)
        self._next.append(0)
        bit = 1 << (len(self._tests) - 1)
        return _Part(bit, bit, False)

    def _link(self, last: int, first: int) -> None:
        for position in _bits(last):
            self._next[position] |= first

    def _joined(self, left: _Part, right: _Part) -> _Part:
        self._link(left.last, right.first)
        return _Part(
            left.first | (right.first if left.is_optional else 0),
            right.last | (left.last if right.is_optional else 0),
            left.is_optional and right.is_optional,
        )


def _bits(number: int) -> Iterator[int]:
    """Positions of the bits that are set."""
    while number:
        low = number & -number
        yield low.bit_length() - 1
        number ^= low
