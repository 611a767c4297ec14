"""The colour and the mark of each program, the same in every picture that compares them.

The name of a program enters; a colour and a marker leave.
"""

from benchmarks.paper.canvas import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION

PROGRAMS = {
    "jaxfil": (BLUE, "o"),
    "diffrax": (ORANGE, "s"),
    "heyoka": (BLACK, "*"),
    "SciPy": (GREEN, "D"),
    "smoothed": (PURPLE, "P"),
    "C++ vector": (VERMILLION, "^"),
    "numba vector": (SKY, "v"),
    "numba scalar": (GREY, "X"),
}


def style_of(program):
    """Of a program, also under a name with a word more ("SciPy events")."""
    return PROGRAMS.get(program) or PROGRAMS[program.split()[0]]
