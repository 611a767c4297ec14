"""What was measured, read back from its table, so that a picture is drawn anew in seconds.

The text of `results/work_precision.txt` enters; rows of a problem leave, with the digits that the
table has.
"""

import re

from benchmarks.work_precision.measure import Row
from benchmarks.work_precision.problems import PROBLEMS


def rows(text, name):
    """The rows of one problem."""
    start = text.index(f"\n{PROBLEMS[name].title}: t1 = ")
    lines = iter(text[start:].splitlines())
    rule = next(line for line in lines if line.startswith("---"))
    columns = [slice(*match.span()) for match in re.finditer("-+", rule)]
    found = []
    for line in lines:
        if not line:
            return found
        found.append(_row(*(line[column].strip() for column in columns)))
    return found


def _row(program, method, setting, error, ms, contacts, steps, compiling):
    """One line of a table."""
    method, _, lanes = method.partition(" / ")
    unit, value = setting.split()
    return Row(
        program,
        method,
        int(lanes or 1),
        float(value),
        unit,
        float(error),
        1e-3 * float(ms),
        float(compiling or 0),
        int(contacts.lstrip("!") or 0),
        int(steps.replace(",", "")),
    )
