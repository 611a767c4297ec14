"""`python -m benchmarks.check`: every integrator against answers that come from elsewhere.

The SD oscillator's state at t = 40 (long-double Taylor series), periodic orbits of the belt that
must close, and every integrator against numba's on lanes across both sweeps. Nothing enters; a line
of deviations for each integrator leaves, on standard output.
"""

import dataclasses

import numpy as np

from benchmarks import peers
from benchmarks.scenes import SCENES

SD_40 = (-3.61547391145097192825, 0.61719527603447126335)
CASE1 = SCENES["belt"].parameters | dict(gamma1=10.0, gamma2=0.0)
# (parameters, omega, state at t = 0): sticking, crossing, sticking and free orbits.
ORBITS = [
    (CASE1, 1.3, (1.562680507274925516, 1.0)),
    (CASE1, 2.44, (0.893154126723387260, 3.181072481841881173)),
    (CASE1, 9.1, (0.431566227111474261, 0.285460370360303195)),
    (CASE1, 17.0, (0.601839693239804056, 0.018194523762144070)),
    (SCENES["belt"].parameters, 4.56, (0.1483395597000811859, 0.3581899498626866293)),
]
TIGHT = {
    "jaxfil_sweep": dict(stepper="Dopri8", steps=400),
    "numba_scalar": dict(method="dop853", steps=400),
    "numba_vector": dict(method="dop853", steps=400),
    "heyoka_batch": dict(tol=1e-15),
    "diffrax_events": dict(solver="Tsit5", rtol=1e-12),
    "scipy_events": dict(rtol=1e-13),
}


def final(peer, setting):
    """Deviation of the SD oscillator at t = 40 from the series."""
    scene = dataclasses.replace(SCENES["sd"], interval=40.0)
    return np.abs(peer.sample(scene, [0.7], 0, 1, setting)[0, 0] - SD_40).max()


def closing(peer, setting):
    """How far the belt's orbits are from closing after one period."""
    worst = 0.0
    for parameters, omega, x0 in ORBITS:
        scene = dataclasses.replace(SCENES["belt"], parameters=parameters, x0=x0)
        xs = peer.sample(scene, [omega], 0, 1, setting)
        worst = max(worst, np.abs(xs[0, -1] - x0).max())
    return worst


def across(peer, setting, lanes=16, periods=6):
    """Largest deviation from numba over a few periods of lanes across both sweeps."""
    numba = peers.load("numba_scalar")
    worst = 0.0
    for scene in SCENES.values():
        lane = (scene, scene.omegas(lanes), 0, periods)
        xs = peer.sample(*lane, setting)
        worst = max(worst, np.abs(xs - numba.sample(*lane, TIGHT["numba_scalar"])).max())
    return worst


def main():
    """Print the deviations of every integrator that is installed."""
    for name in peers.MODULES:
        peer, setting = peers.load(name), TIGHT[name]
        if reason := peer.missing():
            print(f"{name}: skipped, {reason}")
            continue
        peer.prepare(1)
        # jaxfil's samples lie a forcing period apart, so it has none at t = 40.
        first = "" if name == "jaxfil_sweep" else f"x(40) {final(peer, setting):.1e}, "
        print(
            f"{peer.NAME} ({peer.label(setting)}): {first}orbits close to "
            f"{closing(peer, setting):.1e}, lanes agree with numba's to "
            f"{across(peer, setting):.1e}",
            flush=True,
        )


if __name__ == "__main__":
    main()
