"""One integrator in a process of its own, pinned to its cores.

In, a line of JSON on standard input for each run: scene, lanes, periods, setting. Out, a line for
each: its seconds, what the first call traced and compiled, the judged lanes' section points. The
cores are set before anything is imported that sizes its thread pools by them. A process lives
for the whole benchmark, so that its programs stay compiled while the others take their turns.
"""

import json
import os
import subprocess
import sys
import time

from tests.oracles.compilations import Counter


class Worker:
    """The parent's end of one such process."""

    def __init__(self, module, cores):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.worker", module, json.dumps(cores)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self, request):
        """The answer to one request; an error there is an error here."""
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"the process of {self.process.args[3:]} ended; see its message")
        return json.loads(line)

    def close(self):
        """End the process."""
        self.process.stdin.close()
        self.process.wait()


def _first_call(peer, scene, request, cores):
    """Seconds of the call that compiles: on other numbers, so that new ones are seen to be free."""
    omegas = scene.omegas(request["lanes"])
    periods = (request["transient"], request["samples"])
    if not peer.SHAPED:
        omegas, periods = omegas[:2], (0, 1)
    start = time.perf_counter()
    peer.sample(scene, omegas[::-1] * 1.001, *periods, request["setting"], cores)
    return time.perf_counter() - start


def _answer(peer, request, cores, counter, known):
    """One timed run, after a first call if this program is new."""
    import numpy as np

    from benchmarks.scenes import SCENES

    scene = SCENES[request["scene"]]
    key, answer = json.dumps(request), {}
    if key not in known:
        before = dict(counter.counts)
        seconds = _first_call(peer, scene, request, cores)
        answer["first"] = counter.since(before)
        answer["compile_seconds"] = answer["first"]["seconds"] if peer.SHAPED else seconds
        known.add(key)
    omegas = scene.omegas(request["lanes"])
    before, start = dict(counter.counts), time.perf_counter()
    busy = time.process_time()
    xs = peer.sample(
        scene, omegas, request["transient"], request["samples"], request["setting"], cores
    )
    answer["seconds"] = time.perf_counter() - start
    answer["busy"] = time.process_time() - busy
    answer["later"] = counter.since(before)
    answer["lanes"] = len(omegas)
    answer["failed"] = int((~np.isfinite(xs).all((1, 2))).sum())
    picks = [int(np.flatnonzero(omegas == omega)[0]) for omega in scene.judged]
    answer["points"] = xs[picks].tolist()
    return answer


def main():
    """Answer requests until the standard input ends."""
    module, affinity = sys.argv[1], json.loads(sys.argv[2])
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, affinity)
    from benchmarks import peers

    # Answers have the standard output to themselves.
    out, sys.stdout = sys.stdout, sys.stderr
    peer, cores, counter, known = peers.load(module), len(affinity), Counter(), set()
    peer.prepare(cores)
    if "jax" in sys.modules:
        counter.watch()
    for line in sys.stdin:
        print(json.dumps(_answer(peer, json.loads(line), cores, counter, known)), file=out)
        out.flush()


if __name__ == "__main__":
    main()
