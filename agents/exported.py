"""An ONNX file of any exporter as the plain graph of an agent file.

Exporters write constants as nodes, weights into another file, recurrent layers with an axis of time, and shape
arithmetic between them. Here constants are computed, axes of length 1 are left out, and GRU, LSTM and RNN become the
operations of one step, so that what is left are operations on rows (n, width). A value of several rows a puller, as
the state (layers, n, width) of a recurrent network of several layers, becomes one row of all its numbers, in order.
:func:`.graph.check_graph` checks the result like every agent's graph; it alone reads files that others wrote.
"""

from operator import add, floordiv, mul, sub
from pathlib import Path
from typing import Any

import numpy as np

from .graph import DOMAINS, INPUTS, OUTPUTS, GraphError, check_graph

OPSET, IR_VERSION = 17, 9
"""Versions of the graphs that are written."""
ALIASES = ("Identity", "Cast", "Dropout", "Unsqueeze", "Squeeze", "Flatten", "Reshape", "Transpose", "Expand")
"""Operators that leave the numbers of a row as they are, where they leave its length."""
GATES = {"RNN": 1, "GRU": 3, "LSTM": 4}
"""Recurrent operators, and how many vectors of the state's length their weights give."""

ELEMENTWISE = {"Abs", "Add", "Div", "Elu", "Mul", "Neg", "Relu", "Sigmoid", "Softplus", "Sqrt", "Sub", "Tanh"}
"""Operators that may act on several rows a puller."""
ARITHMETIC: dict[str, Any] = {"Mul": mul, "Add": add, "Sub": sub, "Div": floordiv}
"""Operators that may compute a length."""


def to_plain(source: bytes | Path, channels: int) -> bytes:
    """Rebuild an ONNX model as an agent's graph: ``observation`` (n, channels) to ``action`` (n, 2), with ``state``.

    Further inputs and outputs become parts of the state, in order. GraphError says what no agent's graph can say.
    """
    import onnx
    from google.protobuf.message import Error as ProtobufError
    from onnx import inliner, version_converter

    try:
        model = onnx.load(source) if isinstance(source, Path) else onnx.load_from_string(source)
        if any(tensor.data_location == tensor.EXTERNAL for tensor in model.graph.initializer):
            raise GraphError("keeps weights in another file: give the path of the ONNX file, beside which it lies")
        if len(model.functions):
            model = inliner.inline_local_functions(model)
        if others := [f"{node.domain}.{node.op_type}" for node in model.graph.node if node.domain not in DOMAINS]:
            raise GraphError(f"uses operators beyond the standard ONNX ones, {others[0]}")
        if (
            any(node.op_type == "BatchNormalization" for node in model.graph.node)
            and model.opset_import[0].version < 14
        ):
            model = version_converter.convert_version(model, OPSET)  # onnx would compute an older one as in training
        before = model.SerializeToString()
        plain = (rebuilt := _Rebuilt(model, channels)).serialised()
        check_graph(plain, channels)
        _compare(onnx.load_from_string(before), onnx.load_from_string(plain), rebuilt.places)
        return plain
    except GraphError:
        raise
    except (ProtobufError, onnx.checker.ValidationError, onnx.shape_inference.InferenceError, OSError,
            ValueError, TypeError, RuntimeError, KeyError, IndexError, AttributeError) as error:  # fmt: skip
        raise GraphError(f"not a sound ONNX model ({' '.join(str(error).split()):.120})") from None


class _Rebuilt:
    """The nodes of a model on rows of pullers, in the order of the model."""

    def __init__(self, model: Any, channels: int) -> None:
        from onnx import helper, numpy_helper

        self.opset = next((each.version for each in model.opset_import if each.domain in DOMAINS), OPSET)
        self.constants: dict[str, Any] = {each.name: numpy_helper.to_array(each) for each in model.graph.initializer}
        self.inputs = [each for each in model.graph.input if each.name not in self.constants]
        for value in self.inputs:
            _free_rows(value)
        self.dims: dict[str, list[Any]] = {}
        """Values of shape arithmetic; "n" where one is the number of pullers."""
        self.shapes = _shapes_of(model)
        while self._fold(model.graph):  # computed lengths make more shapes known
            self.shapes = _shapes_of(model)
        self.rows: dict[str, str] = {}
        """Name in the new graph of each value with rows."""
        self.nodes: list[Any] = []
        self.tensors: dict[str, Any] = {}
        self.state = self._begin(channels)
        for node in model.graph.node:
            self._rows_of(node, {each.name: helper.get_attribute_value(each) for each in node.attribute})
        self._end(results := [value.name for value in model.graph.output])
        self.places = [[self._shape(name).index("n") for name in names] for names in (self.names, results)]
        """Axes of the pullers in inputs and outputs."""

    def serialised(self) -> bytes:
        """The new model, without what its outputs do not need."""
        from onnx import TensorProto, checker, helper, numpy_helper

        nodes, needed = list[Any](), set(OUTPUTS)
        for node in reversed(self.nodes):
            if needed & set(node.output):
                nodes.insert(0, node)
                needed |= set(node.input)
        widths = ([self.channels, *self.width], [2, *self.width])
        values = [
            [
                helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", k])
                for name, k in zip(names, own, strict=False)
            ]
            for names, own in zip((INPUTS, OUTPUTS), widths, strict=True)
        ]
        tensors = [numpy_helper.from_array(array, name) for name, array in self.tensors.items() if name in needed]
        graph = helper.make_graph(nodes, "cz_gym_agent", values[0], values[1], tensors)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        checker.check_model(model)
        content: bytes = model.SerializeToString()
        return content

    def _begin(self, channels: int) -> list[int]:
        """Name the inputs; returns the lengths of the parts of the state."""
        if not self.inputs:
            raise GraphError("has no input")
        self.names = first, *others = [value.name for value in self.inputs]
        lengths = [self._length(first), *map(self._size, others)]
        if lengths[0] != channels:
            raise GraphError(f"reads {lengths[0]} channels, not {channels}")
        self.channels, self.width, self.rows[first] = channels, [sum(lengths[1:])] if others else [], INPUTS[0]
        if len(others) == 1:
            self.rows[others[0]] = INPUTS[1]
        ends = np.cumsum([0, *lengths[1:]]).tolist()
        for name, low, high in zip(others, ends, ends[1:], strict=False) if len(others) > 1 else ():
            self.rows[name] = self._columns(INPUTS[1], low, high)
        return lengths[1:]

    def _end(self, names: list[str]) -> None:
        """Name the outputs: the action, then the parts of the next state."""
        for name in names:
            if name not in self.rows:
                raise GraphError("its outputs do not depend on its inputs")
        lengths = [self._size(name) for name in names]
        if lengths != [2, *self.state]:
            expected = "2 numbers, the action" + "".join(f", then {k} of the next state" for k in self.state)
            raise GraphError(f"gives {' and '.join(map(str, lengths))} numbers in {len(names)} outputs, not {expected}")
        action, *state = (self.rows[name] for name in names)
        self._emit("Identity", [action], OUTPUTS[0])
        if state:
            joined = state[0] if len(state) == 1 else self._emit("Concat", state, axis=1)
            self._emit("Identity", [joined], OUTPUTS[1])

    def _emit(self, operator: str, inputs: list[Any], name: str = "", **attributes: Any) -> str:
        """Add a node of one output; inputs are names or arrays."""
        from onnx import helper

        name = name or f"v{len(self.nodes)}"
        given = [each if isinstance(each, str) else self._tensor(each) for each in inputs]
        self.nodes.append(helper.make_node(operator, given, [name], **attributes))
        return name

    def _tensor(self, array: Any) -> str:
        array = np.asarray(array)
        kept = array.astype(np.int64 if array.dtype.kind in "iub" else np.float32)
        if not np.isfinite(kept).all():
            raise GraphError("has weights that are not finite")
        name = f"w{len(self.tensors)}"
        self.tensors[name] = kept
        return name

    def _columns(self, rows: str, low: int, high: int) -> str:
        return self._emit("Slice", [rows, np.array([low]), np.array([high]), np.array([1])])

    def _shape(self, name: str) -> list[Any]:
        if name not in self.shapes:
            raise GraphError(f"has a value of unknown shape, {name!r:.60}")
        return self.shapes[name]

    def _length(self, name: str) -> int:
        """Length of a value's rows; GraphError for a value that is more than one row a puller."""
        others = [dim for dim in self._shape(name) if dim not in (1, "n")]
        if len(others) > 1 or self._shape(name).count("n") != 1:
            fixed = "" if "n" in self._shape(name) and others[1:] == [] else ": was it exported for a fixed batch?"
            raise GraphError(f"has a value of shape {self._shape(name)}, not one row a puller{fixed}")
        return int(others[0]) if others else 1

    def _size(self, name: str) -> int:
        """Count of a value's numbers for each puller."""
        return int(self._numbers(name).size)

    def _numbers(self, name: str) -> Any:
        """Number the columns of a value's row, in the value's own shape with a length of 1 for the pullers."""
        shape = self._shape(name)
        if shape.count("n") != 1 or any(not isinstance(dim, int) for dim in shape if dim != "n"):
            self._length(name)
        lengths = [1 if dim == "n" else dim for dim in shape]
        return np.arange(np.prod(lengths, dtype=int)).reshape(lengths)

    def _pick(self, rows: str, columns: Any) -> str:
        """Select columns of rows, by their numbers in any shape."""
        flat, (low, high) = columns.ravel(), (int(columns.min()), int(columns.max()) + 1)
        if np.array_equal(flat, np.arange(low, high)):
            return self._columns(rows, low, high)
        return self._emit("Gather", [rows, flat], axis=1)

    def _is_row_axis(self, name: str, axis: int) -> bool:
        """Tell whether an axis is the one of a value's row: the only one that is longer than 1, or the last one."""
        shape = self._shape(name)
        others = [place for place, dim in enumerate(shape) if dim != "n"]
        return axis % len(shape) == next((place for place in others if shape[place] != 1), others[-1] if others else -1)

    def _fold(self, graph: Any) -> bool:
        """Compute the nodes of constants and known lengths, and remove them; True if there was one."""
        from onnx import numpy_helper

        known = set(self.constants)
        left = [node for node in graph.node if not self._known(node)]
        for node in left:
            any_rows = {"Reshape": -1, "Expand": 1}.get(node.op_type)
            lengths = self.dims.get(node.input[1], ()) if any_rows else ()
            if list(lengths).count("n") == 1:
                name = f"{node.input[1]} of {node.op_type}"
                self.constants[name] = np.array([any_rows if k == "n" else k for k in lengths])
                node.input[1] = name
        folded = len(left) < len(graph.node)
        del graph.node[:]
        graph.node.extend(left)
        graph.initializer.extend(
            numpy_helper.from_array(np.asarray(self.constants[name]), name) for name in self.constants.keys() - known
        )
        return folded

    def _known(self, node: Any) -> bool:
        """Compute a node of constants and known lengths; False for one that depends on more."""
        from onnx import helper

        attributes = {each.name: helper.get_attribute_value(each) for each in node.attribute}
        given = [name for name in node.input if name]
        dims = self.shapes.get(given[0], ()) if given and given[0] not in self.constants else ()
        if node.op_type == "Shape" and dims and list(dims).count("n") <= 1:  # more: lengths that are not known yet
            self.dims[node.output[0]] = dims[attributes.get("start", 0) : attributes.get("end", len(dims))]
            self._settle(node.output[0])
        elif all(name in self.constants for name in given):
            self._compute(node)
        elif all(name in self.constants or name in self.dims for name in given):
            self._count(node)
        else:
            return False
        return True

    def _settle(self, name: str) -> None:
        if "n" not in self.dims[name]:
            self.constants[name] = np.array(self.dims.pop(name), np.int64)

    def _count(self, node: Any) -> None:
        """Shape arithmetic: what picks and joins known lengths; a constant row for each puller is one for all."""
        from onnx import numpy_helper

        parts = [
            self.dims[name] if name in self.dims else np.atleast_1d(self.constants[name]).tolist()
            for name in node.input
            if name
        ]
        if node.op_type == "ConstantOfShape":
            value = next((numpy_helper.to_array(each.t)[0] for each in node.attribute), np.float32(0.0))
            self.constants[node.output[0]] = np.full([1 if dim == "n" else dim for dim in parts[0]], value)
            return
        if node.op_type == "Gather":
            found = [parts[0][int(i)] for i in parts[1]]
            if np.ndim(self.constants[node.input[1]]) == 0 and found[0] != "n":
                self.constants[node.output[0]] = np.int64(found[0])
                return
        else:
            found = _lengths(node.op_type, parts)
        self.dims[node.output[0]] = found
        self._settle(node.output[0])

    def _compute(self, node: Any) -> None:
        """Compute a node of constants; GraphError for one that draws random numbers."""
        from onnx import TensorProto, helper
        from onnx.reference import ReferenceEvaluator

        if node.op_type.startswith(("Random", "Bernoulli", "Multinomial")):
            raise GraphError(f"draws random numbers, in {node.op_type}")
        given = {name: self.constants[name] for name in node.input if name}
        types = [helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(np.asarray(value).dtype), None)
                 for name, value in given.items()]  # fmt: skip
        outputs = [helper.make_tensor_value_info(name, TensorProto.UNDEFINED, None) for name in node.output]
        graph = helper.make_graph([node], "constant", types, outputs)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", self.opset)])
        found: Any = ReferenceEvaluator(model).run(None, given)
        self.constants.update(zip(node.output, found, strict=True))

    def _operand(self, name: str) -> Any:
        """An input of a new node: a value's rows, or a constant without axes of length 1 at its front."""
        if name in self.rows or not name:
            return self.rows.get(name, "")
        array = np.asarray(self.constants[name])
        while array.ndim > 1 and array.shape[0] == 1:
            array = array[0]
        return array

    def _rows_of(self, node: Any, attributes: dict[str, Any]) -> None:
        """Rebuild a node that depends on the inputs."""
        operator, first = node.op_type, node.input[0]
        if operator in GATES:
            self._step(node, attributes)
            return
        results = [name for name in (node.output[:1] if operator == "Dropout" else node.output) if name]
        if operator in ALIASES:
            self._check_order(node, attributes)
            self.rows[results[0]] = self.rows[first]
        elif operator in ("Gather", "Slice", "Split", "Concat"):
            self._parts(node, attributes)
        elif operator not in ELEMENTWISE or not self._alike(node):
            for name in (*(name for name in node.input if name in self.rows), *results):
                self._length(name)
        if results[0] not in self.rows:
            self.rows[results[0]] = self._result_of(node, attributes)

    def _result_of(self, node: Any, attributes: dict[str, Any]) -> Any:
        """Rebuild an operation on rows; return its result."""
        operator, first = node.op_type, node.input[0]
        if operator in _OTHERS:
            values = [self._operand(name) for name in node.input[1:]]
            return _OTHERS[operator](self, self.rows[first], values, attributes, self._length(first))
        if "axis" in attributes and self._is_row_axis(first, attributes["axis"]):
            attributes["axis"] = -1
        return self._emit(operator, [self._operand(name) for name in node.input], **attributes)

    def _alike(self, node: Any) -> bool:
        """Tell whether the operands of a node are of one shape, but for single numbers."""
        shapes = [self._shape(name) for name in (*node.input, *node.output) if name in self.rows or name in node.output]
        others = [self.constants[name] for name in node.input if name in self.constants]
        return all(shape == shapes[0] for shape in shapes) and all(np.size(each) == 1 for each in others)

    def _check_order(self, node: Any, attributes: dict[str, Any]) -> None:
        """GraphError for a node that gives a row another length, or its numbers another order."""
        before, after = (self._shape(name) for name in (node.input[0], node.output[0]))
        self._numbers(node.output[0])
        if self._size(node.input[0]) != self._size(node.output[0]):
            raise GraphError(f"its {node.op_type} changes the length of a row")
        if node.op_type == "Transpose":
            order = attributes.get("perm", [*range(len(before))[::-1]])
            moved = [place for place in order if before[place] not in (1, "n")]
            mixed = moved != sorted(moved)
        else:
            sizes = [np.prod(shape[: shape.index("n")], dtype=int) for shape in (before, after)]
            mixed = node.op_type in ("Reshape", "Flatten") and sizes[0] != sizes[1]
        if mixed:
            raise GraphError(f"its {node.op_type} changes the order of numbers, from {before} to {after}")

    def _parts(self, node: Any, attributes: dict[str, Any]) -> None:
        """Rebuild a node that picks, cuts or joins columns, by what it does to their numbers."""
        operator, first, result = node.op_type, node.input[0], node.output[0]
        values: list[Any] = [self.constants.get(name) for name in node.input[1:]]
        axis = attributes.get("axis", 0)
        if operator != "Slice" and self._shape(result if operator == "Concat" else first)[axis] == "n":
            raise GraphError(f"its {operator} works on another axis than that of the channels")
        if operator == "Concat":
            ends = np.cumsum([0, *(self._size(name) for name in node.input)])
            numbers = [self._numbers(name) + end for name, end in zip(node.input, ends, strict=False)]
            joined = self._emit("Concat", [self._operand(name) for name in node.input], axis=1)
            self.rows[result] = self._pick(joined, np.concatenate(numbers, axis))
            return
        if operator == "Split":
            ends = np.cumsum([self._shape(name)[axis] for name in node.output])[:-1]
            parts = np.split(self._numbers(first), ends, axis)
        else:
            parts = [
                self._slice(first, *values)
                if operator == "Slice"
                else np.take(self._numbers(first), np.asarray(values[0], int), axis)
            ]
        for name, part in zip(node.output, parts, strict=True):
            if not part.size:
                raise GraphError(f"its {operator} leaves nothing")
            self.rows[name] = self._pick(self.rows[first], part)

    def _slice(self, name: str, lows: Any, highs: Any, axes: Any = None, steps: Any = None) -> Any:
        """Cut the numbers of a value's columns along any axes; GraphError where pullers would be left out."""
        numbers = self._numbers(name)
        for place, axis in enumerate(np.asarray(range(len(lows)) if axes is None else axes).tolist()):
            low, high, step = int(lows[place]), int(highs[place]), 1 if steps is None else int(steps[place])
            if self._shape(name)[axis] != "n":
                numbers = numbers[(slice(None),) * (axis % numbers.ndim) + (slice(low, high, step),)]
            elif (low, step) != (0, 1) or high < 2**31 - 1:
                raise GraphError("cuts another axis than that of the channels")
        return numbers

    def _step(self, node: Any, attributes: dict[str, Any]) -> None:
        """One step of a recurrent layer in plain operations; ONNX's gates are in the orders z r h, and i o f c."""
        kind, size = node.op_type, int(attributes["hidden_size"])
        named = dict(zip(("X", "W", "R", "B", "lengths", "h", "c", "P"), [*node.input, *[""] * 8], strict=False))
        usual = {"RNN": [b"Tanh"], "GRU": [b"Sigmoid", b"Tanh"], "LSTM": [b"Sigmoid", b"Tanh", b"Tanh"]}[kind]
        other = attributes.get("activations", usual) != usual
        if attributes.get("direction", b"forward") != b"forward" or other or named["P"]:
            raise GraphError(f"its {kind} has two directions, peepholes or other activations")
        if self._shape(named["X"])[attributes.get("layout", 0)] != 1:
            raise GraphError(f"its {kind} reads more than one sample at a call")
        if named["h"] not in self.rows or (kind == "LSTM" and named["c"] not in self.rows):
            raise GraphError(f"its {kind} begins anew at every call: give its state as an input and an output")
        W, R = (np.asarray(self.constants[named[name]])[0] for name in "WR")
        B = np.asarray(self.constants[named["B"]])[0] if named["B"] else np.zeros(2 * GATES[kind] * size)
        x, h = self.rows[named["X"]], self.rows[named["h"]]
        inside = self._emit("Gemm", [x, W, B[: len(W)]], transB=1)
        before = self._emit("Gemm", [h, R, B[len(W) :]], transB=1)
        if kind == "GRU":
            again = (R[2 * size :], B[len(W) + 2 * size :]) if not attributes.get("linear_before_reset", 0) else None
            after = [self._gru(size, inside, before, h, again)]
        elif kind == "LSTM":
            after = self._lstm(size, self._emit("Add", [inside, before]), self.rows[named["c"]])
        else:
            after = [self._emit("Tanh", [self._emit("Add", [inside, before])])]
        for name, rows in zip(node.output, [after[0], *after], strict=False):
            if name:
                self._length(name)
                self.rows[name] = rows

    def _gru(self, size: int, inside: str, before: str, h: str, again: Any) -> str:
        """New state of a GRU; ``again`` has weights and bias that act on the reset state, None: on the state."""
        gates = [[self._columns(rows, k * size, (k + 1) * size) for rows in (inside, before)] for k in range(3)]
        z, r = (self._emit("Sigmoid", [self._emit("Add", [*gates[k]])]) for k in range(2))
        if again:
            recalled = self._emit("Gemm", [self._emit("Mul", [r, h]), *again], transB=1)
        else:
            recalled = self._emit("Mul", [r, gates[2][1]])
        new = self._emit("Tanh", [self._emit("Add", [gates[2][0], recalled])])
        return self._emit("Add", [new, self._emit("Mul", [z, self._emit("Sub", [h, new])])])

    def _lstm(self, size: int, total: str, c: str) -> list[str]:
        """New state and cell of an LSTM."""
        *gates, candidate = (self._columns(total, k * size, (k + 1) * size) for k in range(4))
        i, o, f = (self._emit("Sigmoid", [rows]) for rows in gates)
        cell = self._emit("Add", [self._emit("Mul", [f, c]), self._emit("Mul", [i, self._emit("Tanh", [candidate])])])
        return [self._emit("Mul", [o, self._emit("Tanh", [cell])]), cell]


def _shapes_of(model: Any) -> dict[str, list[Any]]:
    """Infer the shapes of a model's values, by name; "n" is the number of pullers."""
    from onnx import shape_inference

    del model.graph.value_info[:]
    for value in model.graph.output:
        value.type.tensor_type.ClearField("shape")
    known = shape_inference.infer_shapes(model, data_prop=True).graph
    return {
        value.name: [dim.dim_value or "n" for dim in value.type.tensor_type.shape.dim]
        for value in (*known.input, *known.value_info, *known.output)
        if value.type.tensor_type.HasField("shape")
    }


def _lengths(operator: str, parts: list[list[Any]]) -> list[Any]:
    """Compute an operator on lengths, each a list; GraphError where the number of pullers would decide."""
    if operator == "Concat":
        return [dim for part in parts for dim in part]
    if operator in ("Unsqueeze", "Squeeze", "Cast", "Identity", "Reshape"):
        return parts[0]
    if operator == "Slice":
        return parts[0][int(parts[1][0]) : int(parts[2][0])]
    if operator in ("Equal", "Where"):
        columns = zip(*(part * max(map(len, parts)) if len(part) == 1 else part for part in parts), strict=True)
        return [column[0] == column[1] if operator == "Equal" else column[1 if column[0] else 2] for column in columns]
    return [_length_of(operator, parts)]


def _length_of(operator: str, parts: list[list[Any]]) -> Any:
    """Compute with two single lengths; the number of pullers, "n", may be multiplied by one alone."""
    if operator not in ARITHMETIC or any(len(part) != 1 for part in parts):
        raise GraphError(f"computes with the number of pullers, in {operator}")
    (a,), (b,) = parts
    if "n" not in (a, b):
        return ARITHMETIC[operator](a, b)
    if operator != "Mul" or 1 not in (a, b):
        raise GraphError("computes with the number of pullers")
    return "n"


def _some_inputs(graph: Any) -> dict[str, Any]:
    """Draw values for the inputs of a graph, by name; three pullers where their number is open."""
    random, weights = np.random.default_rng(0), {each.name for each in graph.initializer}
    inputs = [value for value in graph.input if value.name not in weights]
    shapes = [[dim.dim_value or 3 for dim in value.type.tensor_type.shape.dim] for value in inputs]
    wide = [value.type.tensor_type.elem_type == 11 for value in inputs]
    return {
        value.name: random.normal(size=shape).astype(np.float64 if big else np.float32)
        for value, shape, big in zip(inputs, shapes, wide, strict=True)
    }


def _joined(parts: list[Any]) -> list[Any]:
    """Return the first part, and the others as columns of one array if there are any."""
    return [parts[0], *([np.concatenate(parts[1:], axis=1)] if parts[1:] else [])]


def _compare(before: Any, after: Any, places: list[list[int]]) -> None:
    """GraphError unless both models give the same actions and states for some observations; ``places`` are the axes of
    pullers in inputs and outputs.
    """
    from onnx.reference import ReferenceEvaluator

    def by_puller(values: Any, axes: list[int]) -> list[Any]:
        moved = [np.moveaxis(np.asarray(each), axis, 0) for each, axis in zip(values, axes, strict=True)]
        return _joined([each.reshape(len(each), -1).astype(np.float32) for each in moved])

    inputs = _some_inputs(before.graph)
    wanted = by_puller(ReferenceEvaluator(before).run(None, inputs), places[1])
    given = dict(zip(INPUTS, by_puller(inputs.values(), places[0]), strict=False))
    for one, other in zip(wanted, ReferenceEvaluator(after).run(None, given), strict=True):
        if one.shape != other.shape or not np.allclose(one, other, rtol=1e-3, atol=1e-4):
            raise GraphError("would act otherwise once it is rebuilt: give a simpler network")


def _free_rows(value: Any) -> None:
    """Let an input have any number of rows: its first axis, or the second one of a state (1, n, width)."""
    dims = value.type.tensor_type.shape.dim
    if not len(dims) or value.type.tensor_type.elem_type not in (1, 11):
        raise GraphError(f"its input {value.name!r:.60} is not of rows of numbers")
    open_ones = [place for place, dim in enumerate(dims) if not dim.HasField("dim_value")]
    longer = [place for place, dim in enumerate(dims[:-1]) if dim.dim_value != 1]
    at = (open_ones or (longer if len(dims) > 2 else []) or [min(len(dims) - 2, 1)])[0]
    for place, dim in enumerate(dims):
        if place == max(at, 0):
            dim.Clear()
            dim.dim_param = "n"
        elif not dim.HasField("dim_value"):
            dim.Clear()
            dim.dim_value = 1


def _power(graph: _Rebuilt, x: str, values: list[Any], attributes: dict[str, Any], width: int) -> str:
    exponent = float(np.asarray(values[0]).ravel()[0]) if not isinstance(values[0], str) else 0.0
    if exponent == 2.0:
        return graph._emit("Mul", [x, x])
    if exponent == 0.5:
        return graph._emit("Sqrt", [x])
    raise GraphError("its Pow is neither a square nor a root")


def _mean(graph: _Rebuilt, x: str, values: list[Any], attributes: dict[str, Any], width: int) -> str:
    return graph._emit("MatMul", [x, np.full((width, 1), 1.0 / width)])


def _sum(graph: _Rebuilt, x: str, values: list[Any], attributes: dict[str, Any], width: int) -> str:
    return graph._emit("MatMul", [x, np.ones((width, 1))])


def _gelu(graph: _Rebuilt, x: str, values: list[Any], attributes: dict[str, Any], width: int) -> str:
    if attributes.get("approximate", b"none") != b"none":
        raise GraphError("its Gelu is an approximate one")
    risen = graph._emit("Add", [graph._emit("Erf", [graph._emit("Mul", [x, np.sqrt(0.5)])]), np.array(1.0)])
    return graph._emit("Mul", [graph._emit("Mul", [x, np.array(0.5)]), risen])


def _normalised(graph: _Rebuilt, x: str, values: list[Any], attributes: dict[str, Any], width: int) -> str:
    scale, bias, mean, variance = values
    gain = scale / np.sqrt(variance + attributes.get("epsilon", 1e-5))
    return graph._emit("Add", [graph._emit("Mul", [x, gain]), bias - mean * gain])


def _swish(graph: _Rebuilt, x: str, values: list[Any], attributes: dict[str, Any], width: int) -> str:
    inner = graph._emit("Mul", [x, np.array(attributes.get("alpha", 1.0))])
    return graph._emit("Mul", [x, graph._emit("Sigmoid", [inner])])


def _limit(graph: _Rebuilt, x: str, values: list[Any], lower: bool) -> str:
    if isinstance(values[0], str) or np.size(values[0]) != 1:
        raise GraphError("its Min or Max compares with more than a number")
    limit = np.asarray(values[0]).reshape(())
    return graph._emit("Clip", [x, limit] if lower else [x, "", limit])


_OTHERS: dict[str, Any] = {
    "Pow": _power,
    "ReduceMean": _mean,
    "ReduceSum": _sum,
    "Gelu": _gelu,
    "BatchNormalization": _normalised,
    "Swish": _swish,
    "Max": lambda graph, x, values, attributes, width: _limit(graph, x, values, True),
    "Min": lambda graph, x, values, attributes, width: _limit(graph, x, values, False),
}
"""Operators that agents do not have, in those that they have."""
