"""What the report of a process shows: its tables, its verdict and the picture of one crystal."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from cz_gym.crystal.process import CRYSTAL
from cz_gym.evaluation.protocol import Case
from cz_gym.evaluation.results import Result

from . import crystal, crystals, tables
from .tables import Column, Verdict

Table = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Heads and rows."""


class Contents(NamedTuple):
    """The parts of a report."""

    overview: Callable[[Sequence[Result]], tuple[tuple[str, ...], dict[str, list[tuple[str, ...]]]]]
    verdict: Callable[..., Verdict]
    columns: tuple[tuple[Column, ...], ...]
    """Columns of a case's tables of metrics."""
    short: tuple[Column, ...]
    """Columns on a terminal."""
    losses: Callable[[Result], Table] | None
    """How crystals were lost, if there are several ways and parts."""
    picture: Callable[[Result], bytes]
    """The first crystal of a case, as PNG."""


_BODY = Contents(tables.overview, tables.verdict, (tables.ERROR, tables.DRIVES), tables.SHORT, None, crystal.crystal)
_CRYSTAL = Contents(
    crystals.overview,
    crystals.verdict,
    (crystals.ERROR, crystals.DRIVES),
    crystals.SHORT,
    crystals.losses,
    crystals.draw,
)


def contents_of(case: Case) -> Contents:
    """The parts of the report of a case's process."""
    return _CRYSTAL if case.process == CRYSTAL else _BODY
