"""Short texts that describe scenes and motions: ``kind key=value key=value``."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass
class Words:
    """One description being read; every key must be asked for before ``finish``."""

    what: str
    kind: str
    values: dict[str, str]
    asked: list[str] = field(default_factory=list)

    @classmethod
    def parse(cls, text: str, what: str) -> Words:
        """Split a text. Raises ``ValueError`` that names the word that is wrong."""
        kind, *words = text.split() or [""]
        values: dict[str, str] = {}
        for word in words:
            key, equals, value = word.partition("=")
            if not equals or not key or key in values:
                raise ValueError(f"{what} {text!r}: {word!r} is not a new key=value")
            values[key] = value
        return cls(what, kind, values)

    def text_of(self, key: str, default: str) -> str:
        self.asked.append(key)
        return self.values.get(key, default)

    def number(self, key: str, default: float) -> float:
        self.asked.append(key)
        return self._numbers(key, 1)[0] if key in self.values else default

    def vector(self, key: str, default: tuple[float, ...], separator: str = ",") -> NDArray[np.float64]:
        self.asked.append(key)
        return np.array(self._numbers(key, len(default), separator) if key in self.values else default)

    def numbers(self, key: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """Any number of them, separated by slashes."""
        self.asked.append(key)
        return tuple(self._numbers(key, None, "/")) if key in self.values else default

    def finish(self) -> None:
        """Raises ``ValueError`` for a key that nobody asked for, with the nearest right one."""
        for key in self.values:
            if key not in self.asked:
                near = difflib.get_close_matches(key, self.asked, 1)
                hint = f"did you mean {near[0]!r}?" if near else f"it knows: {', '.join(sorted(set(self.asked)))}"
                raise ValueError(f"{self.what} {self.kind!r} has no {key!r}; {hint}")

    def _numbers(self, key: str, count: int | None, separator: str = ",") -> list[float]:
        text = self.values[key]
        try:
            numbers = [float(word) for word in text.split(separator)]
        except ValueError:
            numbers = []
        if not numbers or not np.all(np.isfinite(numbers)) or (count is not None and len(numbers) != count):
            wanted = "a list of numbers" if count is None else "a number" if count == 1 else f"{count} numbers"
            raise ValueError(f"{self.what} {self.kind!r}: {key}={text} is not {wanted}")
        return numbers
