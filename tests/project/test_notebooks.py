"""Every notebook runs, at small sizes, and is stored as it ran: in order, without an error.

The first code cell of a notebook names its sizes in capitals, `POINTS, SAMPLES = 1500, 80`. Here
they are given smaller values by a line after that assignment, and the cells run as they stand.
"""

import os
import re

import nbclient
import nbformat
import pytest

from tests import ROOT
from tests.project.repository import need

need("notebooks")
FOLDER = ROOT / "notebooks"
SMALL = {
    "01_sweep_against_a_loop": {"POINTS": 8, "LOOPED": 2, "SCIPY": 1},
    "02_gradient_search": {"GUESSES": 8, "STEPS": 3},
    "03_benchmark": {"REPEATS": 2, "LANES": 2},
    "04_first_system": {"POINTS": 5},
    "05_sd_oscillator": {"POINTS": 20, "SAMPLES": 5, "LANES": 32, "VALUES": 4, "PERIODS": 20},
    "06_belt_friction": {"STOP": 2.4, "POINTS": 20, "SAMPLES": 5},
    "07_lyapunov_three_ways": {"LANES": 4, "PERIODS": 20, "TRANSIENT": 5, "WIDTHS": (0.3,)},
    "08_your_own_system": {"POINTS": 10, "SAMPLES": 5},
    "09_error_against_run_time": {
        "DTS": [0.2, 0.1, 0.05, 0.025],
        "FINE": 0.001,
        "WIDTHS": (0.1, 0.05),
    },
    "10_basins_and_maps": {"GRID": 6, "COARSE": 3, "VALUES": 2, "POINTS": 6, "PERIODS": 20},
    "11_fit_friction": {"REPEATS": 2},
    "12_autonomous": {"POINTS": 8, "SAMPLES": 6, "TRANSIENT": 5},
    "13_converter": {"POINTS": 8, "SAMPLES": 6, "TRANSIENT": 5},
    "14_impacts_with_rest": {"POINTS": 8, "SAMPLES": 5, "TRANSIENT": 5},
    "15_sweep_with_checkpoint": {"POINTS": 130, "SAMPLES": 5, "TRANSIENT": 10},
}
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def name_of(file):
    return file.stem


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def troubles(cell):
    """What a cell left behind that no reader should see: errors and anything on stderr."""
    for output in cell.outputs:
        if output.output_type == "error":
            yield f"{output.ename}: {output.evalue}"
        elif output.get("name") == "stderr":
            yield output.text


def reduced(notebook, sizes):
    """The notebook with smaller sizes, put in after the line that names them, and with RK4 where it
    leaves the stepper open: compiling takes most of the time, and grows with the stages."""
    first = code_cells(notebook)[0]
    lines = first.source.splitlines()
    at = next(i for i, line in enumerate(lines) if re.match(r"[A-Z]+(, [A-Z]+)* = ", line))
    named = lines[at].split(" = ")[0].split(", ")
    assert set(sizes) <= set(named), f"{set(sizes) - set(named)} are no sizes of the notebook"
    smaller = [f"{name} = {value!r}" for name, value in sizes.items()]
    fewer_stages = ["import diffrax", "diffrax.Dopri8 = jf.RK4"]
    first.source = "\n".join([*lines[: at + 1], *smaller, *fewer_stages, *lines[at + 1 :]])
    return notebook


def test_every_notebook_is_known():
    assert [file.stem for file in NOTEBOOKS] == sorted(SMALL)


@pytest.mark.parametrize("file", NOTEBOOKS, ids=name_of)
def test_a_notebook_is_stored_as_it_ran(file):
    notebook = nbformat.read(file, as_version=4)
    nbformat.validate(notebook)
    cells = code_cells(notebook)
    assert len(notebook.cells) - len(cells) <= 6, "a notebook is read at one sitting"
    assert all(len(cell.source.splitlines()) <= 25 for cell in cells), "a cell is a glance"
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    # Imports and definitions may have a cell of their own.
    shown = [bool(cell.outputs) for cell in cells]
    assert shown[-1] and sum(shown) * 2 >= len(cells), "cells have nothing to show"
    assert [trouble for cell in cells for trouble in troubles(cell)] == []


@pytest.mark.release
@pytest.mark.parametrize("file", NOTEBOOKS, ids=name_of)
def test_a_notebook_runs(file):
    notebook = reduced(nbformat.read(file, as_version=4), SMALL[file.stem])
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
    )
    client.execute(env=os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"})
    assert [trouble for cell in code_cells(notebook) for trouble in troubles(cell)] == []
