"""Recipes: TOML tables read into frozen dataclasses.

A recipe is data. Every key that a stage knows is a field of a dataclass, the sentence below the field is its
documentation, and a key, a type or a table that does not fit is an error that lists what does.
"""

import ast
import dataclasses
import inspect
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from lfd.core.errors import RecipeError, UnknownName

Table = dict[str, Any]


def load_toml(path: Path, tables: Iterable[str], overrides: Iterable[str] = ()) -> dict[str, Table]:
    """The tables of a recipe file, with `overrides` such as `train.steps=20` (a TOML value) put over them.

    Raises `RecipeError` when the file is not there or no TOML, `UnknownName` for a table not in `tables`.
    """
    if not path.is_file():
        beside = sorted(p.name for p in path.parent.glob("*.toml")) if path.parent.is_dir() else []
        known = f"; in {path.parent}: {', '.join(beside)}" if beside else ""
        raise RecipeError(f"no recipe {path}{known}")
    try:
        recipe = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecipeError(f"{path} is no TOML: {error}") from error
    for override in overrides:
        _override(recipe, override)
    known_tables = list(tables)
    for name, table in recipe.items():
        if name not in known_tables:
            raise UnknownName(f"recipe table in {path}:", f"[{name}]", [f"[{t}]" for t in known_tables])
        if not isinstance(table, dict):
            raise RecipeError(f"{path}: {name!r} is no table; write it as [{name}]")
    return recipe


def _override(recipe: dict[str, Table], override: str) -> None:
    dotted, equals, text = override.partition("=")
    table, dot, key = dotted.strip().partition(".")
    if not (equals and dot and key):
        raise RecipeError(f"cannot read the override {override!r}; write TABLE.KEY=VALUE, for example train.steps=20")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text  # a bare word is a string
    recipe.setdefault(table, {})[key] = value


def build[T](kind: type[T], table: Mapping[str, Any], where: str) -> T:
    """An instance of the dataclass `kind` from a TOML table.

    Raises `UnknownName` for a key that is no field, `RecipeError` for a missing key or a value of another
    type. A dataclass with a `check` method has its own say about values.
    """
    types = get_type_hints(kind)
    fields = {f.name: f for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    for key in table:
        if key not in fields:
            raise UnknownName(f"key in {where}:", key, fields)
    missing = [n for n, f in fields.items() if n not in table and not _has_default(f)]
    if missing:
        raise RecipeError(f"{where} lacks {', '.join(missing)}: {describe(kind)[missing[0]]}")
    made = kind(**{key: _fit(value, types[key], f"{where} {key}") for key, value in table.items()})
    check = getattr(made, "check", None)
    if check is not None:
        check(where)
    return made


def _has_default(field: dataclasses.Field[Any]) -> bool:
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


def _fit(value: Any, wanted: Any, where: str) -> Any:
    """`value` as the type `wanted`: whole numbers serve as floats, arrays become tuples."""
    if get_origin(wanted) is tuple and isinstance(value, list):
        item = get_args(wanted)[0]
        return tuple(_fit(v, item, f"{where}[{i}]") for i, v in enumerate(value))
    if wanted is float and type(value) is int:
        return float(value)
    plain = get_origin(wanted) or wanted
    if not isinstance(value, plain) or (isinstance(value, bool) and plain is not bool):
        raise RecipeError(f"{where} = {value!r}: expected {_type_name(wanted)}, got {type(value).__name__}")
    return value


def _type_name(wanted: Any) -> str:
    if get_origin(wanted) is tuple:
        return f"an array of {get_args(wanted)[0].__name__}"
    return getattr(wanted, "__name__", str(wanted))


def describe(kind: type) -> dict[str, str]:
    """Field name to the sentence that stands below the field in the source."""
    body = ast.parse(inspect.getsource(kind).lstrip()).body[0]
    assert isinstance(body, ast.ClassDef)
    sentences: dict[str, str] = {}
    for field, below in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            text = below.value if isinstance(below, ast.Expr) else None
            sentences[field.target.id] = text.value if isinstance(text, ast.Constant) else ""  # type: ignore[assignment]
    return sentences


def as_table(instance: Any) -> Table:
    """The dataclass `instance` as plain values, as a manifest keeps it."""
    return {key: list(v) if isinstance(v, tuple) else v for key, v in dataclasses.asdict(instance).items()}
