"""The two workloads: what every integrator here is given, and nothing about how it is solved.

Nothing enters; a `Scene` for each leaves.

A `Scene` holds equations by name with their numbers, the range of the swept frequency, the initial
state, and the frequencies at which a periodic lane is compared with a converged run.
"""

import dataclasses
import math

import numpy as np

BELT = dict(f0=10.0, g=9.81, mu=0.6, alpha=-0.05, beta=0.0, gamma1=0.0, gamma2=1e4, v=1.0)
SD = dict(f0=0.25, zeta=0.0141)


@dataclasses.dataclass(frozen=True)
class Scene:
    """One workload. `kind` is "belt" or "sd"; `parameters` are all of its numbers but omega."""

    name: str
    kind: str
    parameters: dict
    low: float
    high: float
    x0: tuple[float, float]
    judged: tuple[float, ...]
    interval: float | None = None

    def period(self, omega):
        """Time between two samples: the forcing period, unless an `interval` was set."""
        return 2 * math.pi / omega if self.interval is None else self.interval

    def omegas(self, lanes):
        """`lanes` equally spaced frequencies, the nearest ones moved onto the judged ones."""
        values = np.linspace(self.low, self.high, max(lanes, len(self.judged)))
        taken = []
        for omega in self.judged:
            order = np.argsort(np.abs(values - omega), kind="stable")
            index = next(i for i in order if i not in taken)
            values[index] = omega
            taken.append(index)
        return values

    def constants(self):
        """The numbers in the order in which the peers' hand-written fields read them."""
        p = self.parameters
        if self.kind == "sd":
            return (p["f0"], p["zeta"])
        g = p["g"]
        products = (p["mu"] * g, p["alpha"] * g, p["beta"] * g)
        return (p["f0"], *products, p["gamma1"], p["gamma2"], p["v"])


SCENES = {
    "belt": Scene("belt", "belt", BELT, 4.2, 4.7, (0.0, 0.0), (4.3, 4.7)),
    "sd": Scene("sd", "sd", SD, 0.6, 1.3, (0.3, 0.1), (0.7,)),
}
