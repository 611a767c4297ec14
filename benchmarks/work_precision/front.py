"""Who is in front at an error: run times at equal error, and what they are made of.

Rows of one problem enter; lines of text leave.
"""

import math

from benchmarks.report import rate_at
from benchmarks.work_precision.whole_loop import NOTE

LEVELS = (1e-4, 1e-6, 1e-8, 1e-10)
OURS = "jaxfil"


def contests(rows):
    """{title: rows}: one lane as JAX compiles by itself, with its loops compiled whole, and lanes
    of a batch. What has no rows of a kind takes part with those of one lane."""
    single = [r for r in rows if r.lanes == 1]
    plain = [r for r in single if NOTE not in r.method]
    whole = [r for r in single if NOTE in r.method]
    batched = [r for r in rows if r.lanes > 1]
    return {
        title: own + [r for r in plain if r.program not in {r.program for r in own}]
        for title, own in (
            ("one lane", plain),
            ("one lane, loops compiled whole", whole),
            ("a lane of a batch", batched),
        )
        if own
    }


def curves(rows):
    """{(program, method): rows}."""
    found = {}
    for row in rows:
        found.setdefault((row.program, row.method), []).append(row)
    return found


def seconds_at(rows, error):
    """The run time of one curve at this error or a smaller one, interpolated; inf where it does
    not get there."""
    points = [
        {"method": "", "error": r.error, "rates": {"1": 1 / r.seconds}}
        for r in rows
        if math.isfinite(r.error) and r.error > 0
    ]
    rate = rate_at(points, error, 1)
    return math.inf if rate is None else 1 / rate


def ranking(rows, error):
    """(seconds, program, method) of those that get there, the fastest first."""
    times = [(seconds_at(some, error), *key) for key, some in curves(rows).items()]
    return sorted(t for t in times if t[0] < math.inf)


def lines(rows):
    """For each contest and level: is jaxfil in front, who is the fastest, and why if it is not."""
    for title, some in contests(rows).items():
        yield f"Is jaxfil in front? {title}:"
        yield from (f"  at {level:.0e} {_level(some, level)}" for level in LEVELS)
        if reason := _made_of(some):
            yield f"  {reason}"


def ratio(rows, level):
    """The fastest other program's run time over jaxfil's; 0 or inf where one of them does not get
    there, NaN where neither does."""
    ranked = ranking(rows, level)
    ours = next((r[0] for r in ranked if r[1] == OURS), math.inf)
    other = next((r[0] for r in ranked if r[1] != OURS), math.inf)
    return math.nan if ours == other == math.inf else other / ours


def _level(rows, level):
    """Who is the fastest at one error, and who comes next."""
    ranked = ranking(rows, level)
    if not ranked:
        return "nobody gets there"
    ours = next((r for r in ranked if r[1] == OURS), None)
    other = next((r for r in ranked if r[1] != OURS), None)
    first = ranked[0] is ours
    told = [_name(r) for r in (ours, other) if r]
    told = told if first else told[::-1]
    return f"{'yes' if first else 'no'}, fastest is {', then '.join(told)}"


def _name(entry):
    """One of the ranking, with its run time."""
    seconds, program, method = entry
    return f"{program} {method}".replace(NOTE, "") + f" ({1e3 * seconds:.2g} ms)"


def _made_of(rows):
    """Steps, and time a step, of the fastest and of jaxfil where that is furthest back."""
    behind = []
    for level in LEVELS:
        ranked = ranking(rows, level)
        ours = next((r for r in ranked if r[1] == OURS), None)
        if ours and ranked[0][1] != OURS:
            behind.append((ours[0] / ranked[0][0], level, ranked[0], ours))
    if not behind:
        return ""
    ratio, level, first, ours = max(behind)
    parts = [_steps(rows, entry, level) for entry in (first, ours)]
    return f"Furthest back at {level:.0e}, by {ratio:.1f}: {parts[0]}; {parts[1]}."


def _steps(rows, entry, level):
    """The measured run of a curve that is nearest to a level from below."""
    _, program, method = entry
    some = [r for r in curves(rows)[program, method] if r.error <= level]
    row = min(some, key=lambda r: r.seconds)
    noun = "iterations" if program == OURS else "steps"
    each = 1e6 * row.seconds / row.steps
    who = f"{program} {method}".replace(NOTE, "")
    return f"{who} takes {row.steps} {noun} of {each:.2g} µs for {row.error:.0e}"


def plateaus(rows):
    """The smallest error of each width, and the shortest time in which it came within a tenth."""
    smooth = curves([r for r in rows if r.program == "smoothed" and math.isfinite(r.error)])
    if not smooth:
        return ["Smoothing: none, an impact cannot be smoothed."]
    told = ["The error at which smoothing stops, however small the tolerance:"]
    for (_, method), some in smooth.items():
        stop = min(r.error for r in some)
        spent = min(r.seconds for r in some if r.error <= 1.1 * stop)
        falls = len(some) > 1 and some[-1].error < 0.5 * some[-2].error
        note = ", not there yet at the smallest tolerance" if falls else ""
        told.append(f"  {method}: {stop:.0e} ({1e3 * spent:.2g} ms){note}")
    return told
