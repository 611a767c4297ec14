"""Everything public is explained, in one form: functions, classes, fields, members.

What is public is found, not listed: functions and classes that `import jaxfil as jf`, `jf.plot` and
`jf.systems` offer, and the modules that are fields of a public result. Each function below answers
with what is missing, so that a failure is the list of what is still to be written.
"""

import ast
import dataclasses
import enum
import inspect
import re
import sys
import textwrap
import typing
from types import ModuleType, UnionType

import pytest

import jaxfil as jf
from jaxfil.bifurcations import locate

# What needs no **Source**: nothing was taken from anywhere.
NO_SOURCE = {
    "jaxfil.load": "reads a file",
}

HEADING = re.compile(r"^\*\*(\w[\w ]*)\*\*", re.M)


def offered(module: ModuleType) -> dict[str, object]:
    """What a module offers that jaxfil defines, by the name that a user writes."""
    names = {name: getattr(module, name) for name in module.__all__ if not name.startswith("_")}
    own = {n: v for n, v in names.items() if getattr(v, "__module__", "").startswith("jaxfil.")}
    return {f"{module.__name__}.{name}": value for name, value in own.items()}


FUNCTIONS = {
    name: value
    for module in (jf, jf.plot)
    for name, value in offered(module).items()
    if inspect.isfunction(value)
}
SYSTEMS = {f"jaxfil.systems.{cls.__name__}": cls for cls, _ in jf.systems.TEXTBOOK.values()}
CLASSES = {name: value for name, value in offered(jf).items() if isinstance(value, type)}


def annotated(cls: type) -> set[type]:
    """The classes that the annotations of a dataclass speak of."""
    if not dataclasses.is_dataclass(cls):
        return set()
    known = {**vars(sys.modules[cls.__module__])}
    hints = inspect.get_annotations(cls)
    found, left = set(), [hint for field, hint in hints.items() if not field.startswith("_")]
    while left:
        hint = left.pop()
        hint = known.get(hint, hint) if isinstance(hint, str) else hint
        if isinstance(hint, type) and hint.__module__.startswith("jaxfil."):
            found.add(hint)
        left += typing.get_args(hint)
    return found


def reached(classes: set[type]) -> set[type]:
    """Those classes, and what their fields hold, and so on."""
    found, left = set(), {*classes}
    while left:
        found |= left
        left = set().union(*map(annotated, left)) - found
    return found


def sections(text: str) -> dict[str, str]:
    """What stands under each bold heading; the examples under none."""
    text = text.partition(">>>")[0]
    starts = [*HEADING.finditer(text)]
    ends = [*(m.start() for m in starts[1:]), len(text)][: len(starts)]
    return {m[1]: text[m.end() : end] for m, end in zip(starts, ends, strict=True)}


def first_sentence(text: str) -> bool:
    """Whether a docstring opens with a sentence."""
    return bool(re.match(r"[^\s].*?\.(\s|$)", text.partition("\n\n")[0], re.S))


def described(arguments: str) -> set[str]:
    """The names at the head of bullets."""
    heads = re.findall(r"^- ((?:`\w+`(?:, | and )?)+)", arguments, re.M)
    return {name for head in heads for name in re.findall(r"`(\w+)`", head)}


def has_outcome(function: object) -> bool:
    """Whether what a function returns has a field `result` or `results`."""
    returned = typing.get_type_hints(function, include_extras=True).get("return")
    kinds = typing.get_args(returned) if isinstance(returned, UnionType) else (returned,)
    return any(
        {"result", "results"} & {field.name for field in dataclasses.fields(kind)}
        for kind in kinds
        if dataclasses.is_dataclass(kind)
    )


def missing_in_function(name: str, function: typing.Callable) -> list[str]:
    """What the docstring of a function lacks."""
    text = inspect.getdoc(function) or ""
    told, parameters = sections(text), {*inspect.signature(function).parameters}
    wanted = {"Returns"} | ({"Arguments"} if parameters else set())
    if has_outcome(function):
        wanted.add("Outcomes")
    if not name.startswith("jaxfil.plot.") and name not in NO_SOURCE:
        wanted.add("Source")
    lacks = [f"**{heading}**" for heading in sorted(wanted - {*told})]
    if not first_sentence(text):
        lacks.append("a first sentence")
    if ">>>" not in text:
        lacks.append("an example")
    named = described(told.get("Arguments", ""))
    lacks += [f"the argument `{p}`" for p in sorted(parameters - named)]
    lacks += [f"no word of `{p}`, which is no argument" for p in sorted(named - parameters)]
    if "Outcomes" in wanted & {*told}:
        outcomes = {*re.findall(r"`(\w+)`", told["Outcomes"].partition(":")[2])}
        lacks += [f"no word of {o}, which is no outcome" for o in outcomes - {*members(jf.RESULTS)}]
        lacks += [] if outcomes else ["an outcome by its name"]
    return [f"{name} lacks {what}" for what in lacks]


def missing_in_system(name: str, cls: type) -> list[str]:
    """What the docstring of a textbook system lacks."""
    text = inspect.getdoc(cls) or ""
    lacks = [] if first_sentence(text) else ["a first sentence"]
    lacks += [] if "**Source**" in text else ["**Source**"]
    lacks += [] if ">>>" in text else ["an example"]
    return [f"{name} lacks {what}" for what in lacks]


def tree_of(cls: type) -> ast.ClassDef:
    """The syntax of a class."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(tree, ast.ClassDef)
    return tree


def explained(tree: ast.ClassDef | ast.Module) -> set[str]:
    """The names that are set or declared there with a string literal just below."""
    found = set()
    for node, below in zip(tree.body, tree.body[1:], strict=False):
        word = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        if word and isinstance(below.value.value, str):
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", 0)]
            found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return found


def fields(tree: ast.ClassDef) -> list[str]:
    """The fields that a dataclass declares; class variables and private ones are none."""
    return [
        node.target.id
        for node in tree.body
        if isinstance(node, ast.AnnAssign)
        and isinstance(node.target, ast.Name)
        and not node.target.id.startswith("_")
        and "ClassVar" not in ast.unparse(node.annotation)
    ]


def members(kind: type) -> list[str]:
    """The names of an enumeration's members."""
    if issubclass(kind, enum.Enum):
        return [*kind.__members__]
    return [*kind._name_to_item]


def missing_in_class(tree: ast.ClassDef) -> list[str]:
    """A class without a docstring, and its fields without one."""
    missing = [] if ast.get_docstring(tree) else [f"{tree.name} lacks a docstring"]
    told = explained(tree)
    return missing + [f"{tree.name}.{f} is not explained" for f in fields(tree) if f not in told]


def public_classes() -> list[type]:
    """Those that jaxfil offers, those that their fields hold, and the textbook systems."""
    found = reached({*CLASSES.values(), *SYSTEMS.values()})
    return sorted(found, key=lambda cls: (cls.__module__, cls.__qualname__))


def test_what_is_public_is_found():
    assert {"jaxfil.solve", "jaxfil.find_bifurcations", "jaxfil.plot.page"} <= {*FUNCTIONS}
    assert {"jaxfil.System", "jaxfil.Solution", "jaxfil.RESULTS"} <= {*CLASSES}
    assert len(SYSTEMS) == len(jf.systems.TEXTBOOK)
    assert {"Conditions", "Labels"} <= {cls.__name__ for cls in public_classes()}
    assert {*NO_SOURCE} <= {*FUNCTIONS}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_is_documented_in_the_one_form(name):
    assert missing_in_function(name, FUNCTIONS[name]) == []


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_textbook_system_is_documented_in_the_one_form(name):
    assert missing_in_system(name, SYSTEMS[name]) == []


@pytest.mark.parametrize("cls", public_classes(), ids=lambda cls: cls.__name__)
def test_a_class_and_each_of_its_fields_is_explained(cls):
    assert missing_in_class(tree_of(cls)) == []


def test_every_kind_of_event_is_explained():
    assert {*members(jf.EventKind)} == explained(tree_of(jf.EventKind))


def test_every_outcome_has_a_sentence_and_a_place_in_the_overview():
    silent = [name for name in members(jf.RESULTS) if not jf.RESULTS[getattr(jf.RESULTS, name)]]
    assert silent == ["successful"], "there is nothing to say of what went well"
    overview = inspect.getdoc(jf.RESULTS)
    assert [name for name in members(jf.RESULTS) if f"`{name}`" not in overview] == []


def test_every_kind_of_bifurcation_is_explained():
    tree = ast.parse(inspect.getsource(locate))
    assert "BIFURCATION_KINDS" in explained(tree)
    at = next(
        i
        for i, node in enumerate(tree.body)
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "BIFURCATION_KINDS"
    )
    text = tree.body[at + 1].value.value
    assert [kind for kind in jf.BIFURCATION_KINDS if kind not in text] == []


PLANTED = '''
class Found(eqx.Module):
    """What was found."""

    value: Array
    """Where."""
    count: int = eqx.field(static=True)
    """How many."""
    _private: Array
    plot: ClassVar = None
'''


def test_a_field_without_a_word_is_seen():
    assert missing_in_class(ast.parse(PLANTED).body[0]) == []
    for word, field in (('    """Where."""\n', "value"), ('    """How many."""\n', "count")):
        (tree,) = ast.parse(PLANTED.replace(word, "")).body
        assert missing_in_class(tree) == [f"Found.{field} is not explained"]


def verb(x0: float, dt: float) -> jf.Solution:
    """Integrate something.

    **Arguments**

    - `x0`, `dt`: the initial state and the step.

    **Returns** a `Solution`.

    **Outcomes**: `successful`, `zeno`.

    **Source**: nobody.

    >>> 1
    1
    """


@pytest.mark.parametrize(
    "word, other, told",
    [
        ("Integrate something.", "Integrate something", "a first sentence"),
        ("- `x0`, `dt`", "- `x0`", "the argument `dt`"),
        ("- `x0`", "- `y`, `x0`", "no word of `y`, which is no argument"),
        ("**Returns**", "Returns", "**Returns**"),
        ("**Source**", "Source", "**Source**"),
        ("`zeno`", "`zenon`", "no word of zenon, which is no outcome"),
        (">>> 1\n    1", "", "an example"),
    ],
)
def test_a_gap_in_a_docstring_is_seen(word, other, told, monkeypatch):
    assert missing_in_function("jaxfil.verb", verb) == []
    monkeypatch.setattr(verb, "__doc__", verb.__doc__.replace(word, other))
    assert missing_in_function("jaxfil.verb", verb) == [f"jaxfil.verb lacks {told}"]
