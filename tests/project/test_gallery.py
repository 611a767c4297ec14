"""`python -m benchmarks.gallery --quick` draws its page: every panel is still one call away."""

import sys

import diffrax
import numpy as np
import pytest

import jaxfil as jf

pytest.importorskip("benchmarks", reason="the sources of a release do not have them")

from benchmarks import gallery
from tests.pictures import SD, made


def followed():
    """A made-up branch: to compile a continuation takes longer than all other panels do."""
    s = np.linspace(-1.0, 1.0, 9)
    x0 = np.stack([s, 2 * s], axis=1)
    orbits = made(jf.Orbit, x0=x0, system=SD, multipliers=0.3 + 0.8j * x0)
    told = {"parameter": "omega", "values": 0.9 - 0.1 * s**2, "points": [], "stable": s < 0}
    return made(jf.Branch, orbits=orbits, extremes=lambda self: (-abs(x0), abs(x0)), **told)


@pytest.mark.release
def test_the_quick_page_is_drawn(monkeypatch, tmp_path, capsys):
    pages, draw = [], gallery.page
    monkeypatch.setattr(gallery, "page", lambda n: pages.append(draw(n)) or pages[0])
    monkeypatch.setattr(gallery, "followed", followed)
    monkeypatch.setattr(diffrax, "Dopri8", jf.RK4)  # compiles in half the time
    monkeypatch.setattr(sys, "argv", ["gallery", "--quick"])
    monkeypatch.chdir(tmp_path)
    gallery.main()
    told = capsys.readouterr().out.splitlines()
    assert {line.split()[0] for line in told[:-1]} == {panel.__name__ for panel in gallery.PANELS}
    assert (tmp_path / "gallery.png").stat().st_size > 50_000
    panels = [ax for ax in pages[0].axes if ax.get_title(loc="left")]
    assert len(panels) == 9 and all(ax.has_data() and ax.get_xlabel() for ax in panels)
