"""How each kind of bifurcation is drawn, the same in every picture.

The name of a kind enters; a marker and a colour leave. Nothing is computed here.
"""

from types import MappingProxyType

from jaxfil.plot.canvas import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION, YELLOW

# Marker and colour. The first five are those of tangencies, which curves have too.
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
