"""One figure made and written: its name enters, its table and the seconds it took leave as text."""

import importlib
import time

import jax

from benchmarks.paper.canvas import save, style
from benchmarks.paper.table import layout

FIGURES = ("fig4", "fig5", "fig6", "fig8", "fig9", "fig10", "fig11", "section5")


def make(name, out):
    """Write `out/name.png`, `out/name.pdf` and `out/name.txt`."""
    begun, spent = time.perf_counter(), time.process_time()
    jax.config.update("jax_enable_x64", True)
    module = importlib.import_module(f"benchmarks.paper.{name}")
    with style():
        figure, rows = module.make()
        save(figure, out / name)
    table = layout(module.TITLE, rows)
    (out / f"{name}.txt").write_text(table)
    wall, spent = time.perf_counter() - begun, time.process_time() - spent
    return f"{table}{name}: {wall:.0f} s, {spent:.0f} s of processor time\n"
