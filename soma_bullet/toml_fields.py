"""Reading TOML descriptions: one table, key by key, with every fault collected."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from soma_bullet.errors import InputError
from soma_bullet.frames import Array

METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_SCHEMA = 1


class Fields:
    """One table of a TOML file, read key by key; faults are collected, and keys that nobody read are faults
    as well."""

    def __init__(self, table: Mapping[str, Any], faults: list[str], where: str = ""):
        self._table, self.faults, self._where, self._read = table, faults, where, set[str]()

    def __contains__(self, key: str) -> bool:
        return key in self._table

    def keys(self) -> list[str]:
        return list(self._table)

    def _get(self, key: str, kind: type | tuple[type, ...], what: str, fallback: Any) -> Any:
        self._read.add(key)
        if key not in self._table:
            if fallback is None:
                self.faults.append(f"{self._where}{key} is missing: {what}")
            return fallback
        value = self._table[key]
        if not isinstance(value, kind) or isinstance(value, bool):
            self.faults.append(f"{self._where}{key} = {value!r}: must be {what}")
            return fallback
        return value

    def text(self, key: str, fallback: str | None = None) -> str:
        """A string; empty where it is missing."""
        return self._get(key, str, "a string", fallback) or ""

    def texts(self, key: str, count: int | None = None) -> tuple[str, ...]:
        """A list of strings; empty where it is missing or wrong."""
        what = f"a list of {count or ''} strings".replace("  ", " ")
        values = self._get(key, list, what, None)
        if values is None:
            return ()
        if not all(isinstance(value, str) for value in values) or (
            count is not None and len(values) != count
        ):
            self.faults.append(f"{self._where}{key} = {values!r}: must be {what}")
            return ()
        return tuple(values)

    def items(self, key: str, what: str) -> list[Any]:
        """A list; empty where it is missing."""
        return self._get(key, list, what, None) or []

    def number(self, key: str, positive: bool = True, fallback: float | None = None) -> float:
        """A finite number; NaN where it is missing or wrong."""
        value = self._get(key, (int, float), "a number", fallback)
        if value is None:
            return np.nan
        if not np.isfinite(value) or (positive and value <= 0):
            self.faults.append(
                f"{self._where}{key} = {value}: must be {'positive' if positive else 'finite'}"
            )
        return float(value)

    def numbers(self, key: str, shape: tuple[int, ...], fallback: Any = None) -> Array:
        """An array of finite numbers; NaN where it is missing or wrong. -1 in `shape` stands for any
        length."""
        what = "an array of numbers of shape " + " x ".join("n" if n < 0 else str(n) for n in shape)
        value = self._get(key, list, what, fallback)
        wrong = np.full([max(n, 1) for n in shape], np.nan)
        if value is None:
            return wrong
        try:
            array = np.asarray(value, float)
        except (TypeError, ValueError):
            array = np.empty(0)
        fits = array.ndim == len(shape) and all(n in (-1, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits or not np.isfinite(array).all():
            self.faults.append(f"{self._where}{key} = {value!r}: must be {what}")
            return wrong
        return array

    def table(self, key: str, optional: bool = False) -> Fields:
        """A table within; empty where it is missing."""
        found = self._get(key, dict, "a table", {} if optional else None)
        # What is missing as a whole is one fault, not one per key.
        return Fields(found or {}, self.faults if found is not None else [], f"{self._where}{key}.")

    def unit(self) -> float:
        """Metres per unit of length: the key `unit` is mandatory."""
        name = self._get("unit", str, f"mandatory, one of {', '.join(METRES)}", None)
        if name is not None and name not in METRES:
            self.faults.append(f"{self._where}unit = {name!r}: must be one of {', '.join(METRES)}")
        return METRES.get(name, 1.0)

    def schema(self) -> None:
        """Refuses a file of another schema."""
        number = self._get("schema", int, f"the number {_SCHEMA}", None)
        if number not in (None, _SCHEMA):
            self.faults.append(f"schema = {number}: this version reads schema {_SCHEMA}")

    def close(self) -> None:
        """Unread keys are faults: a typo must not pass for a default."""
        for key in self._table:
            if key not in self._read:
                self.faults.append(
                    f"{self._where}{key} is unknown; known here: {', '.join(sorted(self._read))}"
                )


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        InputError: the file is missing or not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(str(path), "no such file") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(str(path), f"cannot be read as TOML: {error}") from None
