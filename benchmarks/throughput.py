"""`python -m benchmarks.throughput`: jaxfil and its peers, side by side in one run.

Every lane runs 200 forcing periods unseen and 100 sampled ones. Each integrator has a process for
one core and one for all of them; they take turns, setting by setting, and the rounds are repeated,
so that what else the machine does hits all alike; medians are shown. Compilation is left out of the
rates and has its own column. Writes `results/throughput.json`, `throughput.png` and
`throughput.txt`.
"""

import argparse
import json
import os
import statistics
import sys

import numpy as np

from benchmarks import peers, reference, report
from benchmarks.scenes import SCENES
from benchmarks.worker import Worker

# A run longer than this many seconds is not repeated: its noise is small beside its length.
LONG = 5.0


def arguments():
    """What the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.throughput", description=__doc__)
    parser.add_argument("--lanes", type=int, default=1000, help="values of omega (default 1000)")
    parser.add_argument("--scene", choices=list(SCENES), help="one scene only")
    parser.add_argument("--peer", choices=peers.MODULES, action="append", help="only this one")
    parser.add_argument("--repeats", type=int, help="rounds (default 3, with --quick 1)")
    parser.add_argument("--cores", type=int, help="use no more than this many")
    parser.add_argument("--quick", action="store_true", help="128 lanes, every other setting")
    parser.add_argument(
        "--processor-time",
        action="store_true",
        help="rate the one-core column by processor time: for a machine that others use too",
    )
    args = parser.parse_args()
    args.repeats = args.repeats or (1 if args.quick else 3)
    args.lanes = min(args.lanes, 128) if args.quick else args.lanes
    return args


def core_sets(limit):
    """The cores for each column: one, and all."""
    allowed = getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))(0)
    cores = sorted(allowed)[:limit]
    return [cores[-1:], cores] if len(cores) > 1 else [cores]


def requests(scene, peer, args):
    """What one integrator is asked on one scene, cheap to dear within a method."""
    most = peer.effort(args.quick)
    lanes = args.lanes if most is None else min(most, args.lanes)
    common = dict(
        scene=scene,
        lanes=lanes,
        transient=reference.TRANSIENT,
        samples=reference.SAMPLES,
    )
    return [common | {"setting": s} for s in peer.SETTINGS[:: 2 if args.quick else 1]]


def turns(asked):
    """(module, request) of one round: the integrators in turn, each with its next setting."""
    for i in range(max(map(len, asked.values()))):
        yield from ((module, found[i]) for module, found in asked.items() if i < len(found))


def measure(scene, workers, args):
    """All rounds of one scene: {(module, request as JSON): {cores: [answers]}}."""
    asked = {m: requests(scene, peers.load(m), args) for m, _ in workers}
    answers = {}
    for repeat in range(args.repeats):
        for module, request in turns(asked):
            runs = answers.setdefault((module, json.dumps(request)), {})
            for cores in sorted(c for m, c in workers if m == module):
                past = runs.setdefault(cores, [])
                if not past or past[0]["seconds"] < LONG:
                    past.append(workers[module, cores].run(request))
                    progress(repeat, peers.load(module), request, cores, past[-1])
    return answers


def progress(repeat, peer, request, cores, answer):
    """A line for whoever is waiting."""
    name = f"{request['scene']}, round {repeat + 1}: {peer.NAME}, {peer.label(request['setting'])}"
    print(f"{name}, {cores} core(s): {answer['seconds']:.2f} s", file=sys.stderr, flush=True)


def row(module, request, runs, clock):
    """One line of the table out of {cores: [answers]}."""
    peer, scene, setting = peers.load(module), SCENES[request["scene"]], request["setting"]
    found = runs[min(runs)]
    first = found[0]
    errors = np.abs(np.array(first["points"]) - reference.load(scene)).max((1, 2))
    work = first["lanes"] * (request["transient"] + request["samples"])
    medians = {
        c: statistics.median(a[clock if c == 1 else "seconds"] for a in each)
        for c, each in runs.items()
    }
    valid = [float(e) if np.isfinite(e) else None for e in errors]
    return dict(
        scene=scene.name,
        who=peer.NAME,
        method=peer.method(setting),
        setting=peer.label(setting),
        lanes=first["lanes"],
        failed=first["failed"],
        repeats=len(found),
        # A judged lane that failed has no error: JSON has no NaN to say so.
        errors=dict(zip(map(str, scene.judged), valid, strict=True)),
        error=None if None in valid else max(valid),
        rates={str(c): work / seconds for c, seconds in medians.items()},
        seconds={str(c): [a["seconds"] for a in each] for c, each in runs.items()},
        busy_seconds=[a["busy"] for a in found],
        compile_seconds=first["compile_seconds"],
        first_call=first["first"],
        later_calls=[a["later"] for a in found],
        jax=peer.SHAPED,
    )


def main():
    """Measure the integrators asked for, in turn; print and write what was found."""
    args = arguments()
    modules, skipped = [], []
    for module in args.peer or peers.MODULES:
        peer = peers.load(module)
        reason = peer.missing()
        skipped.append(f"{peer.NAME}: skipped, {reason}") if reason else modules.append(module)
    workers = {(m, len(c)): Worker(m, c) for m in modules for c in core_sets(args.cores)}
    clock = "busy" if args.processor_time else "seconds"
    rows = []
    try:
        for scene in [args.scene] if args.scene else SCENES:
            answers = measure(scene, workers, args)
            rows += [row(m, json.loads(r), runs, clock) for (m, r), runs in answers.items()]
    finally:
        for worker in workers.values():
            worker.close()
    report.write(rows, skipped, vars(args))


if __name__ == "__main__":
    main()
