"""What became of one system, and the rows and lines that many of them make.

An outcome, an error and a margin enter; a `Verdict` leaves, of one of these kinds:

    right     successful, and equal to the independent answer in all that is compared
    told      another outcome, and there is no answer: not unique, undecided, too many contacts; or
              the motion is within rounding of a graze or a corner
    refused   another outcome, though there is an answer
    rounding  successful, not equal, and the motion is within rounding of a graze or a corner: which
              way it goes cannot be told in double precision
    wrong     successful, and not equal
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from benchmarks.table import Column

KINDS = ("right", "told", "refused", "rounding", "wrong")
COLUMNS = (
    Column("family"),
    Column("what", width=44),
    Column("tried", ">,"),
    Column("RIGHT", ">,"),
    Column("told rightly", ">,"),
    Column("told, but had an answer", ">,"),
    Column("within rounding", ">,"),
    Column("WRONG", ">,"),
    Column("largest error", ">.1e"),
)
DECIDED = 1e-7
"""The least margin, relative to its terms, with which a motion is decided in double precision."""


class Verdict(NamedTuple):
    """`number` of its group, what it was, and what there is to say of it."""

    number: int | str
    kind: str
    detail: str = ""
    error: float = 0.0


class Group(NamedTuple):
    """A line of the table: `verdicts` of systems that differ in their numbers only."""

    family: str
    what: str
    verdicts: Sequence[Verdict]

    def cells(self):
        """The line's cells, in the order of `COLUMNS`."""
        counts = Counter(v.kind for v in self.verdicts)
        right = [v.error for v in self.verdicts if v.kind == "right"]
        tallies = [counts[kind] for kind in KINDS]
        return [self.family, self.what, len(self.verdicts), *tallies, max(right, default=None)]

    def lines(self, most=40):
        """A sentence for each system that should have come out otherwise."""
        bad = [v for v in self.verdicts if v.kind in ("wrong", "refused")]
        for v in bad[:most]:
            yield f"{self.family}, {self.what}, system {v.number}: {v.kind.upper()}, {v.detail}"
        if len(bad) > most:
            yield f"{self.family}, {self.what}: and {len(bad) - most} more"


def totals(groups: Iterable[Group]):
    """The cells of the last line."""
    everything = Group("all", "", [v for group in groups for v in group.verdicts])
    return everything.cells()
