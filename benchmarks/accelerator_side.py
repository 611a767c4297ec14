"""One side of `benchmarks.accelerator`: a process that measures on one backend.

In, a line of JSON on standard input for each row: a problem of the bank or a sweep, with its dtype.
Out, a line for each: seconds of the first call and of later ones, the error, the outcome. jaxfil
asks for JAX's default backend when it makes a program, so that each backend has a process.
"""

import json
import os
import statistics
import subprocess
import sys
import threading
import time

STEPS, SAMPLES, TRANSIENT, LONG_TRANSIENT = 25, 10, 20, 290
"""Steps of a forcing period, periods sampled, and unseen: in a run that is timed, and in the one
that is compared with a converged run, which has 300 periods in all."""
# A run longer than this many seconds is not repeated.
_LONG = 2.0
# A shorter one is repeated with ten times as many periods.
_SHORT = 0.2


class Side:
    """The parent's end of such a process; `platform` is JAX's name of a backend, None the default
    one."""

    def __init__(self, platform=None):
        platforms = {} if platform is None else {"JAX_PLATFORMS": platform}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.accelerator_side"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | platforms,
        )

    def ask(self, seconds, **request):
        """The answer to a request, or None if the process has ended, or is ended here since it has
        not answered in so many seconds."""
        if self._process.poll() is not None:
            return None
        late = threading.Timer(seconds, self._process.kill)
        late.start()
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except BrokenPipeError:
            line = ""
        finally:
            late.cancel()
        return json.loads(line) if line else None

    def close(self):
        """End the process."""
        self._process.kill()
        self._process.wait()


def about():
    """The backend, its device and versions."""
    import jax

    device, cores = jax.devices()[0], len(os.sched_getaffinity(0))
    name = f"{cores} cores" if device.platform == "cpu" else device.device_kind
    return dict(platform=device.platform, device=name, jax=jax.__version__)


def problem(name, dtype):
    """A problem of the bank: how far its end is from the known one."""
    import jax.numpy as jnp
    import numpy as np

    import jaxfil as jf
    from jaxfil.model.outcomes import outcome_names
    from tests.problems import PROBLEMS

    p = PROBLEMS[name]
    start = jnp.asarray(p.x0, dtype)

    def call():
        sol = jf.solve(p.system, start, p.t0, p.t1, p.dt, max_events=64, throw=False)
        return np.asarray(sol.x_final), str(outcome_names(sol.result))

    (end, outcome), first, later = _timed(call)
    exact = p.end
    if exact is None:
        exact = p.flow(p.system, jnp.asarray(p.x0, float), p.t0, p.t1)
    error = float(np.abs(end - np.asarray(exact)).max())
    return dict(error=error, outcome=outcome, first=first, seconds=later)


def sweep(scene, dtype, lanes):
    """A sweep of a scene: its rate in steps of a lane a second, and how far the judged lanes are
    from a converged run after 300 periods."""
    import numpy as np

    from benchmarks import reference
    from benchmarks.scenes import SCENES

    scene = SCENES[scene]
    omegas = scene.omegas(lanes)
    diagram, first, later = _timed(lambda: _diagram(scene, omegas, dtype, TRANSIENT))
    error = None
    if later < _SHORT:
        # As many lanes, so that it is the same program; only those that are judged differ.
        judged = np.resize(scene.judged, lanes)
        found = _diagram(scene, judged, dtype, LONG_TRANSIENT).xs[: len(scene.judged)]
        error = float(np.abs(found - reference.load(scene)[:, -SAMPLES:]).max())
    return dict(
        error=error,
        outcome=str(int((~diagram.successful).sum())),
        first=first,
        seconds=later,
        rate=lanes * (TRANSIENT + SAMPLES) * STEPS / later,
    )


def _diagram(scene, omegas, dtype, transient):
    import diffrax
    import numpy as np

    import jaxfil as jf
    from benchmarks.peers.jaxfil_sweep import system

    return jf.bifurcation_diagram(
        system(scene),
        "omega",
        omegas,
        np.asarray(scene.x0, dtype),
        transient=transient,
        samples=SAMPLES,
        steps=STEPS,
        stepper=diffrax.Dopri8(),
        progress=False,
        compact=False,
    )


def _timed(call):
    """What a call gives, seconds of the first one, and of later ones in the median. What it gives
    is in NumPy, so that the device is done."""
    begun = time.perf_counter()
    call()
    first, spent = time.perf_counter() - begun, []
    while len(spent) < 3 and sum(spent) < _LONG:
        begun = time.perf_counter()
        out = call()
        spent.append(time.perf_counter() - begun)
    return out, first, statistics.median(spent)


def main():
    """Answer requests until the standard input ends; an error is an answer."""
    import jax

    jax.config.update("jax_enable_x64", True)
    # Answers have the standard output to themselves.
    out, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin:
        request = json.loads(line)
        make = {"about": about, "problem": problem, "sweep": sweep}[request.pop("what")]
        try:
            answer = make(**request)
        except Exception as failure:
            answer = dict(failure=f"{type(failure).__name__}: {failure}")
        print(json.dumps(answer), file=out, flush=True)


if __name__ == "__main__":
    main()
