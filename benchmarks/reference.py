"""What the judged lanes really do: converged section points, and a second method that agrees.

Out: `results/reference.json`, written by `python -m benchmarks.reference` and read by the others.
The points come from the numba integrator with Dormand and Prince's 8(5,3) at 400 steps a period
(300 steps agree to 1e-13); SciPy with events at a tolerance of 1e-13, which finds its contacts on
its dense output and chooses its own steps, is the second method.
"""

import json

import numpy as np

from benchmarks import RESULTS
from benchmarks.peers import numba_scalar, scipy_events
from benchmarks.scenes import SCENES

PATH = RESULTS / "reference.json"
TRANSIENT, SAMPLES = 200, 100


def load(scene):
    """The section points of the judged lanes of one scene, (judged, SAMPLES, 2)."""
    return np.array(json.loads(PATH.read_text())[scene.name]["points"])


def make(scene):
    """The same, computed; with the deviation of the second method and of fewer steps."""
    lanes = (scene, scene.judged, TRANSIENT, SAMPLES)
    points = numba_scalar.sample(*lanes, dict(method="dop853", steps=400))
    fewer = numba_scalar.sample(*lanes, dict(method="dop853", steps=300))
    second = scipy_events.sample(*lanes, dict(rtol=1e-13))
    return dict(
        judged=scene.judged,
        steps_300=float(np.abs(fewer - points).max()),
        scipy_1e_13=float(np.abs(second - points).max()),
        points=points.tolist(),
    )


def main():
    """Compute and write the points of both scenes; print how far the methods are apart."""
    made = {name: make(scene) for name, scene in SCENES.items()}
    PATH.parent.mkdir(exist_ok=True)
    PATH.write_text(json.dumps(made))
    for name, entry in made.items():
        print(
            f"{name}: omega {entry['judged']}, 300 steps differ by {entry['steps_300']:.1e}, "
            f"SciPy by {entry['scipy_1e_13']:.1e}"
        )


if __name__ == "__main__":
    main()
