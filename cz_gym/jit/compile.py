"""Compilation of the equations.

Every equation is written once, as a plain function marked :func:`jittable`. Called from Python it takes floats, arrays
or complex numbers; called from a :func:`kernel` it compiles into its loop. numba's disk cache looks only at the file of
the outermost function, so a changed equation in another module would run the old physics; here the cache folder is
named by a hash of every source of the package that can be compiled in.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, overload, register_jitable

from .cache import CachedCode, cache_folder

F = TypeVar("F", bound=Callable[..., Any])
UNCOMPILED = bool(cast(Any, numba.config).DISABLE_JIT)
"""Whether the user has turned numba off by NUMBA_DISABLE_JIT: loops are then run by Python, a thousand times slower."""


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
    if hasattr(argument, "_fields"):
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


def column(kind: Any, array: Any, at: Any, lane: Any) -> Any:
    """Read a named tuple of this kind from a column of an array, from row ``at`` on."""
    return kind(*(array[at + row, lane] for row in range(len(kind._fields))))


def set_column(kind: Any, values: Any, array: Any, at: Any, lane: Any) -> None:
    """Write the fields of a named tuple, or of a record with the same ones, to a column of an array."""
    for row, name in enumerate(kind._fields):
        array[at + row, lane] = getattr(values, name)


@overload(column, strict=False)
def _compiled_column(kind: Any, array: Any, at: Any, lane: Any) -> Any:
    fields = kind.instance_class._fields
    values = (f"{name}=array[at + {row}, lane]" for row, name in enumerate(fields))
    return _written(f"def compiled(kind, array, at, lane): return kind({', '.join(values)})")


@overload(set_column, strict=False)
def _compiled_set_column(kind: Any, values: Any, array: Any, at: Any, lane: Any) -> Any:
    fields = kind.instance_class._fields
    lines = (f"    array[at + {row}, lane] = values.{name}" for row, name in enumerate(fields))
    return _written("\n".join(["def compiled(kind, values, array, at, lane):", *lines]))


def _written(source: str) -> Any:
    """The function ``compiled`` that the source text defines; numba would not unroll a loop over fields."""
    names: dict[str, Any] = {}
    exec(source, names)
    return names["compiled"]


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
