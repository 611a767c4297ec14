"""The command line: what it writes is what the library computes, and mistakes get one line."""

import os
import re
import shlex
import signal
import subprocess
import sys
import time

import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxfil as jf
from jaxfil.__main__ import main
from tests import ROOT

README = ROOT / "README.md"
SMALL = ["--from", "0.6", "--to", "0.7", "--points", "3", "--transient", "2", "--samples", "4"]


def diagram(tmp_path, *words, name="sd-oscillator", parameter="omega"):
    """Run a small sweep in this process; its exit code and its numbers leave."""
    out = tmp_path / "picture.png"
    command = ["diagram", name, "--parameter", parameter, *SMALL, "--out", str(out), *words]
    code = main(command)
    with np.load(out.with_suffix(".npz")) as saved:
        return code, dict(saved)


def refused(capsys, *words):
    """The one line that a mistake is answered with."""
    assert main(list(words)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("jaxfil: ") and err.count("\n") == 1 and err.endswith("\n")
    return err


@pytest.mark.slow
def test_the_command_in_readme_draws_its_diagram(tmp_path):
    (command,) = re.findall(r"-m (jaxfil diagram .* --out .*)", README.read_text())
    words = shlex.split(command)
    out = words[words.index("--out") + 1]
    words[words.index("--points") + 1] = "40"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", *words, "--transient", "20", "--samples", "10"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(
        rf"40 values of omega in [\d.]+ s: 40 successful; wrote {out} and \S+\.npz\n", done.stdout
    )
    assert "40/40" in done.stderr, "the progress bar ends full"
    picture = matplotlib.image.imread(tmp_path / out)
    assert picture.shape == (1000, 1600, 4)
    assert (picture[100:-150, 200:-50, :3] < 0.9).any(axis=2).sum() > 200, "the picture is blank"


def test_the_numbers_beside_the_picture_are_those_of_the_library(tmp_path):
    code, saved = diagram(tmp_path)
    expected = jf.bifurcation_diagram(
        jf.systems.SDOscillator(),
        "omega",
        np.linspace(0.6, 0.7, 3),
        jnp.array(jf.systems.TEXTBOOK["sd-oscillator"][1]),
        transient=2,
        samples=4,
        steps=40,
        progress=False,
    )
    assert code == 0
    assert_array_equal(saved["values"], expected.values)
    assert_array_equal(saved["xs"], expected.xs)
    assert_array_equal(saved["results"], ["successful"] * 3)
    assert (saved["parameter"], saved["system"]) == ("omega", "sd-oscillator")
    assert dict(zip(saved["fixed_names"], saved["fixed_values"], strict=True)) == {
        "f0": 0.25,
        "zeta": 0.0141,
        "alpha": 0.0,
    }


def test_the_numbers_beside_the_picture_are_loaded_as_a_diagram(tmp_path):
    _, saved = diagram(tmp_path, "--follow", "down")
    back = jf.load(tmp_path / "picture.npz")
    assert_array_equal(back.xs, saved["xs"])
    assert (back.system, back.parameter) == ("SDOscillator", "omega")
    assert back.conditions.follow == saved["follow"] == "down"
    assert back.conditions.parameters == {"f0": 0.25, "zeta": 0.0141}
    assert_array_equal(back.conditions.x0, saved["x0"])


def test_settings_state_and_direction_reach_the_sweep(tmp_path):
    _, saved = diagram(
        tmp_path, "--x0", "-0.4,0.2", "--set", "f0=0.3", "zeta=2e-2", "--follow", "down"
    )
    expected = jf.bifurcation_diagram(
        jf.systems.SDOscillator(f0=0.3, zeta=2e-2),
        "omega",
        np.linspace(0.6, 0.7, 3),
        jnp.array([-0.4, 0.2]),
        transient=2,
        samples=4,
        follow="down",
        progress=False,
    )
    assert_array_equal(saved["xs"], expected.xs)
    assert_array_equal(saved["x0"], [-0.4, 0.2])
    assert saved["follow"] == "down"


def test_steps_and_a_repeated_setting_reach_the_sweep(tmp_path):
    _, coarse = diagram(tmp_path, "--steps", "20", "--set", "f0=0.3", "--set", "zeta=0.02")
    _, fine = diagram(tmp_path, "--set", "f0=0.3", "zeta=0.02")
    assert coarse["steps"] == 20
    assert_array_equal(coarse["fixed_values"], fine["fixed_values"])
    assert 0 < np.abs(coarse["xs"] - fine["xs"]).max() < 1e-4


def test_a_falling_range_keeps_its_order(tmp_path):
    _, saved = diagram(tmp_path, "--from", "0.9", "--to", "0.8")
    assert_array_equal(saved["values"], np.linspace(0.9, 0.8, 3))


def test_quiet_prints_nothing(tmp_path, capfd):
    assert diagram(tmp_path, "--quiet")[0] == 0
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
@pytest.mark.parametrize(("words", "keeps"), [([], True), (["--no-cache"], False)])
def test_what_is_compiled_is_kept_in_the_folder_that_the_platform_names(tmp_path, words, keeps):
    kept, out = tmp_path / "kept", str(tmp_path / "a.png")
    named = {"XDG_CACHE_HOME": str(kept), "LOCALAPPDATA": str(kept), "HOME": str(kept)}
    env = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")} | named
    command = ["diagram", "sd-oscillator", "--parameter", "omega", *SMALL, "--out", out, "--quiet"]
    done = subprocess.run([sys.executable, "-m", "jaxfil", *command, *words], env=env)
    assert done.returncode == 0
    assert any("jaxfil" in str(path) for path in kept.rglob("*-cache")) == keeps


def test_a_lane_that_ends_early_is_counted_and_the_rest_are_drawn(tmp_path, capsys):
    code, saved = diagram(tmp_path, "--x0", "0,0")
    assert code == 1, "from (0, 0) no lane has a unique solution"
    assert_array_equal(saved["results"], ["nonunique"] * 3)
    assert ": 3 nonunique; wrote" in capsys.readouterr().out


def test_list_names_every_system_and_parameter_with_its_default(capsys):
    assert main(["--list"]) == 0
    listing = capsys.readouterr().out
    assert len(re.findall(r"^[a-z-]+", listing, re.M)) == len(jf.systems.TEXTBOOK) == 12
    assert "belt-friction\n    f0=10 g=9.81 mu=0.6 alpha=-0.05 beta=0 gamma1=0" in listing
    assert (
        "bouncing-ball (no period: a diagram needs --section)\n    g=9.8 restitution=0.9, from"
        in listing
    )


@pytest.mark.parametrize(
    "words, answer",
    [
        (["draw"], "diagram"),
        (["diagram"], "NAME"),
        (["--name", "duffing"], "sd-oscillator, belt-friction, coulomb-oscillator,"),
        (["--name", "duffing"], "two-relays, or FILE.py:CLASS; it was 'duffing'"),
        (["--name", "nowhere.py:Duffing"], "of a file that exists"),
        (["--name", "two-relays"], "must name a parameter, but the system has no parameters"),
        (["--name", "SD_oscilator"], "it was 'SD_oscilator'; did you mean 'sd-oscillator'?"),
        (["--parameter", "Omega"], "f0, zeta, omega, alpha"),
        (["--parameter", "Omega"], "it was 'Omega'; did you mean 'omega'?"),
        (["--set", "zetta=1"], "it was 'zetta'; did you mean 'zeta'?"),
        (["--set", "mass=1"], "f0, zeta, alpha"),
        (["--set", "omega=1"], "f0, zeta, alpha"),
        (["--set", "f0"], "P=VALUE"),
        (["--set", "f0=big"], "finite number"),
        (["--from", "low"], "finite number"),
        (["--to", "nan"], "finite number"),
        (["--points", "0"], "whole number of 1 or more"),
        (["--points", "1e3"], "whole number of 1 or more"),
        (["--transient", "-1"], "whole number of 0 or more"),
        (["--samples", "0"], "whole number of 1 or more"),
        (["--steps", "2.5"], "whole number of 1 or more"),
        (["--x0", "1"], "2 numbers"),
        (["--x0", "1,2,3"], "2 numbers"),
        (["--x0", "-1,a"], "finite number"),
        (["--component", "2"], "0 to 1"),
        (["--follow", "left"], "'up', 'down'"),
        (["--out", "picture.jpeg"], ".png, .pdf, .svg"),
        (["--out", "no/such/folder/picture.png"], "folder"),
        (["--speed", "9"], "--speed"),
        (["--dpi", "0"], "whole number of 1 or more"),
        (["--section", "x0"], "xI=C, xI=C,up"),
        (["--section", "x2=0", "--max-return", "9"], "0 to 1"),
        (["--section", "max:x1"], "--max-return is required with --section"),
        (["--max-return", "9"], "goes with --section"),
        (["simulate", "sd-oscillator", "--time", "0"], "--time: must be positive"),
        (["spectrum", "sd-oscillator", "--from", "1"], "are given together"),
        (["spectrum", "slip-stick"], "--interval is required"),
        (["orbit", "slip-stick"], "--period is required"),
        (["plane", "sd-oscillator", "--grid", "f0=1:2:3", "--out", "a.png"], "expected 2"),
        (["plane", "den-hartog", "--grid", "f=1:2:3", "omega=1:2:3", "--out", "a.png"], "friction"),
        (["plane", "den-hartog", "--grid", "f=1:2", "omega=1:2:3", "--out", "a.png"], "P=A:B:N"),
        (["basins", "den-hartog", "--grid", "x0=1:2:3", "omega=1:2:3", "--out", "a.png"], "x0, x1"),
        (["basins", "den-hartog", "--grid", "x0=1:2:3", "x2=1:2:3", "--out", "a.png"], "0 to 1"),
        (["show", "nothing.npz"], "FILE must exist"),
        (
            ["orbit", "impact-oscillator", "--set", "restitution=-1"],
            "`restitution` of ImpactOscillator must be 0 or more, got -1.0",
        ),
        (
            ["orbit", "sd-oscillator", "--set", "force.f0=2"],
            "one of f0, zeta, omega; got 'force.f0",
        ),
    ],
    ids=" ".join,
)
def test_a_mistake_is_answered_by_one_line_that_says_what_is_allowed(
    words, answer, capsys, monkeypatch, tmp_path
):
    def computes(*args, **kwargs):
        raise AssertionError("a mistake must be found before computing starts")

    monkeypatch.setattr("jaxfil.command.diagram.bifurcation_diagram", computes)
    monkeypatch.chdir(tmp_path)
    if words[:1] == ["--name"]:
        command = ["diagram", words[1], "--parameter", "omega", *SMALL, "--out", "a.png"]
    elif words[:1] and words[0].startswith("--"):
        command = ["diagram", "sd-oscillator", "--parameter", "omega", *SMALL, "--out", "a.png"]
        command += words
    else:
        command = words
    assert answer in refused(capsys, *command)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "words, code, told",
    [
        (["--version"], 0, rf"jaxfil {re.escape(jf.__version__)}\n"),
        (["--help"], 0, r"usage: (.*\n)+examples:\n  jaxfil --list\n(.*\n)+"),
        ([], 0, r"usage: (.*\n)+examples:\n  jaxfil --list\n(.*\n)+"),
        (["diagram", "--help"], 0, r"(.*\n)+.* --title .* --dpi 300 (.*\n)+"),
        (["work-precision", "--help"], 0, r"(.*\n)+examples:\n(.*\n)+"),
        (["diagram", "sd-oscillator", "--points", "0"], 2, "jaxfil: .*must be a whole number.*\n"),
    ],
)
def test_what_needs_no_jax_is_answered_before_it_is_imported(words, code, told):
    program = "import runpy, sys; sys.argv[0] = '-m'; sys.modules['jax'] = None\n"
    program += "runpy.run_module('jaxfil', run_name='__main__')"
    command = [sys.executable, "-W", "error", "-c", program, *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == code and re.fullmatch(told, done.stdout + done.stderr), done


@pytest.mark.parametrize(
    "words, compact", [([], None), (["--compact"], True), (["--no-compact"], False)]
)
def test_the_grade_of_the_program_reaches_the_sweep(tmp_path, monkeypatch, words, compact):
    class Asked(Exception):
        pass

    def asked(*args, **options):
        raise Asked(options["compact"])

    monkeypatch.setattr("jaxfil.command.diagram.bifurcation_diagram", asked)
    with pytest.raises(Asked, match=str(compact)):
        diagram(tmp_path, *words)


@pytest.mark.slow
def test_the_stepper_and_the_checkpoint_reach_the_sweep(tmp_path):
    kept = tmp_path / "kept"
    words = ["--stepper", "Taylor", "--checkpoint", str(kept), "--steps", "16"]
    code, first = diagram(tmp_path, *words)
    assert code == 0 and str(first["stepper"]) == "Taylor(12)" and list(kept.iterdir())
    _, again = diagram(tmp_path, *words)
    assert_array_equal(again["xs"], first["xs"])
    _, other = diagram(tmp_path, "--steps", "80")
    # Errors of 16 steps of order 12 and of 80 of order 8 in six periods.
    assert np.max(np.abs(other["xs"] - first["xs"])) < 1e-9


def test_a_picture_has_the_title_and_the_dots_asked_for(tmp_path, monkeypatch):
    pages, page = [], jf.plot.page
    monkeypatch.setattr("jaxfil.plot.page", lambda: pages.append(page()) or pages[-1])
    diagram(tmp_path, "--title", "Snap-through", "--dpi", "50")
    assert matplotlib.image.imread(tmp_path / "picture.png").shape == (250, 400, 4)
    diagram(tmp_path, "--set", "f0=0.3")
    assert matplotlib.image.imread(tmp_path / "picture.png").shape == (1000, 1600, 4)
    diagram(tmp_path, "--stepper", "RK4")
    titles = [page.axes[0].get_title(loc="left") for page in pages]
    assert titles[0] == "Snap-through"
    assert titles[1].startswith("sd-oscillator, f₀ = 0.3, from (1.995, 0.085), 2 + 4 periods")
    assert titles[1].endswith(" steps") and titles[2].endswith(" steps by RK4")


OWN = """\
import jax
import jax.numpy as jnp
import jaxfil as jf


class Relay(jf.System):
    '''x'' = -k x - F sgn x': amplitudes fall by 2 F/k each half turn.'''

    friction: jax.Array
    stiffness: float = 1.0

    def vector_field(self, t, x, side):
        return jnp.stack([x[1], -self.stiffness * x[0] - self.friction * side])

    def switching(self, t, x):
        return x[1]


class Broken(Relay):
    def vector_field(self, t, x, side):
        raise ValueError("in its own file")


class Chain(jf.System):
    n: int = 2
    fixed: bool = False
    stiffness: float = 1

    def vector_field(self, t, x, side):
        pull = 0.0 if self.fixed else sum(x[1 + k] for k in range(self.n - 1))
        return jnp.stack([pull - self.stiffness * x[0]] + [-x[k] for k in range(1, self.n)])


class Gear(jf.System):
    '''x' = -n x + cos t, of amplitude 1/sqrt(n^2 + 1).'''

    teeth: int
    law: str = "none"
    period = 6.283185307179586

    def vector_field(self, t, x, side):
        return jnp.cos(t) - self.teeth * x
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A folder with a file of systems, to work in."""
    (tmp_path / "own.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])
    return tmp_path


def test_a_system_of_a_file_is_simulated_and_shown(own, capsys):
    words = ["own.py:Relay", "--set", "friction=0.2", "--x0", "3,0", "--time", "7"]
    assert main(["simulate", *words, "--out", "motion.png"]) == 0
    card = capsys.readouterr().out
    assert card.startswith("Solution: successful") and "2 contacts" in card
    back = jf.load(own / "motion.npz")
    assert_allclose(back.xs[np.argmin(np.abs(back.ts - 2 * np.pi)), 0], 3 - 4 * 0.2, rtol=1e-5)
    assert matplotlib.image.imread(own / "motion.png").shape == (1000, 1600, 4)
    assert main(["show", "motion.npz", "--out", "again.png"]) == 0
    assert capsys.readouterr().out == card
    assert matplotlib.image.imread(own / "again.png").size


def test_a_system_of_a_file_is_swept_at_a_section(own):
    words = ["own.py:Relay", "--x0", "3,0", "--parameter", "friction", "--from", "0.1", "--to"]
    words += ["0.3", "--points", "3", "--section", "max:x0", "--max-return", "9", "--error"]
    words += ["--transient", "0", "--samples", "2", "--out", "own.png", "--quiet"]
    assert main(["diagram", *words]) == 0
    diagram = jf.load(own / "own.npz")
    friction = np.linspace(0.1, 0.3, 3)
    assert_allclose(diagram.xs[..., 0], 3 - 4 * np.outer(friction, [1, 2]), rtol=1e-9)
    assert diagram.errors is not None and diagram.errors.max() < 1e-9


def test_whole_numbers_of_a_system_of_a_file_remain_whole(own, capsys):
    words = ["simulate", "own.py:Chain", "--x0", "1,0.5,0.2", "--time", "1", "--set", "stiffness=2"]
    for fixed, pull in (("1", 0.0), ("0", 0.7)):
        assert main([*words, "n=3", f"fixed={fixed}", "--out", "chain.png"]) == 0
        exact = np.exp(-2) + pull * (np.exp(-1) - np.exp(-2))
        assert_allclose(jf.load(own / "chain.npz").xs[-1, 0], exact, rtol=1e-5)
    capsys.readouterr()
    assert "n must be an integer, it was 2.5" in refused(capsys, *words, "n=2.5")
    assert "fixed must be 0 or 1, it was 2" in refused(capsys, *words, "n=3", "fixed=2")


def test_an_orbit_is_shown_with_a_parameter_that_is_absent_by_default(tmp_path, capsys):
    system = jf.systems.SDOscillator(alpha=0.5, zeta=0.3)
    run = {"transient": 40, "steps": 20, "stepper": jf.RK4()}
    orbit = jf.periodic_orbit(system, jnp.array([1.0, 0.1]), **run)
    orbit.save(tmp_path / "orbit.npz")
    assert main(["show", str(tmp_path / "orbit.npz")]) == 0
    assert capsys.readouterr().out == f"{orbit}\n"


def test_an_orbit_is_shown_with_the_whole_numbers_that_it_was_found_with(own, monkeypatch):
    pages, page = [], jf.plot.page
    monkeypatch.setattr("jaxfil.plot.page", lambda *a: pages.append(page(*a)) or pages[-1])
    words = ["own.py:Gear", "--set", "teeth=3", "--x0", "0.1"]
    assert main(["orbit", *words, "--out", "gear.png"]) == 0
    assert main(["show", "gear.npz", "own.py:Gear", "--out", "again.png"]) == 0
    for each in pages:
        line = each.axes[0].lines[0].get_ydata()
        assert_allclose(np.nanmax(line), 10**-0.5, rtol=1e-2)


def test_a_run_that_stops_at_its_start_has_numbers_and_no_picture(own, capsys):
    """At (0, 0) the motion of the oscillator is not unique."""
    words = ["simulate", "sd-oscillator", "--x0", "0,0", "--out", "motion.png"]
    assert main(words) == 1
    assert capsys.readouterr().err == "jaxfil: the run stopped at its start; wrote motion.npz\n"
    assert jf.RESULTS.names(jf.load(own / "motion.npz").result) == "nonunique"
    assert not (own / "motion.png").exists()


def test_mistakes_in_a_system_of_a_file(own, capsys):
    relay = ["simulate", "own.py:Relay", "--x0", "3,0"]
    assert "--set must give friction" in refused(capsys, *relay)
    assert "--x0 is required" in refused(capsys, *relay[:2], "--set", "friction=1")
    told = refused(capsys, "simulate", "own.py:Relai", "--x0", "3,0")
    assert "must be one of Relay, Broken, Chain, Gear; it was 'Relai'" in told
    assert told.endswith("; did you mean 'Relay'?\n")
    # The library's sentence, where the state does not fit the field.
    assert "JAX" not in refused(capsys, *relay[:3], "3", "--set", "friction=1")
    with pytest.raises(ValueError, match="in its own file"):
        main(["simulate", "own.py:Broken", "--x0", "3,0", "--set", "friction=1"])


BELT = ["belt-friction", "--set", "gamma1=10", "gamma2=0", "--x0", "0.1,0"]


@pytest.mark.slow
def test_an_orbit_its_branch_and_its_bifurcations(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["orbit", *BELT, "--set", "omega=11.5", "--out", "orbit.png"]) == 0
    assert capsys.readouterr().out.startswith("Orbit of BeltFriction: successful")
    words = [*BELT, "--parameter", "omega", "--from", "11.5", "--to", "10.5"]
    assert main(["branch", *words, "--out", "branch.png"]) == 0
    assert "contacts at 10.9049758221" in capsys.readouterr().out
    assert main(["bifurcations", *words]) == 0
    assert "grazing-sliding    omega = 10.90497582209" in capsys.readouterr().out
    assert main(["show", "orbit.npz"]) == main(["show", "branch.npz", "--out", "b.pdf"]) == 0
    told = capsys.readouterr().out
    assert "Orbit of BeltFriction" in told and "Branch of BeltFriction" in told
    assert {p.name for p in tmp_path.iterdir()} == {
        "orbit.png", "orbit.npz", "branch.png", "branch.npz", "b.pdf"
    }  # fmt: skip


@pytest.mark.release
def test_exponents_of_one_value_and_of_several(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["spectrum", "impact-oscillator", "--periods", "20", "--transient", "0"]
    words += ["--stepper", "RK4", "--steps", "20"]
    # Too weakly forced to reach the wall: the exponents' sum is minus the damping.
    assert main([*words, "--set", "damping=1"]) == 0
    assert capsys.readouterr().out.startswith("LyapunovSpectrum: successful")
    swept = ["--parameter", "damping", "--from", "0.8", "--to", "1.2", "--points", "3"]
    assert main([*words, *swept, "--out", "exponents.png"]) == 0
    assert capsys.readouterr().out.startswith("3 values of damping: 3 successful; wrote")
    with np.load(tmp_path / "exponents.npz") as saved:
        assert_allclose(saved["exponents"].sum(axis=1), -saved["damping"], rtol=1e-3)


@pytest.mark.slow
def test_a_plane_and_basins_are_those_of_the_library(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["--transient", "3", "--samples", "4", "--steps", "20", "--stepper", "RK4", "--quiet"]
    plane = ["plane", "sd-oscillator", "--grid", "omega=0.6:1.2:3", "f0=0.2:0.3:2"]
    assert main([*plane, *words, "--out", "plane.png"]) == 0
    options = {"transient": 3, "samples": 4, "steps": 20, "stepper": jf.RK4(), "progress": False}
    x0 = jf.systems.TEXTBOOK["sd-oscillator"][1]
    omega, f0 = np.linspace(0.6, 1.2, 3), np.linspace(0.2, 0.3, 2)
    expected = jf.bifurcation_diagram(
        jf.systems.SDOscillator(), ("omega", "f0"), (omega, f0), jnp.array(x0), **options
    )
    assert_array_equal(jf.load(tmp_path / "plane.npz").xs, expected.xs)
    basins = ["basins", "sd-oscillator", "--grid", "x0=-1:1:2", "x1=0.1:0.2:2"]
    basins += ["--set", "omega=0.6", "zeta=0.1"]
    assert main([*basins, *words, "--out", "basins.png"]) == 0
    expected = jf.basins_of_attraction(
        jf.systems.SDOscillator(omega=0.6, zeta=0.1), ([-1.0, 1.0], [0.1, 0.2]), **options
    )
    assert_array_equal(jf.load(tmp_path / "basins.npz").labels, expected.labels)
    assert all(matplotlib.image.imread(f"{name}.png").size for name in ("plane", "basins"))


LONG = ["diagram", "sd-oscillator", "--parameter", "omega", "--from", "0.6", "--to", "0.9"]


def interrupted(folder, words, until, times=1):
    """A command that Ctrl-C is pressed in once its stderr matches: exit code, stdout and stderr."""
    with subprocess.Popen(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        assert process.stderr is not None
        told = b""
        while not re.search(until, told):
            more = os.read(process.stderr.fileno(), 4096)
            assert more, told
            told += more
        for _ in range(times):
            process.send_signal(signal.SIGINT)
            time.sleep(0.1)  # two at once are one
        out, err = process.communicate()
    # The bar rewrites its own line.
    lines = [line.split("\r")[-1] for line in (told + err).decode().splitlines()]
    return process.returncode, out, [line for line in lines if line and "lane/s" not in line]


@pytest.mark.slow
@pytest.mark.usefixtures("ctrl_c_interrupts")
@pytest.mark.parametrize(
    "until, times, line",
    [
        (b"compiling", 1, "jaxfil: interrupted"),
        pytest.param(rb" [1-9]\d*/20000", 3, "jaxfil: interrupted", marks=pytest.mark.release),
        (rb" [1-9]\d*/20000", 1, r"jaxfil: interrupted: \d+ of 20000 lanes are finished; wrote .*"),
    ],
    ids=["compiling", "running, again and again", "running"],
)
def test_ctrl_c_is_answered_by_one_line_and_130(tmp_path, until, times, line):
    words = ["-m", "jaxfil", *LONG, "--points", "20000", "--out", str(tmp_path / "a.png")]
    code, _, (told,) = interrupted(tmp_path, words, until, times)
    assert code == 130 and re.fullmatch(line, told)
    if "wrote" in told:
        with np.load(tmp_path / "a.npz") as saved:
            finished = saved["results"] == "successful"
            assert told.split()[2] == str(finished.sum()) and 0 < finished.sum() < 20000
            assert np.isfinite(saved["xs"]).all(axis=(1, 2))[finished].all()
        assert matplotlib.image.imread(tmp_path / "a.png").size
    else:
        assert not list(tmp_path.iterdir())


@pytest.mark.release
@pytest.mark.usefixtures("ctrl_c_interrupts")
@pytest.mark.parametrize(
    "command, axes",
    [("plane", "omega f0"), pytest.param("basins", "x0 x1", marks=pytest.mark.release)],
)
def test_ctrl_c_in_a_map_is_answered_as_in_a_diagram(tmp_path, command, axes):
    first, second = axes.split()
    grid = ["--grid", f"{first}=0.6:0.9:200", f"{second}=0.2:0.3:100"]
    words = ["-m", "jaxfil", command, "sd-oscillator", *grid, "--out", str(tmp_path / "a.png")]
    code, _, (told,) = interrupted(tmp_path, words, rb" [1-9]\d*/20000")
    assert code == 130
    assert re.fullmatch(r"jaxfil: interrupted: \d+ of 20000 lanes are finished; wrote .*", told)
    outcomes = jf.RESULTS.names(jf.load(tmp_path / "a.npz").results)
    assert told.split()[2] == str((outcomes != "interrupted").sum())


@pytest.mark.usefixtures("ctrl_c_interrupts")
def test_ctrl_c_while_python_loads_the_package_ends_it_without_a_word(tmp_path):
    words = ["-X", "importtime", "-m", "jaxfil", "--list"]
    code, out, lines = interrupted(tmp_path, words, rb"\| +numpy\n")
    assert code == 130 and out == b""
    assert all(line.startswith("import time:") for line in lines), lines
