"""Mutants of a module's source: each differs from it in one operator, constant, result or statement.

The operators are those of classical mutation testing (DeMillo, Lipton, Sayward 1978, Computer 11(4), 34): of
comparisons, of arithmetic, of logic, constants, results, and statements left out. Docstrings, annotations and
the texts of errors are left as they are.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from dataclasses import dataclass

COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
"""Each comparison with its neighbour at the bound, and its opposite."""

ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.MatMult: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitAnd,
}


@dataclass(frozen=True)
class Mutant:
    """A changed module: the line that it differs on, what was done to it, and its tree."""

    line: int
    change: str
    tree: ast.Module


def mutants(source: str) -> Iterator[Mutant]:
    """Yield every mutant of a source."""
    tree = ast.parse(source)
    for number, (node, _) in enumerate(_places(tree)):
        for n in range(len(list(_changes(node)))):
            changed = copy.deepcopy(tree)
            place, parent = list(_places(changed))[number]
            change, mutated = list(_changes(place))[n]
            if mutated is not place:
                _put(parent, place, mutated)
            yield Mutant(node.lineno, change, ast.fix_missing_locations(changed))


def _places(tree: ast.Module) -> Iterator[tuple[ast.expr | ast.stmt, ast.AST]]:
    """Yield each expression and statement that may be changed, with what it stands in, in order."""
    waiting: list[tuple[ast.AST, ast.AST]] = [(tree, tree)]
    while waiting:
        node, parent = waiting.pop()
        if isinstance(node, ast.expr | ast.stmt):
            yield node, parent
        waiting += [(child, node) for child in reversed(list(_mutable_children(node)))]


def _mutable_children(node: ast.AST) -> Iterator[ast.AST]:
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "bases", "keywords") and not isinstance(
            node, ast.Call
        ):
            continue
        if isinstance(node, ast.Raise) or (isinstance(node, ast.Assert) and name == "msg"):
            continue
        for child in value if isinstance(value, list) else [value]:
            is_text = isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)
            if isinstance(child, ast.AST) and not is_text and not isinstance(child, ast.JoinedStr):
                yield child


def _put(parent: ast.AST, old: ast.AST, new: ast.AST) -> None:
    for name, value in ast.iter_fields(parent):
        if value is old:
            setattr(parent, name, new)
        elif isinstance(value, list) and any(child is old for child in value):
            setattr(parent, name, [new if child is old else child for child in value])


def _changes(node: ast.expr | ast.stmt) -> Iterator[tuple[str, ast.AST]]:
    """Yield what may be done to a node: in words, and the node that then stands there.

    A node of a fresh copy may be changed in place.
    """
    match node:
        case ast.Compare():
            yield from _of_comparison(node)
        case ast.BinOp() if type(node.op) in ARITHMETIC:
            other = ARITHMETIC[type(node.op)]
            yield (
                f"{type(node.op).__name__} to {other.__name__}",
                ast.BinOp(node.left, other(), node.right),
            )
        case ast.BoolOp():
            is_and = isinstance(node.op, ast.And)
            other_logic = ast.Or() if is_and else ast.And()
            yield "and to or" if is_and else "or to and", ast.BoolOp(other_logic, node.values)
        case ast.UnaryOp(op=ast.Not()):
            yield "not left out", node.operand
        case ast.UnaryOp(op=ast.USub()):
            yield "minus left out", node.operand
        case ast.IfExp():
            yield "branches exchanged", ast.IfExp(node.test, node.orelse, node.body)
        case ast.Constant():
            yield from _of_constant(node.value)
        case ast.Return() if not _is_none(node.value):
            yield "None returned", ast.Return(ast.Constant(None))
        case ast.Assign(value=ast.Call(func=ast.Name(id="TypeVar"))):
            # Annotations alone know it.
            return
        case ast.Assign() | ast.AugAssign() | ast.Expr() | ast.Raise() | ast.Continue() | ast.Break():
            yield f"{type(node).__name__} left out", ast.Pass()


def _of_comparison(node: ast.Compare) -> Iterator[tuple[str, ast.AST]]:
    for n, op in enumerate(node.ops):
        for other in COMPARISONS[type(op)]:
            ops = [*node.ops[:n], other(), *node.ops[n + 1 :]]
            yield (
                f"{type(op).__name__} to {other.__name__}",
                ast.Compare(node.left, ops, node.comparators),
            )


def _of_constant(value: object) -> Iterator[tuple[str, ast.AST]]:
    if isinstance(value, bool):
        yield f"{value} to {not value}", ast.Constant(not value)
    elif isinstance(value, int | float):
        for other in (value + 1, value - 1):
            yield f"{value} to {other}", ast.Constant(other)


def _is_none(value: ast.expr | None) -> bool:
    return value is None or (isinstance(value, ast.Constant) and value.value is None)
