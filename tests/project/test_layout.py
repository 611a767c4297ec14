"""The house is in order: what imports what, how long files are, what is declared."""

import ast
import pydoc
import re
import subprocess
import sys
import tomllib

import pytest

import jaxfil as jf
from tests import ROOT
from tests.project.readme import blocks

PACKAGE = ROOT / "jaxfil"

# A room imports from the rooms named, and from those that these import: arrows point one way.
ROOMS = {
    "version": set(),
    "xla": set(),
    "model": {"xla", "version"},
    "systems": {"model"},
    "integrate": {"model"},
    "studies": {"integrate"},
    "sweep": {"integrate"},
    "orbits": {"integrate"},
    "equilibria": {"orbits"},
    "exponents": {"integrate"},
    "bifurcations": {"orbits"},
    "plot": {"sweep", "studies", "bifurcations", "equilibria", "exponents"},
    "files": {"sweep", "orbits"},
    "command": {"plot", "systems", "files"},
    "__main__": {"command"},
    "__init__": {"__main__"},
}

# The folders of a room, from the lowest on: each imports from those before it.
FOLDERS = {
    "integrate": ("system", "steppers", "surfaces", "lane", "contacts", "loop", "run"),
}


def below(room):
    """The rooms that a room may import from."""
    return set().union(*({near} | below(near) for near in ROOMS[room]))


def modules():
    """The dotted name of every file of the package, with its tree of syntax."""
    files = {f: f.relative_to(ROOT).with_suffix("").parts for f in PACKAGE.rglob("*.py")}
    return {
        ".".join(parts[:-1] if parts[-1] == "__init__" else parts): ast.parse(f.read_text())
        for f, parts in files.items()
    }


def room(module):
    return [*module.split("."), "__init__"][1]


def imported(tree):
    """Dotted names that a syntax tree imports anywhere, inside of functions too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{'.' * node.level}{node.module}.{name.name}" for name in node.names)


def arrows(trees):
    """The files that each file imports."""
    own = {}
    for module, tree in trees.items():
        names = {n for n in imported(tree) if n.split(".")[0] in ("jaxfil", "")}
        assert not any(n.startswith(".") for n in names), f"{module} has a relative import"
        files = {n if n in trees else n.rpartition(".")[0] for n in names}
        assert files <= {*trees}, f"{module} imports {files - {*trees}}"
        own[module] = files - {module}
    return own


def upward(arrows):
    """Imports from a room that is not below."""
    return {
        (file, other)
        for file, others in arrows.items()
        for other in others
        if room(other) not in below(room(file)) | {room(file)}
    }


def level(module):
    """The number of the folder of its room that a file is in; None in a room without any."""
    _, room, folder, *_ = [*module.split("."), "", ""]
    return FOLDERS[room].index(folder) if folder and room in FOLDERS else None


def upward_inside(arrows):
    """Imports from a folder of the same room that is not before."""
    return {
        (file, other)
        for file, others in arrows.items()
        for other in others
        if room(file) == room(other) and level(file) is not None and level(other) is not None
        if level(other) > level(file)
    }


def circle(arrows):
    """Files that import each other in a circle; none if there is no circle."""
    left = {file: {*others} for file, others in arrows.items()}
    while free := {file for file, others in left.items() if not others & {*left}}:
        for file in free:
            del left[file]
    return {*left}


# Distributions that are not called as their module is.
DISTRIBUTIONS = {"PIL": "pillow", "mpl_toolkits": "matplotlib"}


def third_party(tree):
    """Distributions that a syntax tree imports, by the name of their top module."""
    for name in imported(tree):
        top = name.split(".")[0]
        top = DISTRIBUTIONS.get(top, top)
        if top and top not in sys.stdlib_module_names | {"jaxfil", "tests", "benchmarks"}:
            yield top


def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def declared(requirements):
    return {re.match(r"[\w-]+", r).group() for r in requirements}


def test_every_file_is_in_a_room():
    assert {room(module) for module in modules()} <= {*ROOMS}


def test_arrows_between_rooms_point_one_way():
    assert upward(arrows(modules())) == set()


def test_arrows_between_folders_of_a_room_point_one_way():
    assert upward_inside(arrows(modules())) == set()


def test_no_files_import_each_other_in_a_circle():
    assert circle(arrows(modules())) == set()


@pytest.mark.slow
@pytest.mark.parametrize(
    "line, where, other",
    [
        ("from jaxfil.plot.canvas import page", "jaxfil.model.check", "jaxfil.plot.canvas"),
        ("from jaxfil.sweep import sweep", "jaxfil.orbits.orbit", "jaxfil.sweep.sweep"),
        ("import jaxfil.orbits.branch", "jaxfil.orbits.orbit", "jaxfil.orbits.branch"),
        ("from jaxfil import systems", "jaxfil.model.system", "jaxfil.systems"),
        (
            "from jaxfil.integrate.run.solve import solve",
            "jaxfil.integrate.lane.state",
            "jaxfil.integrate.run.solve",
        ),
    ],
)
@pytest.mark.parametrize("late", [False, True])
def test_a_planted_import_is_seen(line, where, other, late):
    trees = modules()
    planted = f"def late():\n    {line}\n" if late else f"{line}\n"
    trees[where].body += ast.parse(planted).body
    found = arrows(trees)
    assert other in found[where]
    if (where, other) in upward_inside(found):
        assert level(where) < level(other)
    elif room(where) == room(other):
        assert {where, other} <= circle(found)
    else:
        assert (where, other) in upward(found)


@pytest.mark.parametrize(
    "file", sorted(PACKAGE.rglob("*.py")), ids=lambda f: "/".join(f.parts[-2:])
)
def test_a_file_can_be_read_at_one_sitting(file):
    assert len(file.read_text().splitlines()) <= 400


@pytest.mark.slow
@pytest.mark.parametrize(
    "code, loaded",
    [
        ("import jaxfil, jaxfil.__main__; dir(jaxfil)", []),
        ("import jaxfil; jaxfil.RESULTS", ["jax"]),
        ("from jaxfil import *; solve, systems.SDOscillator, __version__", ["jax", "matplotlib"]),
        ("import jaxfil; jaxfil.solve, jaxfil.find_bifurcations, jaxfil.systems", ["jax"]),
        ("import jaxfil; jaxfil.plot.page()", ["jax", "matplotlib"]),
    ],
)
def test_a_name_is_imported_with_what_it_takes_when_it_is_first_used(code, loaded):
    code += "; import sys; print([name for name in ('jax', 'matplotlib') if name in sys.modules])"
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == f"{loaded}\n", done.stderr


def test_what_is_listed_of_jaxfil_is_what_is_public():
    (_, *imports) = ast.parse((PACKAGE / "__init__.pyi").read_text()).body
    names = {alias.asname for node in imports for alias in node.names}
    assert {*dir(jf)} == {*jf.__all__} == names
    assert {"solve", "plot", "systems", "__version__"} < names
    assert all(hasattr(jf, name) for name in names)
    with pytest.raises(AttributeError, match="module 'jaxfil' has no attribute 'solvee'"):
        _ = jf.solvee


def test_help_lists_pictures_and_outcomes():
    pictures = pydoc.render_doc(jf.plot, renderer=pydoc.plaintext)
    assert [name for name in jf.plot.__all__ if f"    {name}" not in pictures] == []
    offered = {n for n, v in vars(jf.plot).items() if callable(v) and not n.startswith("_")}
    assert offered <= {*jf.plot.__all__}
    outcomes = pydoc.render_doc(jf.RESULTS, renderer=pydoc.plaintext)
    assert "zeno = " in outcomes and "zeno" in dir(jf.RESULTS)
    assert {*jf.RESULTS._name_to_item} < {*dir(jf.RESULTS)}


def test_declared_dependencies_are_those_imported_by_the_package_and_the_scripts_in_readme():
    sources = [f.read_text() for f in PACKAGE.rglob("*.py")] + blocks("python")
    used = {name for source in sources for name in third_party(ast.parse(source))}
    optional = declared(project()["optional-dependencies"]["xarray"])
    assert declared(project()["dependencies"]) == used - optional


@pytest.mark.parametrize("extra, folder", [("test", "tests"), ("benchmarks", "benchmarks")])
def test_an_extra_declares_what_its_folder_imports(extra, folder):
    trees = [ast.parse(f.read_text()) for f in (ROOT / folder).rglob("*.py")]
    used = {name for tree in trees for name in third_party(tree)}
    assert used <= declared(project()["dependencies"] + project()["optional-dependencies"][extra])


def test_only_tests_of_the_benchmarks_need_them():
    """The sources of a release come with the tests and without the benchmarks."""
    sources = {f.relative_to(ROOT / "tests"): f.read_text() for f in (ROOT / "tests").rglob("*.py")}
    needy = {
        str(file): source
        for file, source in sources.items()
        if any(name.startswith("benchmarks.") for name in imported(ast.parse(source)))
    }
    about = ("gallery", "paper", "programs", "readme_numbers", "reliability")
    assert {*needy} == {f"project/test_{name}.py" for name in about}
    assert all('pytest.importorskip("benchmarks"' in source for source in needy.values())


def test_the_package_knows_its_version():
    assert jf.__version__ == project()["version"]
