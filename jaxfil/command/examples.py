"""Examples at the end of the help of each command."""

_HEAD = "examples:\n"
_EXAMPLES = {
    "simulate": """\
  jaxfil simulate coulomb-oscillator --time 14 --out motion.png
  jaxfil simulate mine.py:Valve --set stiffness=2.5 --x0 1,0 --time 40
""",
    "diagram": """\
  jaxfil diagram sd-oscillator --parameter omega --from 0.6 --to 1.3 --points 2000 \\
      --out sd.png
  jaxfil diagram belt-friction --parameter omega --from 4.6 --to 4.4 --points 500 \\
      --follow down --set f0=9 gamma1=1 --x0 -0.1,0.5 --component 1 --out belt.pdf
  jaxfil diagram impact-oscillator --parameter amplitude --from 0.3 --to 0.9 \\
      --points 800 --title "A mass and a wall" --dpi 300 --out wall.png
  jaxfil diagram mine.py:Valve --x0 1,0 --parameter flow --from 1 --to 9 --points 200 \\
      --section max:x0 --max-return 20 --out valve.png

Beside FILE.png its numbers are saved as FILE.npz, for jaxfil.load and numpy.load.
""",
    "plane": """\
  jaxfil plane sd-oscillator --grid omega=0.5:1.4:200 f0=0.1:0.6:100 --out plane.png
""",
    "basins": """\
  jaxfil basins sd-oscillator --set omega=0.6 --grid x0=-2:2:200 x1=-2:2:200 --out basins.png
""",
    "orbit": """\
  jaxfil orbit belt-friction --set gamma1=10 gamma2=0 omega=11.5 --x0 0.1,0 --out orbit.png
  jaxfil orbit slip-stick --period 8
""",
    "branch": """\
  jaxfil branch belt-friction --set gamma1=10 gamma2=0 --x0 0.1,0 --parameter omega \\
      --from 11.5 --to 10.5 --out branch.png
""",
    "bifurcations": """\
  jaxfil bifurcations belt-friction --set gamma1=10 gamma2=0 --x0 0.1,0 --parameter omega \\
      --from 11.5 --to 10.5
""",
    "spectrum": """\
  jaxfil spectrum sd-oscillator --set omega=1.05
  jaxfil spectrum sd-oscillator --parameter omega --from 0.6 --to 1.3 --points 100 \\
      --out exponents.png
""",
    "work-precision": """\
  jaxfil work-precision belt-friction --out belt.png
  jaxfil work-precision slip-stick --time 50 --steps 10 20 40 --steppers RK4 Tsit5
""",
    "show": """\
  jaxfil show sd.npz
  jaxfil show branch.npz --out branch.pdf
""",
}

_FIRST = [text.split("\n  jaxfil")[0].rstrip("\n") for text in _EXAMPLES.values()]
ALL = "\n".join(
    [f"{_HEAD}  jaxfil --list", *_FIRST, "", "The same without the script: python -m jaxfil ...\n"]
)
"""The first example of each command, for the help of `jaxfil` itself."""


def of(name: str) -> str:
    """The examples of one command."""
    return _HEAD + _EXAMPLES[name]
