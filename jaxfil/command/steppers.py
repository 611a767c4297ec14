"""Steppers of the command line by name."""

import diffrax

from jaxfil.integrate.steppers.explicit import RK4
from jaxfil.integrate.steppers.rosenbrock import Rodas5P
from jaxfil.integrate.steppers.taylor import Taylor

STEPPERS = {
    "RK4": RK4(),
    "Tsit5": diffrax.Tsit5(),
    "Dopri8": diffrax.Dopri8(),
    "Taylor": Taylor(),
    "Rodas5P": Rodas5P(),
}
