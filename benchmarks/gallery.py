"""`python -m benchmarks.gallery [--quick]`: what the library draws, on one page.

Nothing enters; nine pictures of textbook systems leave as `benchmarks/results/gallery.png`, and
`.pdf`, each drawn by one call of `jaxfil.plot`. `--quick` computes coarse ones, to see that all is
well.
"""

import argparse
import functools
import time
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jaxfil as jf
from benchmarks import RESULTS
from benchmarks.paper import canvas as paper

PATH = RESULTS / "gallery.png"
EVERY_STEP = diffrax.SaveAt(t0=True, steps=True)
S = jf.systems
jax.config.update("jax_enable_x64", True)
BELT = S.BeltFriction(gamma1=10.0, gamma2=0.0, omega=1.3)


def portrait(ax, n):
    """Slides thick, contacts marked by their kind, the surface dashed."""
    jf.plot.phase_portrait(carried(), ax, system=BELT)
    return "stick–slip on a belt"


def history(ax, n):
    """The velocity over bands that show the mode."""
    jf.plot.time_history(carried(), ax, components=1)
    return "the same in time"


def section(ax, n):
    """Many lanes of one chaotic motion, each from another state."""
    sd = S.SDOscillator()
    values = np.full(400 // n, 0.9)
    x0 = jnp.stack([jnp.linspace(0.3, 0.5, values.size), jnp.full(values.size, 0.1)], axis=1)
    run = {"transient": 200, "samples": 50, "progress": False}
    xs = jf.bifurcation_diagram(sd, "omega", values, x0, **run).xs
    jf.plot.poincare_section(xs, ax, system=sd)
    return "a chaotic attractor: Poincaré section"


def diagram(ax, n):
    """Velocities once a period as the force grows."""
    system = S.ImpactOscillator(omega=2.7)
    values = np.linspace(3.5, 7.0, 800 // n)
    run = {"transient": 300, "samples": 60, "progress": False}
    jf.bifurcation_diagram(system, "amplitude", values, jnp.zeros(2), **run).plot(ax, 1)
    return "impacts on a wall: bifurcation diagram"


def plane(ax, n):
    """The period in the plane of frequency and force."""
    values = np.linspace(0.6, 1.3, 320 // n), np.linspace(0.05, 0.4, 256 // n)
    run = {"transient": 300, "samples": 32, "progress": False}
    x0 = jnp.array([0.3, 0.1])
    jf.bifurcation_diagram(S.SDOscillator(), ("omega", "f0"), values, x0, **run).plot(ax)
    return "periods over two parameters"


def basins(ax, n):
    """Three coexisting motions, and which initial state leads to which."""
    axes = np.linspace(-3.2, 3.2, 320 // n), np.linspace(-2.2, 2.2, 256 // n)
    run = {"transient": 400, "samples": 8, "progress": False}
    jf.basins_of_attraction(S.SDOscillator(omega=0.7), axes, **run).plot(ax)
    return "basins of attraction"


def branch(ax, n):
    """A branch of orbits round its fold."""
    found = followed()
    found.plot(ax, extremes=True)
    return "a branch of periodic orbits"


def multipliers(ax, n):
    """Those of every orbit of the same branch."""
    jf.plot.multipliers(followed(), ax)
    ax.set(xlim=(-1.4, 2.2), ylim=(-1.4, 1.4))
    return "its Floquet multipliers"


def exponents(ax, n):
    """Running estimates with the band of one standard error."""
    sd = S.SDOscillator(omega=0.9)
    jf.lyapunov_spectrum(sd, jnp.array([0.3, 0.1]), periods=1000 // n, transient=500).plot(ax)
    return "Lyapunov exponents as they converge"


@functools.cache
def carried():
    """A motion on the belt from rest."""
    return jf.solve(BELT, jnp.zeros(2), 0.0, 15.0, 0.02, saveat=EVERY_STEP)


@functools.cache
def followed():
    """The branch of the symmetric orbit of the SD oscillator."""
    sd = S.SDOscillator(omega=0.7)
    orbit = jf.periodic_orbit(sd, jnp.array([2.97, 0.62]))
    return jf.continue_orbit(sd, "omega", orbit, stop=(0.6, 0.95))


PANELS = (portrait, history, section, diagram, plane, basins, branch, multipliers, exponents)


def page(n):
    """All panels on one figure, grids and runs n times coarser."""
    figure = paper.canvas(260, 215)  # for a screen
    # Backwards: the scales of colours narrow the axes, for which legends choose their places.
    for ax, panel in reversed([*zip(figure.subplots(3, 3).flat, PANELS, strict=True)]):
        start = time.perf_counter()
        paper.entitle(ax, panel(ax, n))
        print(f"{panel.__name__:<12} {time.perf_counter() - start:5.1f} s", flush=True)
    return figure


def main():
    """Draw the page, and write it unless it is a quick one."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gallery")
    parser.add_argument("--quick", action="store_true", help="coarse grids, into the folder here")
    quick = parser.parse_args().quick
    path = Path("gallery.png") if quick else PATH
    with paper.style():
        paper.save(page(10 if quick else 1), path)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
