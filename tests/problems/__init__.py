"""The bank of problems with known answers. Nothing enters; `PROBLEMS` leaves, with their names.

A test takes a problem by its name, `PROBLEMS["coulomb"]`, or the names of all that have certain
tags, `tagged("orbit belt")`. What is not known of a problem is None. The tags:

- "hand": fractions, worked out by hand; "textbook": from the literature of event-driven and
  Filippov systems; "orbit": a periodic orbit, started on it, over one period or two; "flow": an end
  in closed form that can be differentiated by everything
- "crossing", "sliding", "impact", "graze", "intersection" (slid on), "corner" (of two surfaces, met
  at once), "zeno" (infinitely many contacts)
- "forced", "autonomous"; "sd" and "belt" ("twice" where it slips twice a period), the systems of
  Santhosh, Narayanan and Padmanabhan, Procedia IUTAM 19 (2016) 219-227, and "cubic", the belt with
  a cubic spring
- "float32": solved to four digits in single precision with the step that it has

The numbers of the belt and the SD oscillator are not the paper's, some of which are misprinted, but
a corrected reference: closed forms per piece with 60-digit Newton for the piecewise-linear systems,
Taylor series in mpmath for the cubic one, cross-checked with an event-driven DOP853 at 1e-13.
Reference digits that belong to no single motion are in `values`, formulas in `closed_forms`.
"""

import dataclasses

from tests.problems.flows import FLOWS
from tests.problems.hand import HAND
from tests.problems.orbits import ORBITS
from tests.problems.textbook import TEXTBOOK


def _also(problems, tag):
    return {k: dataclasses.replace(p, tags=f"{tag} {p.tags}") for k, p in problems.items()}


PROBLEMS = (
    _also(HAND, "hand")
    | _also(TEXTBOOK, "textbook")
    | _also(ORBITS, "orbit")
    | _also(FLOWS, "flow")
)


def tagged(tags, but=""):
    """The problems that have all of these tags and none of those, by name."""
    wanted, unwanted = set(tags.split()), set(but.split())
    have = {name: set(problem.tags.split()) for name, problem in PROBLEMS.items()}
    return [k for k, its in have.items() if wanted <= its and not unwanted & its]
