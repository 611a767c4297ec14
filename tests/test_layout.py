"""The house is in order: what imports what, how long files are, and what the papers promise."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import jaxfil as jf

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "jaxfil"

# A file imports only from files above it.
ORDER = [
    "version",
    "results",
    "fasttrig",
    "system",
    "systems",
    "check",
    "linear",
    "kernel",
    "entry",
    "trace",
    "scene",
    "parameter",
    "labels",
    "filippov",
    "rosenbrock",
    "stepper",
    "lane",
    "record",
    "contact",
    "switch",
    "start",
    "glide",
    "flow",
    "block",
    "solution",
    "initial_value",
    "analysis",
    "points",
    "store",
    "diagram",
    "companion",
    "checkpoint",
    "processes",
    "chunk",
    "sweep",
    "basins",
    "plot",
    "__main__",
]


def modules():
    """Every file of the package with its name in ORDER; the package's own __init__ is left out."""
    files = [f for f in PACKAGE.rglob("*.py") if f != PACKAGE / "__init__.py"]
    return {f: f.relative_to(PACKAGE).with_suffix("").parts[0] for f in files}


def imported(tree, inside_functions):
    """Dotted names that a syntax tree imports, at its top level or inside functions."""
    functions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
    inner = {n for f in ast.walk(tree) if isinstance(f, functions) for n in ast.walk(f)}
    for node in ast.walk(tree):
        if (node in inner) == inside_functions:
            if isinstance(node, ast.Import):
                yield from (name.name for name in node.names)
            elif isinstance(node, ast.ImportFrom):
                prefix = "." * node.level + (node.module or "")
                yield from (f"{prefix}.{name.name}" for name in node.names)


def own(tree, inside_functions):
    """Names in ORDER that a syntax tree imports."""
    for name in imported(tree, inside_functions):
        assert not name.startswith("."), f"{name} is a relative import"
        if name.split(".")[0] == "jaxfil":
            yield name.split(".")[1]


def third_party(tree):
    """Distributions that a syntax tree imports, by the name of their top module."""
    for inside in (False, True):
        for name in imported(tree, inside):
            top = name.split(".")[0]
            if top and top not in sys.stdlib_module_names | {"jaxfil", "tests", "benchmarks"}:
                yield top


def readme_blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / "README.md").read_text(), re.M | re.S)


def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def declared(requirements):
    return {re.match(r"[\w-]+", r).group() for r in requirements}


def test_every_file_has_its_place_in_the_order():
    assert set(modules().values()) <= set(ORDER)


@pytest.mark.parametrize("file", modules(), ids=lambda f: f.stem)
def test_a_file_imports_only_from_files_above_it(file):
    place = ORDER.index(modules()[file])
    above = set(ORDER[: place + 1]) if file.parent != PACKAGE else set(ORDER[:place])
    tree = ast.parse(file.read_text())
    assert set(own(tree, False)) <= above
    assert set(own(tree, True)) <= above | {"plot"}, "only plot is imported late"


@pytest.mark.parametrize("file", modules(), ids=lambda f: f.stem)
def test_a_file_can_be_read_at_one_sitting(file):
    assert len(file.read_text().splitlines()) <= 400


def test_importing_jaxfil_never_imports_matplotlib():
    code = "import sys, jaxfil; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    code = "import sys, jaxfil; jaxfil.plot.page(); sys.exit('matplotlib' not in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_declared_dependencies_are_those_imported_by_the_package_and_the_scripts_in_readme():
    sources = [f.read_text() for f in PACKAGE.rglob("*.py")] + readme_blocks("python")
    used = {name for source in sources for name in third_party(ast.parse(source))}
    optional = declared(project()["optional-dependencies"]["xarray"])
    assert declared(project()["dependencies"]) == used - optional


@pytest.mark.parametrize("extra, folder", [("test", "tests"), ("benchmarks", "benchmarks")])
def test_an_extra_declares_what_its_folder_imports(extra, folder):
    trees = [ast.parse(f.read_text()) for f in (ROOT / folder).rglob("*.py")]
    used = {name for tree in trees for name in third_party(tree)}
    assert used <= declared(project()["dependencies"] + project()["optional-dependencies"][extra])


def test_the_package_knows_its_version():
    assert jf.__version__ == project()["version"]


def test_ci_runs_the_test_command_in_readme():
    (command,) = [c for c in readme_blocks("bash") if "pytest" in c]
    pattern = re.search(r"grep -m 1 '(.*)' README.md", (ROOT / ".ci/run").read_text()).group(1)
    found = [
        line for line in (ROOT / "README.md").read_text().splitlines() if re.search(pattern, line)
    ]
    assert found[0] == command.strip()


@pytest.mark.parametrize("script", readme_blocks("python"), ids=lambda s: s.splitlines()[0])
def test_a_script_in_readme_runs(script, tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("link", re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text()))
def test_a_link_in_readme_leads_somewhere(link):
    assert link.startswith("https://") or (ROOT / link).exists()
