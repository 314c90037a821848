"""Docstrings of public callables describe the parameters that there are, and no others."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted([*(ROOT / "traitbrdf").rglob("*.py"), *(ROOT / "data_gen").rglob("*.py")])

Callable = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


def section(docstring: str, title: str) -> list[str] | None:
    """The names that a numpydoc section describes; None if there is no such section."""
    lines = docstring.splitlines()
    rules = [i for i, line in enumerate(lines) if re.fullmatch(r"-{3,}", line.strip())]
    for rule in rules:
        if lines[rule - 1].strip() == title:
            end = min((i - 1 for i in rules if i > rule), default=len(lines))
            # prose after a blank line belongs to no entry
            prose = (
                i for i in range(rule + 1, end - 1) if not lines[i] and lines[i + 1][:1].strip()
            )
            end = min(prose, default=end)
            entries = [line for line in lines[rule + 1 : end] if line and not line[0].isspace()]
            return [name.strip() for line in entries for name in line.split(" : ")[0].split(",")]
    return None


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef, method: bool) -> set[str]:
    """The names of a function's parameters, as numpydoc writes them."""
    given = function.args
    named = [arg.arg for arg in (*given.posonlyargs, *given.args)]
    decorators = {ast.unparse(decorator) for decorator in function.decorator_list}
    if method and "staticmethod" not in decorators:
        named = named[1:]
    named += [arg.arg for arg in given.kwonlyargs]
    starred = (("*", given.vararg), ("**", given.kwarg))
    return {*named, *(stars + arg.arg for stars, arg in starred if arg)}


def fields(a_class: ast.ClassDef) -> set[str]:
    """The names that a dataclass or a NamedTuple is made with."""
    return {
        node.target.id
        for node in a_class.body
        if isinstance(node, ast.AnnAssign)
        and isinstance(node.target, ast.Name)
        and "ClassVar" not in ast.unparse(node.annotation)
        and "init=False" not in ast.unparse(node)
    }


def public(tree: ast.Module | ast.ClassDef, prefix: str = "") -> Iterator[tuple[str, Callable]]:
    """Public classes, functions and methods of a module, with their dotted names."""
    for node in tree.body:
        if isinstance(node, Callable) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public(node, f"{prefix}{node.name}.")


def mistakes(source: str) -> list[str]:
    """What is described but not there, and what is there but not described."""
    found = []
    for name, node in public(ast.parse(source)):
        docstring = ast.get_docstring(node) or ""
        described = section(docstring, "Parameters")
        if isinstance(node, ast.ClassDef):
            makers = [one for one in node.body if getattr(one, "name", "") == "__init__"]
            made = [base for base in node.bases if ast.unparse(base) == "NamedTuple"]
            made += [one for one in node.decorator_list if "dataclass" in ast.unparse(one)]
            if makers:
                known = parameters(makers[0], True)
            elif made and (known := fields(node)):
                attributes = section(docstring, "Attributes")
                if described is None and attributes is not None:
                    described = [one for one in attributes if one in known]
            else:
                continue
        else:
            known = parameters(node, "." in name)
        if described is None:
            continue
        others = [one for one in described if one.startswith("Other parameters")]
        named = {one.strip("`\\") for one in described if one not in others}
        found += [f"{name}: {one!r} is no parameter" for one in sorted(named - known)]
        if not others:
            found += [f"{name}: {one!r} is not described" for one in sorted(known - named)]
    return found


def test_mistakes_are_found():
    source = '''
def good(a, b, *args, c=1, **kwargs):
    """Do.

    Parameters
    ----------
    a, b : int
    *args : int
        More: of the same.
    c
    **kwargs : as for `bad`

    Returns
    -------
    int
    """

def rest(a, b):
    """Do.

    Parameters
    ----------
    a : int
    Other parameters as for `good`
    """

class Bad:
    """Do.

    Parameters
    ----------
    a, c : int
    """

    def __init__(self, a, b): ...

    @staticmethod
    def still(a):
        """Do.

        Parameters
        ----------
        a : int
        """

    def method(self, a):
        """Do.

        Parameters
        ----------
        self : Bad
        """

@dataclass(frozen=True)
class Value:
    """A value.

    Attributes
    ----------
    a, total : int
    """

    a: int
    b: int
    kept: int = field(init=False)
'''
    assert mistakes(source) == [
        "Bad: 'c' is no parameter",
        "Bad: 'b' is not described",
        "Bad.method: 'self' is no parameter",
        "Bad.method: 'a' is not described",
        "Value: 'b' is not described",
    ]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_parameters_are_described(path):
    assert mistakes(path.read_text(encoding="utf-8")) == []
