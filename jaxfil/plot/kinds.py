"""The style of each kind of bifurcation, the same in every picture."""

from types import MappingProxyType

from jaxfil.plot.canvas import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION, YELLOW

# Marker and colour. The first five belong to tangencies, on curves too.
KINDS = MappingProxyType(
    {
        "grazing": ("v", BLUE),
        "grazing-sliding": ("o", VERMILLION),
        "adding-sliding": ("s", GREEN),
        "crossing-sliding": ("^", PURPLE),
        "switching-sliding": ("D", ORANGE),
        "fold": ("<", BLUE),
        "period-doubling": ("P", SKY),
        "neimark-sacker": ("h", YELLOW),
        "hopf": ("p", SKY),
        "persistence": ("d", GREEN),
        "nonsmooth-fold": (">", VERMILLION),
        "branch-point": ("*", GREEN),
        "rest": ("_", BLACK),
        "contacts": (".", BLACK),
        "undecided": ("X", BLACK),
    }
)
