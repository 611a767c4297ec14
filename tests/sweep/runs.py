"""A small sweep of the SD oscillator, which several tests keep, break off and take up again."""

import numpy as np

import jaxfil as jf

X0 = np.array([0.3, 0.1])
ESTIMATED = {"estimate_error": True, "steps": 10}


def sweep(values, parameter="omega", x0=X0, **kwargs):
    run = {"transient": 2, "samples": 2, "steps": 20, "stepper": jf.RK4(), "progress": False}
    system = kwargs.pop("system", jf.systems.SDOscillator(omega=0.7))
    return jf.bifurcation_diagram(system, parameter, values, x0, **run | kwargs)
