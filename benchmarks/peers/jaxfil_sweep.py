"""jaxfil itself, through `bifurcation_diagram`, as a user calls it.

In: a scene, frequencies, a stepper and its steps per period. Out: sampled states.
"""

import functools

import numpy as np

from benchmarks import installed

NAME = "jaxfil"
SETTINGS = [dict(stepper="Dopri8", steps=n) for n in (12, 16, 20, 25, 32, 40, 64, 100, 160)]
SETTINGS += [dict(stepper="Taylor12", steps=n) for n in (6, 8, 12, 16, 25, 40, 64, 100)]
SETTINGS += [dict(stepper="Taylor16", steps=n) for n in (6, 8, 12, 25, 40, 64)]
SETTINGS += [dict(stepper="Tsit5", steps=n) for n in (40, 80, 160)]
SETTINGS += [dict(stepper="RK4", steps=n) for n in (100, 200)]
SHAPED = True


def missing():
    """Why it cannot run; empty where it can."""
    return installed.missing("jaxfil")


def prepare(cores):
    """Float64; the sweep itself takes the cores that the process may run on."""
    import jax

    jax.config.update("jax_enable_x64", True)


def label(setting):
    """The setting in a few letters."""
    return f"{setting['stepper']} {setting['steps']}"


def method(setting):
    """Its method."""
    return setting["stepper"]


def effort(quick):
    """The most lanes at a time; None: as many as asked for."""
    return None


@functools.cache
def stepper(name):
    """The stepper of that name; of a Taylor method the order stands behind it."""
    import diffrax

    import jaxfil as jf

    if name.startswith("Taylor"):
        return jf.Taylor(int(name.removeprefix("Taylor")))
    return jf.RK4() if name == "RK4" else getattr(diffrax, name)()


def system(scene):
    """The scene as a textbook system of the library."""
    import jaxfil as jf

    kind = {"belt": jf.systems.BeltFriction, "sd": jf.systems.SDOscillator}[scene.kind]
    return kind(**scene.parameters)


def sample(scene, omegas, transient, samples, setting, cores=1):
    """States at the end of the last `samples` periods, (lanes, samples, 2)."""
    import jaxfil as jf

    diagram = jf.bifurcation_diagram(
        system(scene),
        "omega",
        np.asarray(omegas),
        np.array(scene.x0),
        transient=transient,
        samples=samples,
        steps=setting["steps"],
        stepper=stepper(setting["stepper"]),
        progress=False,
        compact=False,
    )
    return np.asarray(diagram.xs)
