"""Every parameter of every function in the package has a type."""

import ast
from pathlib import Path

import pytest

import jaxfil

PACKAGE = Path(jaxfil.__file__).parent


def untyped(tree):
    """The parameters without an annotation, by their functions; `self` and `cls` need none."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            given = node.args
            every = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
            for parameter in every:
                bare = parameter is not None and parameter.annotation is None
                if bare and parameter.arg not in ("self", "cls"):
                    yield f"{node.name}({parameter.arg}), line {node.lineno}"


@pytest.mark.parametrize(
    "file", sorted(PACKAGE.rglob("*.py")), ids=lambda f: "/".join(f.parts[-2:])
)
def test_no_parameter_is_untyped(file):
    assert [*untyped(ast.parse(file.read_text()))] == []


def test_an_untyped_parameter_is_seen():
    source = "def f(self, a: int, *rest, b, **more: int):\n    def g(x): pass\n    lambda y: 0\n"
    assert [*untyped(ast.parse(source))] == ["f(b), line 1", "f(rest), line 1", "g(x), line 2"]
