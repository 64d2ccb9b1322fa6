"""Hashes of functions and of files that ignore formatting and comments."""

import ast
import hashlib
import inspect
import json
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

_NO_MEANING = frozenset({"ctx", "kind", "type_comment", "type_params"})
"""Parts of a syntax tree that do not change what is computed."""
_LIBRARIES = ("builtins", "math", "numba", "numpy")
"""Packages whose functions count by their names."""


def function_hash(*functions: Callable[..., Any]) -> str:
    """SHA-256 of what functions compute: their code, and every function and value that it refers to (16 hex digits).

    Closures, defaults and global constants count, numbers to twelve digits; names of files, formatting, comments,
    docstrings and annotations do not.
    """
    seen: dict[int, int] = {}
    content = [_value(function, seen) for function in functions]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def hash_files(files: Iterable[Path]) -> str:
    """SHA-256 of the files' names, with their folder's, and contents (32 hex digits).

    Of a Python file its byte code counts: comments, docstrings and checks by ``assert`` change nothing.
    """
    digest = hashlib.sha256()
    for file in files:
        content = file.read_bytes()
        if file.suffix == ".py":
            content = repr(_byte_code(compile(content, "", "exec", dont_inherit=True, optimize=2))).encode()
        digest.update(f"{file.parent.name}/{file.name}".encode() + b"\0" + content + b"\0")
    return digest.hexdigest()[:32]


def _byte_code(value: Any) -> Any:
    """Code or one of its constants, without file and line numbers, as a value whose text is always the same."""
    if isinstance(value, frozenset):
        return sorted(map(repr, value))
    if not isinstance(value, CodeType):
        return value
    names = value.co_names, value.co_varnames, value.co_freevars, value.co_cellvars
    return value.co_code, value.co_flags, names, [_byte_code(each) for each in value.co_consts]


def _value(value: Any, seen: dict[int, int]) -> Any:
    """A function or a value that one refers to, as JSON that is the same in every process."""
    value = getattr(value, "py_func", value)
    if isinstance(value, FunctionType) and not _of_library(value):
        if id(value) in seen:
            return ["seen", seen[id(value)]]
        seen[id(value)] = len(seen)
        return _function(value, seen)
    if isinstance(value, np.ndarray):
        return ["array", list(value.shape), [_value(number, seen) for number in value.ravel().tolist()]]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, (float, complex)):
        return f"{value + 0.0:.12g}"
    if isinstance(value, (tuple, list)):
        return [type(value).__name__, [_value(part, seen) for part in value]]
    if isinstance(value, dict):
        return ["dict", [[repr(key), _value(part, seen)] for key, part in value.items()]]
    if isinstance(value, type):
        return ["class", value.__qualname__, list(getattr(value, "_fields", ()))]
    if value is None or isinstance(value, (bool, int, str, bytes)):
        return repr(value)
    named = value if hasattr(value, "__name__") else type(value)
    return [getattr(named, "__module__", ""), named.__name__]


def _function(function: FunctionType, seen: dict[int, int]) -> Any:
    closed = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    scope = {**function.__globals__, **{name: cell.cell_contents for name, cell in closed}}
    tree = _syntax(function)
    compiled = function.__code__
    if tree is None:
        constants = [repr(each) for each in compiled.co_consts if not isinstance(each, CodeType)]
        code, names = [compiled.co_code.hex(), constants], {*compiled.co_names, *compiled.co_freevars}
    else:
        code, names = _tree(tree), _names(tree, scope)
    meant = {name: scope[name.partition(".")[0]] for name in names if name.partition(".")[0] in scope}
    meant |= {name: getattr(meant[name], name.partition(".")[2], None) for name in meant if "." in name}
    defaults = _value([*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()], seen)
    return [code, defaults, [[name, _value(meant[name], seen)] for name in sorted(meant)]]


def _syntax(function: FunctionType) -> ast.AST | None:
    """The function's syntax tree; None for a lambda, and where there is no source."""
    try:
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    except (OSError, TypeError, SyntaxError, ValueError):
        return None
    if not isinstance(tree, ast.FunctionDef) or tree.name != function.__name__:
        return None
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            node.decorator_list, node.returns = [], None
        elif isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
    return tree


def _names(tree: ast.AST, scope: dict[str, Any]) -> set[str]:
    """Names that a function reads; of a module, the parts of it that it reads (``module.part``)."""
    read = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    modules = {name for name in read if isinstance(scope.get(name), ModuleType)}
    parts = {
        f"{node.value.id}.{node.attr}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules
    }
    return read - modules | parts


def _tree(node: Any) -> Any:
    """A syntax tree as JSON: what is empty is left out, so that it is the same in every Python."""
    if isinstance(node, list):
        return [_tree(part) for part in node if not _is_docstring(part)]
    if not isinstance(node, ast.AST):
        return repr(node)
    fields = [(name, value) for name, value in ast.iter_fields(node) if name not in _NO_MEANING]
    return [type(node).__name__, *([name, _tree(value)] for name, value in fields if value not in (None, []))]


def _is_docstring(node: Any) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _of_library(value: Any) -> bool:
    return str(getattr(value, "__module__", "")).partition(".")[0] in _LIBRARIES
