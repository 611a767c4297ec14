"""Basins of attraction from their data set, bit for bit."""

import numpy as np

from jaxfil.model.dataset import labels_from, outcomes_from
from jaxfil.model.dataset_io import NamedArrays
from jaxfil.sweep.basins import TAKEN, Basins
from jaxfil.sweep.conditions import conditions_from


def basins_from(data: NamedArrays) -> Basins:
    """The basins."""
    first, second = map(int, np.asarray(data.attributes["components"]))
    axes = data.array("axis_0"), data.array("axis_1")
    # A file of an earlier version does not say in which precision it was computed.
    dtype = np.dtype(data.attributes.get("x0_dtype", axes[0].dtype))
    attractors = ()
    if "attractor" in data:
        rows = zip(data.array("attractor"), data.array("period"), strict=True)
        attractors = tuple(points[:period] for points, period in rows)
    return Basins(
        axes=axes,
        labels=data.array("label"),
        attractors=attractors,
        results=outcomes_from(data),
        components=(first, second),
        system=str(data.attributes["system"]),
        conditions=conditions_from(data, dtype, TAKEN),
        names=labels_from(data),
    )
