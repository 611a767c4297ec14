"""`python -m benchmarks.reliability.sweep_run FOLDER`: a small sweep with a checkpoint, for harm.

A folder enters; the samples' bytes leave as a hash, on the last line printed.
"""

import hashlib
import signal
import sys

import jax
import numpy as np

import jaxfil as jf

LANES = 640


def main(folder):
    """Run it, or what is left of it."""
    # Ctrl-C interrupts, also where a shell has started this in the background.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    jax.config.update("jax_enable_x64", True)
    diagram = jf.bifurcation_diagram(
        jf.systems.SDOscillator(omega=0.7),
        "omega",
        np.linspace(0.6, 0.9, LANES),
        np.array([0.3, 0.1]),
        transient=300,
        samples=4,
        steps=40,
        stepper=jf.RK4(),
        progress=False,
        checkpoint=folder,
    )
    print(f"{diagram.successful.sum()} of {LANES}", flush=True)
    print(hashlib.sha256(diagram.xs.tobytes()).hexdigest(), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
