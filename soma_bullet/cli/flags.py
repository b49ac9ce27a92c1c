"""Options on the command line: tyro reads the dataclasses as they stand, under the names that they give."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from soma_bullet.option import Options, Words, flags, options_in

Kind = TypeVar("Kind", bound=Options)


def parse(kind: type[Kind], arguments: Sequence[str] | None, prog: str) -> Kind:
    """The options that a command was given; ends the process with status 2 where they cannot be read, and
    with 0 after `--help`.

    Args:
        arguments: those of the process if None.
        prog: name of the command.
    """
    return tyro.cli(kind, args=arguments, prog=prog, registry=registry(kind))


def registry(command: type[Options]) -> ConstructorRegistry:
    """How tyro reads the options of a command."""
    offered = set(_steps(command))
    rules = ConstructorRegistry()

    @rules.struct_rule
    def options_rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        kind = info.type
        if not (isinstance(kind, type) and issubclass(kind, Options)):
            return None
        hints, docs, specs = get_type_hints(kind, include_extras=True), documentation(kind), []
        for field in dataclasses.fields(kind):  # type: ignore[arg-type]
            if (kind, field.name) not in offered:
                continue
            hint, inner = hints[field.name], options_in(hints[field.name])
            default = tyro.MISSING if field.default is dataclasses.MISSING else field.default
            if isinstance(info.default, kind):
                default = getattr(info.default, field.name)
            if inner is not None:
                hint, default = inner, inner() if default is None else default
            marks = _marks(kind, field.name, hint, default)
            if default is tyro.MISSING and inner is None:
                marks.append(tyro.conf.Positional)
            annotated: Any = Annotated[(hint, *marks)] if marks else hint
            specs.append(StructFieldSpec(field.name, annotated, default, docs.get(field.name, "")))
        return StructConstructorSpec(kind, tuple(specs))

    return rules


def _steps(kind: type[Options]) -> Iterator[tuple[type[Options], str]]:
    """The fields, each with its dataclass, on the ways to all that a flag sets."""
    for flag in flags(kind):
        owner: type[Options] | None = kind
        for name in flag.path:
            assert owner is not None
            yield owner, name
            owner = options_in(get_type_hints(owner)[name])


def _marks(kind: type[Options], field: str, hint: Any, default: Any) -> list[Any]:
    """What tyro is told of a field: its name, and how a list of words is given: separated by commas where
    these are known, and by repeating the flag where that replaces no other words."""
    marks: list[Any] = []
    if field in kind.names:
        marks.append(tyro.conf.arg(name=kind.names[field]))
    bare, rules = (get_args(hint)[0], get_args(hint)[1:]) if get_origin(hint) is Annotated else (hint, ())
    if get_origin(bare) is tuple and get_args(bare) == (str, ...):
        known = next((rule for rule in rules if isinstance(rule, Words)), None)
        if known is not None:
            marks.append(_commas(known))
        elif default == ():
            marks.append(tyro.conf.UseAppendAction)
    return marks


def _commas(known: Words) -> PrimitiveConstructorSpec[tuple[str, ...]]:
    """A list of words in one, separated by commas."""
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=",".join(known.names).upper(),
        instance_from_str=lambda texts: known.read(texts[0]),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [",".join(value) or known.nothing],
    )


def documentation(kind: type[Options]) -> dict[str, str]:
    """The string under each field of a dataclass, in one line."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(node, ast.ClassDef)
    found = {}
    for field, below in zip(node.body, node.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                found[field.target.id] = " ".join(str(below.value.value).split())
    return found
