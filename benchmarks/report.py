"""The measured rows as a table, as JSON, as a picture, and as ratios at equal error.

In: rows as `throughput.row` makes them. Out: text on standard output, and files in `results/`:
all rows, the picture, and the ratios.
"""

import json
import math
import platform

import numpy as np

from benchmarks import RESULTS
from benchmarks.paper import canvas as paper
from benchmarks.programs import style_of
from benchmarks.table import Column, table

LEVELS = (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
OURS = "jaxfil"
# The method of a sweep that names none, and the errors at which others are set beside it.
DEFAULT, FINER = "Dopri8", (1e-6, 1e-8, 1e-10, 1e-12)


def core_counts(rows):
    """The numbers of cores that were measured."""
    return sorted({int(c) for r in rows for c in r["rates"]})


def _calls(row):
    """Traces and compilations of the first call / of the later ones, each call."""
    if not row["jax"]:
        return "-"
    later = [max(call[k] for call in row["later_calls"]) for k in ("traces", "compilations")]
    first = row["first_call"]
    return f"{first['traces']}, {first['compilations']} / {later[0]}, {later[1]}"


def _error(row):
    """The error as text, and the lanes that failed."""
    error = "failed" if row["error"] is None else f"{row['error']:.1e}"
    return error + (f" ({row['failed']} lanes failed)" if row["failed"] else "")


def _cores(count):
    """One core, several cores."""
    return f"{count} core{'s' * (count > 1)}"


def measured(rows):
    """The table as text, a scene and an integrator after the other."""
    cores = core_counts(rows)
    columns = [Column("scene"), Column("who"), Column("setting")]
    columns += [Column("lanes", ">"), Column("error", ">")]
    columns += [Column(_cores(c), ">,.0f") for c in cores]
    columns += [Column("compile s", ">.1f"), Column("traced, compiled: first / later call")]
    body = []
    for r in sorted(rows, key=lambda r: (r["scene"], r["who"] != OURS, r["who"])):
        rates = [r["rates"].get(str(c)) for c in cores]
        cells = [r["scene"], r["who"], r["setting"], r["lanes"], _error(r), *rates]
        body.append([*cells, r["compile_seconds"], _calls(r)])
    return table(columns, body)


def _points(rows, cores):
    """(error, rate) of each row that has both."""
    key = str(cores)
    return [(r["error"], r["rates"][key]) for r in rows if r["error"] and key in r["rates"]]


def rate_at(rows, error, cores):
    """The best rate at this error or a smaller one; None where no method gets there.

    Within a method it is interpolated between neighbouring settings, both axes logarithmic. At an
    error above that of a method's cheapest setting the rate is that setting's.
    """
    best = None
    for method in {r["method"] for r in rows}:
        points = sorted(_points([r for r in rows if r["method"] == method], cores))
        if not points or points[0][0] > error:
            continue
        errors, rates = np.log(np.array(points)).T
        # A dearer setting never counts as less than what it can be replaced by.
        rate = float(np.exp(np.interp(np.log(error), errors, np.maximum.accumulate(rates))))
        best = rate if best is None else max(best, rate)
    return best


def ratios(rows):
    """jaxfil's rate over each peer's at equal error: {(scene, who, cores): {level: ratio}}."""
    found = {}
    for scene in dict.fromkeys(r["scene"] for r in rows):
        here = [r for r in rows if r["scene"] == scene]
        for who in sorted({r["who"] for r in here} - {OURS}):
            for cores in core_counts(here):
                pair = [
                    [rate_at([r for r in here if r["who"] == w], e, cores) for e in LEVELS]
                    for w in (OURS, who)
                ]
                found[scene, who, cores] = dict(zip(LEVELS, zip(*pair, strict=True), strict=True))
    return found


def _ratio(ours, theirs):
    """A cell of the table of ratios."""
    if ours is None:
        return "-"
    return "alone" if theirs is None else f"{ours / theirs:.3g}"


def relative(rows):
    """The same as a table."""
    columns = [Column("scene"), Column("who"), Column("measured on")]
    columns += [Column(f"at {level:.0e}", ">") for level in LEVELS]
    body = [
        [scene, who, _cores(cores), *(_ratio(*pair) for pair in levels.values())]
        for (scene, who, cores), levels in ratios(rows).items()
    ]
    title = "jaxfil's rate relative to each peer's, at equal error"
    note = '"alone": the peer does not get there; "-": jaxfil does not.'
    return table(columns, body, title, note)


def methods(rows):
    """Every method's rate over that of jaxfil's default one at equal error, on one core, and what
    jaxfil's methods take to compile, as a table."""
    columns = [Column("scene"), Column("who"), Column("method"), Column("first call, s", ">.1f")]
    columns += [Column(f"at {level:.0e}", ">.2f") for level in FINER]
    body = []
    for scene in dict.fromkeys(r["scene"] for r in rows):
        here = [r for r in rows if r["scene"] == scene]
        curves = {}
        for r in sorted(here, key=lambda r: (r["who"] != OURS, r["who"])):
            curves.setdefault((r["who"], r["method"]), []).append(r)
        base = [rate_at(curves.get((OURS, DEFAULT), []), level, 1) for level in FINER]
        for (who, method), some in curves.items():
            own = [rate_at(some, level, 1) for level in FINER]
            pairs = zip(own, base, strict=True)
            times = [a / b if a and b else None for a, b in pairs]
            first = max(r["compile_seconds"] for r in some) if who == OURS else None
            body.append([scene, who, method, first, *times])
    title = f"Each method's rate relative to jaxfil's {DEFAULT} at equal error, on one core"
    return table(columns, body, title, "No entry: one of the two does not get there.")


def picture(rows, path):
    """Error against rate on one core, both logarithmic: a panel a scene, and a curve a program, the
    best of its methods at each error; of jaxfil's default method another one."""
    names = sorted({r["who"] for r in rows}, key=lambda who: (who != OURS, who))
    scenes = list(dict.fromkeys(r["scene"] for r in rows))
    with paper.style():
        figure = paper.canvas(paper.PAGE, 92)
        axes = figure.subplots(1, len(scenes), squeeze=False)[0]
        for ax, scene in zip(axes, scenes, strict=True):
            here = [r for r in rows if r["scene"] == scene]
            for who in names:
                color, marker = style_of(who)
                style = {"color": color, "marker": marker, "ms": 4, "label": who}
                _curve(ax, [r for r in here if r["who"] == who], **style)
                if who == OURS:
                    plain = [r for r in here if (r["who"], r["method"]) == (OURS, DEFAULT)]
                    style |= {"ls": ":", "mfc": "white", "label": f"{who}, {DEFAULT} alone"}
                    _curve(ax, plain, **style)
            ax.set(xscale="log", yscale="log", xlabel="error (smaller to the right)")
            ax.set_xlim(1e-3, 1e-14)
            ax.grid(alpha=0.3)
            paper.entitle(ax, {"belt": "belt friction", "sd": "SD oscillator"}.get(scene, scene))
        axes[0].set_ylabel("periods of the force per second, all lanes")
        # In the order of the curves, the highest first, line by line.
        curves = sorted(axes[0].get_lines(), key=lambda line: -max(line.get_ydata()))
        columns = 4
        paper.below(figure, [c for i in range(columns) for c in curves[i::columns]], columns)
        paper.save(figure, path)


def _curve(ax, rows, **style):
    """The best of some rows at each error."""
    ax.plot(*np.reshape(front(_points(rows, 1)), (-1, 2)).T, **style)


def front(points):
    """Of (error, rate) those that no other one beats in both, by falling error."""
    kept, best = [], -math.inf
    for error, rate in sorted(points):
        if rate > best:
            kept.append((error, rate))
            best = rate
    return kept[::-1]


def write(rows, skipped, about):
    """Print the table and the ratios, and write the files."""
    RESULTS.mkdir(exist_ok=True)
    kept = dict(about, processor=platform.machine(), python=platform.python_version(), rows=rows)
    kept["skipped"] = skipped
    (RESULTS / "throughput.json").write_text(json.dumps(kept, indent=1))
    picture(rows, RESULTS / "throughput.png")
    print(measured(rows), *skipped, sep="\n")
    print(
        "\nRates are lane-periods per second, medians, compilation left out"
        + (", one core by processor time" if about["processor_time"] else "")
        + ". An integrator\nwith fewer lanes than the others is slow and was given fewer; its rate "
        "counts the lanes it had.\n"
    )
    if any(r["who"] == OURS for r in rows):
        text = f"{relative(rows)}\n\n{methods(rows)}\n"
        (RESULTS / "throughput.txt").write_text(text)
        print(text)
