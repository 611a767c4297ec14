"""The error of an explicit and a linearly implicit method over step and stiffness, as a picture.

Nothing enters; errors, a picture of them and a sentence leave. The scene is the damped relay.
"""

import diffrax
import numpy as np

import jaxfil as jf
from benchmarks.paper import canvas as paper
from benchmarks.stiff_scenes import T1, X0, relay_exact, relays, solve
from jaxfil.model.outcomes import outcome_names

# The real stability interval of Dopri8: |R(−z)| ≤ 1 up to here.
STABLE = 5.17


def errors():
    """{name: (dts, dampings, errors, told)}, the last two of shape (dampings, dts)."""
    dts, dampings = np.geomspace(1e-3, 0.3, 16), 10.0 ** np.arange(0, 8.25, 0.5)
    exact = np.array([relay_exact(float(d), 0.0)[0] for d in dampings])
    grid = [(d, h) for d in dampings for h in dts]
    found = {}
    for name, stepper in (("Dopri8 (explicit)", diffrax.Dopri8()), ("Rodas5P", jf.Rodas5P())):
        systems = relays([d for d, _ in grid], 0.0)
        sol = solve(systems, X0, T1, [h for _, h in grid], stepper, 256)
        xs = np.asarray(sol.xs[:, -1]).reshape(len(dampings), len(dts), 2)
        apart = np.abs(xs - exact[:, None]).max(axis=-1)
        told = (outcome_names(sol.result) != "successful").reshape(apart.shape)
        found[name] = dts, dampings, apart, told
    return found


def picture(found, path):
    """Write the picture, as PNG and PDF."""
    with paper.style():
        paper.save(_figure(found), path)


def _figure(found):
    """A panel a method: the error as colour, failures hatched."""
    from matplotlib.patches import Patch
    from matplotlib.patheffects import Normal, Stroke

    figure = paper.canvas(paper.PAGE, 90)
    axes = figure.subplots(1, len(found), sharey=True)
    drawn = [_panel(ax, name, *grid) for ax, (name, grid) in zip(axes, found.items(), strict=True)]
    dts = next(iter(found.values()))[0]
    told = f"stability limit d·dt = {STABLE}; beyond, steps are halved"
    (limit,) = axes[0].plot(dts, STABLE / dts, color="white", lw=2, ls="--", label=told)
    limit.set_path_effects([Stroke(linewidth=3.5, foreground="black"), Normal()])
    axes[0].set_ylabel("damping d of one side")
    figure.colorbar(drawn[-1], ax=axes, label="error of the state at t = 12")
    marks = [Patch(facecolor="0.85", edgecolor="0.3", hatch="xx", label="reported: not successful")]
    if any((~told & ~(errors < 1)).any() for _, _, errors, told in found.values()):
        label = "unstable: error above 1"
        marks.append(Patch(facecolor="0.85", edgecolor="0.3", hatch="..", label=label))
    paper.below(figure, [limit, *marks], 3)
    figure.suptitle("A relay with one damped side: error over step and stiffness")
    return figure


def _panel(ax, name, dts, dampings, errors, told):
    """The errors of one method; what was told or unstable is hatched."""
    from matplotlib.colors import LogNorm

    unstable = ~told & ~(errors < 1)
    shown = np.maximum(np.ma.masked_where(told | unstable, errors), 1e-14)
    drawn = ax.pcolormesh(
        dts, dampings, shown, norm=LogNorm(1e-14, 1), cmap="viridis", shading="nearest"
    )
    grey = dict(cmap="Greys", vmin=0, vmax=4, edgecolor="0.3", linewidth=0, shading="nearest")
    for where, hatch in ((told, "xx"), (unstable, "..")):
        marked = np.ma.masked_where(~where, np.ones_like(errors))
        ax.pcolor(dts, dampings, marked, hatch=hatch, **grey)
    ax.set(xscale="log", yscale="log", xlabel="step dt")
    paper.entitle(ax, name)
    return drawn


def summary(found):
    """A sentence that counts, for each method, what was right, wrong and told."""
    parts = []
    for name, (_, _, errors, told) in found.items():
        wrong = int((~told & ~(errors < 1)).sum())
        parts.append(
            f"{name}: of {errors.size} pairs {int((~told & (errors < 1e-6)).sum())} below "
            f"1e-6, {wrong} above 1, {int(told.sum())} told"
        )
    return "; ".join(parts) + "."
