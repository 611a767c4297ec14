"""Operations in a compiled program.

The text of an optimised XLA program enters; how many arithmetic operations one turn of its loops
does for each lane leaves, and the functions that its instructions were written in.

Counted are additions, multiplications, divisions, roots, roundings, comparisons, selections and
logic, an element each, in the body and the condition of every loop: inside fusions as often as they
stand there (XLA repeats work in its fusions), of a conditional the dearest branch, of a loop inside
a loop one turn. Not counted is what only moves numbers: copies, slices, broadcasts, constants.
"""

import dataclasses
import functools
import math
import re

ARITHMETIC = frozenset(
    re.findall(
        r"\S+",
        """abs add and atan2 cbrt ceil clamp compare convert cosine divide erf exponential
        exponential-minus-one floor is-finite log log-plus-one logistic maximum minimum multiply
        negate not or popcnt power remainder round-nearest-afz round-nearest-even rsqrt select
        shift-left shift-right-arithmetic shift-right-logical sign sine sqrt subtract tan tanh
        xor""",
    )
)
_HEAD = re.compile(r"^(?:ENTRY )?%(\S+) \(.*\{$")
_LINE = re.compile(r"^ +(?:ROOT )?%(\S+) = (\(.*?\)|\S+) ([a-z-]+)\((.*)$")
_CALLED = re.compile(r"(?:calls|to_apply|body|condition)=%([\w.-]+)")
_BRANCHES = re.compile(r"(?:branch_computations=\{([^}]*)\}|(?:true|false)_computation=%([\w.-]+))")


@dataclasses.dataclass(frozen=True)
class Instruction:
    """One line: its name, the elements of its result, what it does, and the rest of the line."""

    name: str
    elements: int
    operation: str
    rest: str

    @property
    def called(self):
        """Computations it runs, each once."""
        return _CALLED.findall(self.rest)

    @property
    def branches(self):
        """Computations of which it runs one."""
        found = [a or b for a, b in _BRANCHES.findall(self.rest)]
        return [name.strip().lstrip("%") for names in found for name in names.split(",")]


def _elements(shape):
    """Elements of an array's shape, such as f64[64,2]{1,0}; 0 of a tuple's."""
    found = re.match(r"[a-z0-9]+\[([0-9,]*)\]", shape)
    return math.prod(map(int, filter(None, found[1].split(",")))) if found else 0


def parse(text):
    """{computation: its instructions}."""
    computations, lines = {}, []
    for line in text.splitlines():
        if head := _HEAD.match(line):
            lines = computations[head[1]] = []
        elif found := _LINE.match(line):
            lines.append(Instruction(found[1], _elements(found[2]), *found.groups()[2:]))
    return computations


def counter(text, operations=ARITHMETIC):
    """A function of a computation's name: the elements that `operations` give in it."""
    computations = parse(text)

    @functools.cache
    def count(name):
        total, sizes = 0, {}
        for line in computations[name]:
            sizes[line.name] = line.elements
            if line.operation in operations:
                total += line.elements
            elif line.operation in ("reduce", "reduce-window"):
                operand = re.match(r"%([\w.-]+)", line.rest)
                size = max(line.elements, sizes.get(operand[1], 0) if operand else 0)
                total += size * max((count(c) for c in line.called), default=0)
            elif line.branches:
                total += max(map(count, line.branches))
            else:
                total += sum(map(count, line.called))
        return total

    return count


def loops(text):
    """(condition, body) of the outermost loops: those inside no other's body."""
    computations = parse(text)
    inside = {
        name: [c for line in lines for c in (*line.called, *line.branches)]
        for name, lines in computations.items()
    }

    def below(name):
        return {name}.union(*(below(c) for c in inside[name]))

    found = {
        tuple(re.search(rf"{key}=%([\w.-]+)", line.rest)[1] for key in ("condition", "body"))
        for lines in computations.values()
        for line in lines
        if line.operation == "while"
    }
    inner = set().union(*(below(body) - {body} for _, body in found)) if found else set()
    return sorted(pair for pair in found if pair[1] not in inner)


def per_turn(text, lanes, operations=ARITHMETIC):
    """Operations per lane of one turn of each outermost loop, inner loops turning once."""
    count = counter(text, operations)
    return sum(count(name) for pair in loops(text) for name in pair) / lanes


def sources(text):
    """The functions that the instructions of a program come from, as file.function, callers
    included."""
    tables, rows = {}, {}
    for line in text.splitlines():
        if line in ("FileNames", "FunctionNames", "FileLocations", "StackFrames"):
            rows = tables[line] = {}
        elif found := re.match(r"(\d+) (.*)", line):
            rows[found[1]] = found[2]
        elif line.startswith(("%", "ENTRY")):
            break

    def field(row, name):
        return re.search(rf"{name}=(\d+)", row)[1]

    # A frame's callers stand before it. XLA counts them from 0 or, as frames themselves, from 1,
    # where the outermost frame of all seems to be its own.
    stack = tables["StackFrames"].items()
    shift = any(f"parent_frame_id={number}}}" in row for number, row in stack)

    names, done, frames = set(), set(), set(re.findall(r"stack_frame_id=(\d+)", text))
    while frames - done:
        frame = (frames - done).pop()
        done.add(frame)
        row = tables["StackFrames"][frame]
        location = tables["FileLocations"][field(row, "file_location_id")]
        file = tables["FileNames"][field(location, "file_name_id")].strip('"')
        function = tables["FunctionNames"][field(location, "function_name_id")].strip('"')
        names.add(f"{file.rpartition('/')[2].removesuffix('.py')}.{function.partition('.<')[0]}")
        parent = re.search(r"parent_frame_id=(\d+)", row)
        if parent and int(parent[1]) > shift:
            frames.add(str(int(parent[1]) - shift))
    return names
