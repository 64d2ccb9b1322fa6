"""Compilation: marks for functions that compile into the loops, and where compiled code is kept."""

import os

# Intel's vector mathematics, where numba finds it, rounds otherwise than libm: results would depend on the machine.
# numba reads this when it is first imported.
os.environ.setdefault("NUMBA_DISABLE_INTEL_SVML", "1")

import hashlib
import pickle
import sys
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from inspect import signature
from pathlib import Path
from types import CodeType
from typing import Any, TypeVar, cast
from uuid import uuid4

import llvmlite
import numba
import numpy as np
from llvmlite import ir
from numba.core import caching, cgutils, serialize, types
from numba.core.datamodel import models
from numba.core.imputils import lower_constant
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    overload,
    register_jitable,
    register_model,
    typeof_impl,
)

from cz_gym.support.errors import CzError
from cz_gym.support.files import write_files

# Compiled code on disk: one file a function and signature, checked before it is used.
#
# numba keeps an index beside numbered files. Two processes that compile at once, or one that is killed between the two
# writes, can leave an index that names the code of another signature, which then runs on arguments it was not made
# for. Here a file is named by the types that it was compiled for, repeats them inside, and is replaced whole; code
# that cannot be loaded is compiled again. A file is trusted as those of ``__pycache__`` are.

PACKAGE = Path(__file__).parent
CACHE_VARIABLE = "CZ_GYM_CACHE_DIR"
"""Environment variable naming the folder for compiled code; empty means: keep none."""
NEVER_COMPILED = (
    "agents", "baselines", "evaluation", "puller/shipped", "rendering", "sb3.py", "support/command_line.py", "tools",
    "vector_checker.py",
)  # fmt: skip
"""Parts of the package of which nothing is compiled in; all others count, whatever they hold."""
FunctionCache: Any = caching.FunctionCache
dumps: Any = serialize.dumps


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


def compiled_sources(folder: Path | None = None) -> list[Path]:
    """Every file of the package that compiled code may have taken a function or a constant from, sorted."""
    folder = folder or PACKAGE
    files = (file for kind in ("*.py", "*.json") for file in folder.rglob(kind))
    apart = [folder / part for part in NEVER_COMPILED]
    return sorted(file for file in files if not any(file.is_relative_to(part) for part in apart))


def source_hash(folder: Path | None = None) -> str:
    """Hash of the names and the code of :func:`compiled_sources` (32 hex digits)."""
    return hash_files(compiled_sources(folder))


@cache
def cache_folder() -> Path | None:
    """The writable folder for this version's compiled code, or None if there is none."""
    named = os.environ.get(CACHE_VARIABLE)
    if named == "":
        return None
    try:
        home = Path(named) if named else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cz-gym"
        versions = f"numba{numba.__version__}-llvmlite{llvmlite.__version__}-numpy{np.__version__}"
        folder = home / f"{source_hash()}-{versions}"
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not named and hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
            return None
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError):
        return None
    return folder


def hashed(*functions: Callable[..., Any]) -> bool:
    """True if :func:`source_hash` counts the text of every one of these functions."""
    seen = {str(file) for file in compiled_sources()}
    codes = [getattr(function, "__code__", None) for function in functions]
    return all(code is not None and str(Path(code.co_filename)) in seen for code in codes)


class Store:
    """The files of one function's compiled code, in place of numba's index and files."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name

    def path(self, key: Any) -> Path:
        """The file of the code for these types, this processor and these sources."""
        return self.folder / f"{self.name}.{hashlib.sha256(repr(key).encode()).hexdigest()[:32]}.code"

    def load(self, key: Any) -> Any:
        """The code saved for this key; None if there is none. A damaged file raises pickle's errors."""
        try:
            made_for, data = pickle.loads(self.path(key).read_bytes())
        except OSError:
            return None
        return data if made_for == key else None

    def save(self, key: Any, data: Any) -> None:
        """Save code if the disk has room; without room it is compiled again next time."""
        with suppress(CzError):
            write_files({self.path(key): dumps((key, data))})


class CachedCode(FunctionCache):  # type: ignore[misc]
    """numba's cache of one function, on a :class:`Store`."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        files: Any = Store(Path(self._cache_path), self._impl.filename_base)
        self._cache_file = files

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Compiled code for this signature; None if there is none that can be loaded."""
        try:
            code = super().load_overload(sig, target_context)
        except Exception:
            code = None
        if code is None:
            announce()
        return code


@cache
def announce() -> None:
    """Print once, on a terminal, why the first use takes long."""
    if sys.stderr.isatty():
        print("cz_gym: compiling the plant for this machine, once; about 20 s", file=sys.stderr, flush=True)


# Compilation of the equations.
#
# Every equation is written once, as a plain function marked :func:`jittable`. Called from Python it takes floats,
# arrays or complex numbers; called from a :func:`kernel` it compiles into its loop. numba's disk cache looks only at
# the file of the outermost function, so a changed equation in another module would run the old physics; here the cache
# folder is named by a hash of every source of the package that can be compiled in.

F = TypeVar("F", bound=Callable[..., Any])
UNCOMPILED = bool(cast(Any, numba.config).DISABLE_JIT)
"""True if NUMBA_DISABLE_JIT turns numba off: Python then runs the loops, a thousand times slower."""


def jittable(function: F) -> F:
    """Mark a function as an equation: plain Python outside a kernel, compiled inside it.

    Compiled, as on arrays, division by zero gives inf or NaN, never an exception (``error_model="numpy"``).
    """
    return register_jitable(error_model="numpy")(function)


def force_inlined(function: F) -> F:
    """A :func:`jittable` whose machine code is inlined into its callers, so that loops can be vectorised."""
    return register_jitable(error_model="numpy", forceinline=True)(function)


def inlined(function: F) -> F:
    """Mark a part of kernels whose text is inlined into each: a call with a step's arrays costs a tenth of the step.

    It is inlined before types are inferred; as a :func:`force_inlined` it and all it calls would compile twice.
    For module level only: kept in a closure it would change the key of the kernel on disk in every process.
    """
    return cast(F, numba.njit(error_model="numpy", inline="always")(function))


def kernel(function: F, keep: bool = True, allocates: bool = True) -> F:
    """Compile a loop over slots: no GIL, no fast-math, cached on disk when there is a place for it.

    ``keep=False`` caches nothing: for loops over functions from elsewhere, whose changes no hash would see.
    ``allocates=False`` promises that the loop makes no array, so that views of its arguments need no reference counts.
    """
    if UNCOMPILED:

        def uncompiled(*arguments: Any) -> Any:
            with np.errstate(all="ignore"):
                return function(*map(_as_records, arguments))

        return cast(F, uncompiled)
    folder = cache_folder() if keep else None
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"} | ({} if allocates else {"_nrt": False})
    compiled, settings = cast(Any, numba.njit(**options)(function)), cast(Any, numba.config)
    if folder is not None and hasattr(compiled, "_cache"):
        previous, settings.CACHE_DIR = settings.CACHE_DIR, str(folder)
        with suppress(RuntimeError, OSError):  # a folder that cannot be written any more
            compiled._cache = CachedCode(function)
        settings.CACHE_DIR = previous
    return cast(F, compiled)


def _as_records(argument: Any) -> Any:
    """An array of records, alone or in named tuples, as one whose fields are attributes, as in compiled code."""
    if isinstance(argument, tuple) and hasattr(argument, "_fields"):
        return type(argument)(*map(_as_records, argument))
    records = isinstance(argument, np.ndarray) and argument.dtype.names
    return argument.view(np.recarray) if records else argument


def entry(loop: Any, arguments: tuple[Any, ...]) -> Any:
    """The compiled form of a kernel for the types of these arguments only.

    It skips the search for the right form at every call, which costs several times a slot's step.
    """
    compile_for = getattr(loop, "compile", None)
    typeof: Any = numba.typeof
    return loop if compile_for is None else compile_for(tuple(map(typeof, arguments)))


@intrinsic
def _fetch(typing_context: Any, array: Any, at: Any) -> Any:
    """The prefetch instruction: for writing (1), high locality (3), data (1)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        held = context.make_array(signature.args[0])(context, builder, arguments[0])
        address = builder.bitcast(builder.gep(held.data, [arguments[1]]), cgutils.voidptr_t)
        number = ir.IntType(32)
        hint = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, number, number, number])
        prefetch = builder.module.declare_intrinsic("llvm.prefetch", [cgutils.voidptr_t], hint)
        builder.call(prefetch, [address, number(1), number(3), number(1)])
        return context.get_dummy_value()

    return types.none(array, types.int64), generate


def fetch(array: Any, at: Any) -> None:
    """In a kernel, prefetch number ``at`` of a contiguous array, also one outside of it; uncompiled, do nothing."""


@overload(fetch, inline="never")
def _compiled_fetch(array: Any, at: Any) -> Any:
    def compiled(array: Any, at: Any) -> None:
        _fetch(array, at)  # type: ignore[call-arg]

    return compiled


@cache
def _symbol(value: Any) -> str:
    """Hash of the names of a static value's functions, for symbols: stable for those of this package, else used once.

    Machine code of two values that is loaded from disk into one process must not have symbols in common: the linker
    would take one for the other.
    """
    text = repr([_function_name(part) for part in value])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _function_name(part: Any) -> Any:
    if isinstance(part, tuple):
        return [_function_name(each) for each in part]
    name = f"{getattr(part, '__module__', '')}.{getattr(part, '__qualname__', part)}"
    ours = name.startswith("cz_gym.") and "<" not in name
    return name if ours or not callable(part) else f"{name} {uuid4()}"


class Static(types.Opaque):
    """Type of one :func:`static` value: its attributes are constants and functions of the compiled code."""

    def __init__(self, value: Any) -> None:
        self.value = value
        super().__init__(f"Static({type(value).__name__}, {_symbol(value)})")

    @property
    def key(self) -> Any:
        """The value, which tells two of these types apart."""
        return self.value


def static(kind: Any) -> Any:
    """Mark a hashable class whose values are compiled in: in a kernel, ``value.rates(...)`` is a direct call.

    Attributes, properties too, may be functions marked as equations, named tuples' classes, numbers and their tuples,
    and other static values. Each value compiles code of its own.
    """
    register: Any = typeof_impl.register
    register(kind)(lambda value, context: Static(value))
    return kind


_register: Any = register_model
_lower_attribute: Any = lower_getattr_generic
_register(Static)(models.OpaqueModel)


@lower_constant(Static)  # type: ignore[no-untyped-call]
def _no_bits(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    return context.get_dummy_value()


@infer_getattr
class _StaticAttribute(AttributeTemplate):
    key = Static

    def generic_resolve(self, kind: Any, name: str) -> Any:  # type: ignore[override]
        value = getattr(kind.value, name)
        literal: Any = types.literal
        return literal(value) if type(value) is int else self.context.resolve_value_type(value)


@_lower_attribute(Static)
def _static_attribute(context: Any, builder: Any, kind: Any, value: Any, name: str) -> Any:
    type_of = context.typing_context.resolve_getattr(kind, name)
    return context.get_constant_generic(builder, type_of, getattr(kind.value, name))


def compiled_as(function: Any) -> Any:
    """Decorate a writer of the text that a function of labelled tuples compiles to: numba unrolls no loop over fields.

    The writer takes the arguments' numba types; it returns the body's lines, and a dictionary of the names in them.
    """

    def register(writer: Any) -> Any:
        names = ", ".join(signature(function).parameters)

        def compiled(*arguments: Any) -> Any:
            lines, scope = writer(*arguments)
            exec("\n    ".join([f"def compiled({names}):", *(lines or ["return None"])]), scope)
            return scope["compiled"]

        exec(f"def wrapper({names}): return compiled({names})", scope := {"compiled": compiled})
        overload(function, strict=False, jit_options={"error_model": "numpy", "forceinline": True})(scope["wrapper"])
        return writer

    return register


def column(kind: Any, array: Any, at: Any, lane: Any) -> Any:
    """Read a named tuple of this kind from a column of an array, from row ``at`` on."""
    return kind(*(array[at + row, lane] for row in range(len(kind._fields))))


def set_column(kind: Any, values: Any, array: Any, at: Any, lane: Any) -> None:
    """Write the fields of a named tuple, or of a record with the same ones, to a column of an array."""
    for row, name in enumerate(kind._fields):
        array[at + row, lane] = getattr(values, name)


def labelled(kind: Any, record: Any) -> Any:
    """Read a named tuple of this kind from a record that has its fields."""
    return kind(*(getattr(record, name) for name in kind._fields))


def joined(kind: Any, first: Any, second: Any) -> Any:
    """A named tuple of this kind whose fields are those of two others, one after the other."""
    return kind(*first, *second)


@compiled_as(joined)
def _joined(kind: Any, first: Any, second: Any) -> Any:
    fields = [f"{name}.{each}" for name, part in (("first", first), ("second", second)) for each in part.fields]
    return [f"return kind({', '.join(fields)})"], {}


def set_labelled(kind: Any, values: Any, record: Any) -> None:
    """Write a named tuple of this kind to a record that has its fields."""
    for name in kind._fields:
        setattr(record, name, getattr(values, name))


def _by_field(function: Any, text: str, returns: bool) -> None:
    """Compile a function of a class of named tuples to this text for each of the fields, as statements or arguments."""

    @compiled_as(function)
    def write(kind: Any, *_: Any) -> Any:
        parts = [text.format(name=name, row=row) for row, name in enumerate(kind.instance_class._fields)]
        return ([f"return kind({', '.join(parts)})"] if returns else parts), {}


_by_field(column, "array[at + {row}, lane]", True)
_by_field(set_column, "array[at + {row}, lane] = values.{name}", False)
_by_field(labelled, "record.{name}", True)
_by_field(set_labelled, "record.{name} = values.{name}", False)


@intrinsic(prefer_literal=True)
def _on_stack(typing_context: Any, rows: Any, columns: Any) -> Any:
    if not isinstance(rows, types.IntegerLiteral) or not isinstance(columns, types.IntegerLiteral):
        return None
    array, shape = types.Array(types.float64, 2, "C"), (rows.literal_value, columns.literal_value)
    size = shape[0] * shape[1]

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number, made = context.get_constant, context.make_array(array)(context, builder)
        block: Any = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), size))  # type: ignore[no-untyped-call]
        block.align = 64
        context.populate_array(
            made,
            data=builder.bitcast(block, made.data.type),
            shape=[number(types.intp, length) for length in shape],
            strides=[number(types.intp, 8 * shape[1]), number(types.intp, 8)],
            itemsize=number(types.intp, 8),
            meminfo=None,
        )
        return made._getvalue()

    return array(rows, columns), generate


scratch: Callable[..., Any] = (lambda *shape: np.empty(shape)) if UNCOMPILED else _on_stack
"""``scratch(rows, columns)``, in a kernel alone: an array of numbers, not set, on the stack until the function returns.

Nothing is allocated, and the compiler knows that nothing else lies there. Rows and columns are constants.
"""
