"""A recorded program as an ONNX graph in double precision: a loop over the samples of a call.

Inputs and settings have their names and shape [1]; settings have defaults. ``memory`` is one array, by default that
before the first sample; ``next_memory`` is given to the next call.
"""

from typing import Any

import numpy as np

from cz_gym.errors import CzError

from .program import PASSES, Program
from .trace import FINITE, FUNCTIONS, Ids, Node

OPSET, IR = 18, 9
"""Versions of the operators and of the file; onnxruntime 1.18 reads them."""
OPERATORS = {
    "add": "Add", "subtract": "Sub", "multiply": "Mul", "divide": "Div", "negative": "Neg", "absolute": "Abs",
    "sqrt": "Sqrt", "exp": "Exp", "log": "Log", "sin": "Sin", "cos": "Cos", "tanh": "Tanh", "minimum": "Min",
    "maximum": "Max", "less": "Less", "less_equal": "LessOrEqual", "equal": "Equal", "and": "And", "or": "Or",
    "not": "Not", "select": "Where",
}  # fmt: skip
"""Operators of the functions; "finite" and "real" are written out."""


class GraphWriter:
    """The nodes and constants of a graph."""

    def __init__(self, program: Program) -> None:
        self.graph, self.nodes, self.constants = program.graph, list[Any](), dict[Any, Any]()
        self.cells = {cell.name for cell in program.memory}
        self.add("Split", "before", self.constant(np.array([cell.start.size for cell in program.memory])),
                 results=[f"before_{cell.name}" for cell in program.memory], axis=0)  # fmt: skip
        for node in program.nodes:
            self._write(node, [self.argument(ids, node.op in FUNCTIONS) for ids in node.args], self._name(node))
        after = self.add("Concat", *(self.argument(cell.after) for cell in program.memory), axis=0)
        self.add("Reshape", self.argument(program.again), self.constant(np.zeros(0, np.int64)), results=["again"])
        self.add("Where", self.argument(program.due), after, "before", results=["after"])
        for port, ids in program.outputs:
            self.add("Identity", self.argument(ids), results=[f"now_{port.name}"])

    def add(self, operator: str, *args: str, results: Any = (), **attributes: Any) -> str:
        """Add a node; returns the name of its result."""
        from onnx import helper

        results = results or [f"t{len(self.nodes)}"]
        self.nodes.append(helper.make_node(operator, args, results, **attributes))
        name: str = results[0]
        return name

    def constant(self, value: Any) -> str:
        """Name of a constant."""
        from onnx import numpy_helper

        key = value.tobytes(), value.dtype.char, value.shape
        if key not in self.constants:
            self.constants[key] = numpy_helper.from_array(value, f"c{len(self.constants)}")
        name: str = self.constants[key].name
        return name

    def argument(self, ids: Ids, each: bool = False) -> str:
        """Name of an array with these elements; equal constants are one number if the operation is on ``each``."""
        known = self.graph.values(ids)
        if known is not None:
            flat = known.ravel()
            return self.constant(flat[:1] if each and (flat == flat[0]).all() else flat)
        owners = [self.graph.nodes[at] for at in np.unique(self.graph.owners(ids))]
        names = [self.constant(node.data) if node.op == "constant" else self._name(node) for node in owners]
        source = names[0] if len(names) == 1 else self.add("Concat", *names, axis=0)
        whole = np.concatenate([node.start + np.arange(node.size) for node in owners])  # in order, as the nodes are
        at = np.searchsorted(whole, ids)
        return source if np.array_equal(whole, ids) else self.add("Gather", source, self.constant(at), axis=0)

    def _name(self, node: Node) -> str:
        name: str = node.data if node.op == "input" else f"n{node.start}"
        return f"before_{name}" if name in self.cells else name

    def _write(self, node: Node, args: list[str], result: str) -> None:
        if node.op == "select" and node.logical:  # Where takes no logical values
            parts = self.add("And", *args[:2]), self.add("And", self.add("Not", args[0]), args[2])
            self.add("Or", *parts, results=[result])
        elif node.op in OPERATORS:
            self.add(OPERATORS[node.op], *args, results=[result])
        elif node.op == "finite":
            self.add("LessOrEqual", self.add("Abs", *args), self.constant(np.array([FINITE])), results=[result])
        elif node.op == "real":
            self.add("Cast", *args, results=[result], to=11)
        elif node.op == "matmul":
            m, k, n = node.data
            shapes = (np.array([m, k]), np.array([k, n]))
            factors = [self.add("Reshape", a, self.constant(shape)) for a, shape in zip(args, shapes, strict=True)]
            self.add("Reshape", self.add("MatMul", *factors), self.constant(np.array([-1])), results=[result])
        elif node.op == "argmax":
            self.add("Cast", self.add("ArgMax", *args, axis=0), results=[result], to=11)
        elif node.op == "pick":
            self.add("Gather", args[0], self.add("Cast", args[1], to=7), results=[result], axis=0)


def write_onnx(program: Program, single: bool = False) -> dict[str, bytes]:
    """The graph, by file name; CzError for single precision."""
    from onnx import checker, helper, numpy_helper

    if single:
        raise CzError("an ONNX graph is in double precision: leave out --real float")

    def numbers(name: str, size: int = 1) -> Any:
        return helper.make_tensor_value_info(name, 11, [size])

    writer, start = GraphWriter(program), np.concatenate([cell.start for cell in program.memory])
    defaults = {port.name: np.array([port.default]) for port in program.settings} | {"memory": start}
    given = [*map(numbers, (port.name for port in (*program.inputs, *program.settings))), numbers("memory", start.size)]
    shown = [port.name for port, _ in program.outputs]
    flags = [helper.make_tensor_value_info(name, 9, []) for name in ("go", "again")]
    own = [helper.make_tensor_value_info("sample", 7, []), flags[0], numbers("before", start.size)]
    carried = [flags[1], numbers("after", start.size), *(numbers(f"now_{name}") for name in shown)]
    own += [numbers(f"last_{name}") for name in shown]
    body = helper.make_graph(writer.nodes, "sample", own, carried, [*writer.constants.values()])
    defaults |= {"samples": np.array(PASSES, np.int64), "first": np.array(True), "none": np.zeros(1)}
    constants = [numpy_helper.from_array(value, name) for name, value in defaults.items()]
    results = [numbers("next_memory", start.size), *(numbers(name) for name in shown)]
    begin = ["samples", "first", "memory", *["none"] * len(shown)]
    loop = helper.make_node("Loop", begin, [each.name for each in results], body=body)
    graph = helper.make_graph([loop], program.name, given, results, constants, "\n".join(program.notes))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    checker.check_model(model)
    return {f"cz_{program.name}.onnx": model.SerializeToString()}
