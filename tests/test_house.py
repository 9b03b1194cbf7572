"""The house keeps its measures: sizes of files and functions, imports without circles, one name for one thing."""

import ast
import itertools
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

import levkas

HOUSE = Path(levkas.__file__).parent
FILES = sorted(HOUSE.rglob("*.py"))
MOST_BODY, MOST_PARAMETERS, MOST_DEPTH, MOST_ENTRIES = 60, 8, 5, 19
WIDE: set = set()
PUBLIC = {"levkas.simulation.campaigns.simulate_campaign"}
"""Functions of `levkas.__all__`: programs of others call them, and their parameters may only grow."""
DEEP: set = set()
"""What still breaks a measure: names may leave these lists, none may enter."""
SPEECH = {
    "told", "foretold", "seen", "unseen", "foreseen", "ask", "asked", "asks", "believe",
    "believes", "believed", "learnt", "heard", "borne", "ladder", "climbs", "mate", "mates",
    "rig", "rival", "rivals", "strange", "strangers", "lent", "settled",
}  # fmt: skip
"""Words that are not the field's: data are declared, measured, observed or requested."""
BLOCKS = (ast.For, ast.While, ast.If, ast.With, ast.Try, ast.Match)


def name_of(path):
    parts = path.relative_to(HOUSE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def trees():
    return {name_of(path): ast.parse(path.read_text(encoding="utf-8")) for path in FILES}


def functions():
    for module, tree in trees().items():
        for node in ast.walk(tree):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                yield module, node


def body_lines(node):
    """Lines from the first statement behind the docstring to the end."""
    body = node.body[1:] if ast.get_docstring(node) is not None else node.body
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


def depth(node):
    inner = [
        depth(child) + (isinstance(child, BLOCKS) and not is_elif(node, child))
        for child in ast.iter_child_nodes(node)
        if not isinstance(child, (ast.FunctionDef, ast.ClassDef, ast.Lambda))
    ]
    return max(inner, default=0)


def is_elif(parent, child):
    return isinstance(parent, ast.If) and isinstance(child, ast.If) and parent.orelse == [child]


def is_command(node):
    """A command's parameters are what its user may give; typer reads them off the function."""
    return any("refusing" in ast.unparse(decorator) for decorator in node.decorator_list)


def imports_of(module):
    for node in ast.walk(trees()[module]):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in trees() else node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def test_no_function_is_longer_than_a_page():
    long = [f"{m}.{f.name}: {n}" for m, f in functions() if (n := body_lines(f)) > MOST_BODY]
    assert long == []


def test_no_function_is_nested_beyond_following():
    deep = {f"{m}.{f.name}" for m, f in functions() if depth(f) > MOST_DEPTH}
    assert deep == DEEP


def test_no_function_takes_more_than_can_be_kept_in_mind():
    wide = set()
    for module, node in functions():
        named = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        count = len([a for a in named if a.arg not in ("self", "cls")])
        if count > MOST_PARAMETERS and not is_command(node):
            wide.add(f"{module}.{node.name}")
    assert wide - PUBLIC == WIDE


def test_imports_close_no_circle():
    graph = {m: {t for t in imports_of(m) if t in trees() and t != m} for m in trees()}
    assert list(circles(graph)) == []


def circles(graph):
    """Strongly connected components of more than one module (Tarjan 1972, 10.1137/0201010)."""
    order, low, stack, count = {}, {}, [], itertools.count()

    def visit(module):
        order[module] = low[module] = next(count)
        stack.append(module)
        for other in sorted(graph[module]):
            if other not in order:
                yield from visit(other)
                low[module] = min(low[module], low[other])
            elif other in stack:
                low[module] = min(low[module], order[other])
        if low[module] == order[module]:
            at = stack.index(module)
            found, stack[at:] = stack[at:], []
            if len(found) > 1:
                yield sorted(found)

    for module in sorted(graph):
        if module not in order:
            yield from visit(module)


def test_a_class_name_means_one_thing():
    homes = defaultdict(list)
    for module, tree in trees().items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(module)
    assert {name: found for name, found in homes.items() if len(found) > 1} == {}


def test_the_top_level_is_seen_at_a_glance():
    entries = {path.relative_to(HOUSE).parts[0] for path in FILES}
    assert len(entries) <= MOST_ENTRIES, sorted(entries)


def names_of(tree):
    """Every identifier of a module, and every string that could be the key of a record."""
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name):
                yield name
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.keyword(arg=str(name)):
                yield name
            case ast.alias(asname=str(name)):
                yield name
            case ast.Constant(value=str(name)) if re.fullmatch(r"[a-z]+(_[a-z]+)*", name):
                yield name


def words_of(name):
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}


def test_names_and_record_keys_are_the_fields_words():
    spoken = {
        f"{module}: {name}"
        for module, tree in trees().items()
        for name in names_of(tree)
        if words_of(name) & SPEECH
    }
    assert sorted(spoken) == []
