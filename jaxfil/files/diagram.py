"""A bifurcation diagram from its data set, bit for bit."""

import json
import re

import numpy as np

from jaxfil.model.dataset import component_names, key_of, outcomes_from, quantities_from
from jaxfil.model.dataset_io import NamedArrays
from jaxfil.model.labels import Labels
from jaxfil.sweep.conditions import conditions_from
from jaxfil.sweep.diagram import TAKEN, BifurcationDiagram


def diagram_from(data: NamedArrays) -> BifurcationDiagram:
    """The diagram."""
    xs = data.array("x")
    # The indices of an array may contain commas, as in `a[1, 0]`.
    swept = tuple(re.split(r", (?![^\[]*\])", data.attributes["swept"]))
    axes = [data.array(key_of(name, TAKEN)) for name in swept]
    if "point" in data.variables["x"][0]:
        values = np.stack(axes, axis=1)
    else:
        values = axes[0] if len(swept) == 1 else tuple(axes)
    return BifurcationDiagram(
        values=values,
        xs=xs,
        results=outcomes_from(data),
        parameter=swept[0] if len(swept) == 1 else swept,
        system=data.attributes["system"],
        conditions=conditions_from(data, xs.dtype, TAKEN),
        labels=_labels(data, swept),
        errors=data.array("error") if "error" in data else None,
        times=data.array("t") if "t" in data else None,
        halvings=data.array("halvings") if "halvings" in data else None,
        averages=quantities_from(data),
    )


def _labels(data: NamedArrays, swept: tuple[str, ...]) -> Labels:
    """The labels, from the names of components and the attributes of parameters."""
    names = component_names(data)
    units = dict(zip(names, map(str, data.array("unit")), strict=True)) if "unit" in data else {}
    told = {name: data.told(key_of(name, TAKEN)) for name in swept}
    units |= {name: attrs["units"] for name, attrs in told.items() if "units" in attrs}
    symbols = {n: attrs["long_name"] for n, attrs in told.items() if "long_name" in attrs}
    symbols |= json.loads(data.attributes.get("symbols", "{}"))  # absent in older files
    known = {name: unit for name, unit in units.items() if unit}
    return Labels(names, tuple(sorted(symbols.items())), tuple(sorted(known.items())))
