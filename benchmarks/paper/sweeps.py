"""Sweeps: a textbook system, frequencies and an initial state enter, samples leave."""

import jaxfil as jf


def sweep_of(make, values, x0, transient, samples, **options):
    """Samples (p, samples, n) of the motion of `make()` from x0 at each forcing frequency; all
    lanes must reach their end."""
    run = {"transient": transient, "samples": samples, "progress": False} | options
    diagram = jf.bifurcation_diagram(make(), "omega", values, x0, **run)
    assert diagram.successful.all()
    return diagram.xs
