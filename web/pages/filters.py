"""Filters of the page of a survey, which its address holds: a link reproduces the view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self
from urllib.parse import urlencode

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.config import RESECTION_METHODS
from spheremark.pipelines.errors import InputError
from spheremark.web.columns import Columns, floats, lane_and_number, select, texts

_CHOICES = {"axes": ("linear", "log"), "marks": ("2", "3"), "resection": RESECTION_METHODS}
"""Values of a query by name, the default first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Filters:
    """Which rows are shown, and on which axes; an empty filter does not restrict."""

    methods: tuple[str, ...] = ()
    lane: str = ""
    stop: str = ""
    range_from_m: float | None = None
    range_to_m: float | None = None
    status: str = ""
    is_log: bool = False
    n_marks: int = 2
    resection: str = "free_station"

    @classmethod
    def from_query(cls, query: Mapping[str, Sequence[str]]) -> Self:
        """Read the query of an address; InputError names the wrong value."""
        first = {name: values[-1] for name, values in query.items() if values}
        chosen = {name: first.get(name, known[0]) for name, known in _CHOICES.items()}
        for name, value in chosen.items():
            if value not in _CHOICES[name]:
                raise InputError(f"{name} is {value!r}; it must be {' or '.join(_CHOICES[name])}.")
        return cls(
            methods=tuple(query.get("method", ())),
            lane=first.get("lane", ""),
            stop=first.get("stop", ""),
            range_from_m=_number(first, "range_from_m"),
            range_to_m=_number(first, "range_to_m"),
            status=first.get("status", ""),
            is_log=chosen["axes"] == "log",
            n_marks=int(chosen["marks"]),
            resection=chosen["resection"],
        )

    def query(self) -> str:
        """Return the query that reads back as these filters."""
        pairs: list[tuple[str, Any]] = [("method", method) for method in self.methods]
        pairs += [
            (name, value)
            for name in ("lane", "stop", "range_from_m", "range_to_m", "status")
            if (value := getattr(self, name)) not in ("", None)
        ]
        pairs += [("axes", "log")] if self.is_log else []
        pairs += [("marks", self.n_marks)] if self.n_marks != 2 else []
        pairs += [("resection", self.resection)] if self.resection != "free_station" else []
        return urlencode(pairs)

    def apply(self, columns: Columns) -> dict[str, NDArray[Any]]:
        """Return the rows of any table that pass; filters of missing columns do not restrict."""
        keep = np.ones(len(next(iter(columns.values()))), dtype=np.bool_)
        if self.methods and "fit_method" in columns:
            keep &= np.isin(texts(columns, "fit_method"), self.methods)
        if "stop" in columns:
            keep &= self._stops(texts(columns, "stop"))
        if self.status and "status" in columns:
            keep &= np.array(texts(columns, "status"), dtype=object) == self.status
        if "range_m" in columns:
            keep &= self._ranges(floats(columns, "range_m"))
        return select(columns, keep)

    def _stops(self, stops: Sequence[str]) -> NDArray[np.bool_]:
        """Return which rows are of the selected lane and stop."""
        return np.array(
            [
                (not self.stop or stop == self.stop)
                and (not self.lane or lane_and_number(stop)[0] == self.lane)
                for stop in stops
            ],
            dtype=np.bool_,
        )

    def _ranges(self, ranges: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which rows are in the selected interval of distance."""
        low = -np.inf if self.range_from_m is None else self.range_from_m
        high = np.inf if self.range_to_m is None else self.range_to_m
        return np.asarray((ranges >= low) & (ranges <= high))


def _number(query: Mapping[str, str], name: str) -> float | None:
    """Read a number in metres, if given."""
    text = query.get(name, "").strip()
    if not text:
        return None
    try:
        value = float(text)
    except ValueError as error:
        raise InputError(f"{name} is {text!r}; it must be a number in metres.") from error
    if not np.isfinite(value):
        raise InputError(f"{name} is {text!r}; it must be finite.")
    return value
