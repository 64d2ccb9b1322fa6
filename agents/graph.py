"""The check of an agent's ONNX graph: a small feed-forward network, optionally with a state, and nothing else.

The graph is checked here before onnxruntime sees it, and onnxruntime gets a graph rebuilt from the checked parts. Every
bound is known before anything is computed: no operator loops, branches, reads other files or makes a tensor larger than
its inputs say, and a puller's action depends on that puller's row alone.
"""

from typing import Any

import numpy as np

from cz_gym.support.errors import CzError

OPERATORS = (
    "Abs", "Add", "Celu", "Clip", "Concat", "Div", "Elu", "Erf", "Gather", "Gemm", "HardSigmoid", "HardSwish",
    "Identity", "LayerNormalization", "LeakyRelu", "MatMul", "Mul", "Neg", "PRelu", "Relu", "Selu", "Sigmoid", "Slice",
    "Softplus", "Split", "Sqrt", "Sub", "Tanh",
)  # fmt: skip
"""Operators an agent may use, of the standard ONNX domain."""
DOMAINS = "", "ai.onnx"
"""Names of the standard operators' domain."""
OPSETS = range(13, 22)
"""Versions of the standard operators that an agent may use."""
INPUTS, OUTPUTS = ("observation", "state"), ("action", "next_state")
"""Names of a graph's inputs and outputs; the second of each only with a memory."""
MAX_NODES = 256
MAX_PARAMETERS = 1_000_000
"""Largest number of weights, each counted as often as it is used."""
MAX_ACTIVATIONS = 32_768
"""Largest number of results for a puller's row, over all nodes."""
MAX_RANK = 3


class GraphError(CzError):
    """A graph that no agent may have; the message says why."""


def check_graph(onnx_bytes: bytes, channels: int) -> tuple[bytes, int]:
    """Check an ONNX file; returns its graph, rebuilt, and the length of its state (0: none).

    Raises GraphError, and ImportError where onnx is not installed.
    """
    import onnx
    from google.protobuf.message import Error as ProtobufError

    model = onnx.ModelProto()
    try:
        model.ParseFromString(onnx_bytes)
        _check_model(model)
        graph, state = _clean(model.graph, channels)
        opset = onnx.helper.make_opsetid("", model.opset_import[0].version)
        clean = onnx.helper.make_model(graph, opset_imports=[opset], ir_version=min(model.ir_version, 9))
        onnx.checker.check_model(clean)
        known = onnx.shape_inference.infer_shapes(clean, check_type=True, strict_mode=True, data_prop=True)
        _check_shapes(known.graph)
        return clean.SerializeToString(), state
    except GraphError:
        raise
    except (ProtobufError, onnx.checker.ValidationError, onnx.shape_inference.InferenceError,
            ValueError, TypeError, RuntimeError, OverflowError):  # fmt: skip
        raise GraphError("not a sound ONNX model") from None


def _check_model(model: Any) -> None:
    """Refuse everything except one graph of plain nodes, before any of its contents are used."""
    graph = model.graph
    if not len(model.opset_import):
        raise GraphError("not a sound ONNX model")
    if len(model.opset_import) != 1 or model.opset_import[0].domain not in DOMAINS:
        raise GraphError("uses operators beyond the standard ONNX ones")
    if model.opset_import[0].version not in OPSETS:
        version = model.opset_import[0].version
        raise GraphError(f"uses version {version} of ONNX's operators, not {OPSETS[0]} to {OPSETS[-1]}")
    if len(model.functions) or len(model.training_info) or len(graph.sparse_initializer):
        raise GraphError("holds more than a graph and its weights")
    if not 0 < len(graph.node) <= MAX_NODES or len(graph.initializer) > 4 * MAX_NODES:
        raise GraphError(
            f"has {len(graph.node)} nodes and {len(graph.initializer)} weights, not 1 to {MAX_NODES} nodes"
        )


def _clean(graph: Any, channels: int) -> tuple[Any, int]:
    """Rebuild the graph from its nodes, weights, inputs and outputs; returns it and its state's length."""
    from onnx import TensorProto, helper, numpy_helper

    nodes = [_node(node) for node in graph.node]
    weights = {tensor.name: _array(tensor) for tensor in graph.initializer}
    uses = [weights[name].size for node in graph.node for name in node.input if name in weights]
    if sum(uses) > MAX_PARAMETERS:
        raise GraphError(f"computes with more than {MAX_PARAMETERS} weights")
    length = _width(graph.input[1]) if len(graph.input) == len(graph.output) == 2 else 0
    state = length if 0 < length <= MAX_ACTIVATIONS else 0

    def values(given: Any, names: tuple[str, str], sizes: tuple[int, int]) -> list[Any]:
        widths = {name: size for name, size in zip(names, sizes, strict=True) if size}
        if [(value.name, _width(value)) for value in given] != list(widths.items()):
            raise GraphError(f"must map observation (n, {channels}) to action (n, 2), and a state to one like it")
        return [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", w]) for name, w in widths.items()]

    inputs, outputs = values(graph.input, INPUTS, (channels, state)), values(graph.output, OUTPUTS, (2, state))
    tensors = [numpy_helper.from_array(array, name) for name, array in weights.items()]
    return helper.make_graph(nodes, "cz_gym_agent", inputs, outputs, tensors), state


def _array(tensor: Any) -> Any:
    from onnx import numpy_helper

    types = {tensor.FLOAT: np.float32, tensor.INT64: np.int64}
    if tensor.data_location != tensor.DEFAULT or len(tensor.external_data):
        raise GraphError("keeps weights in another file")
    if tensor.data_type not in types:
        raise GraphError("has weights that are neither float32 nor int64")
    size = 1
    for length in tensor.dims[: MAX_RANK + 1]:
        size *= max(int(length), 0)
    if len(tensor.dims) > MAX_RANK or size > MAX_PARAMETERS or any(length < 0 for length in tensor.dims):
        raise GraphError(f"has a weight of more than {MAX_RANK} axes or {MAX_PARAMETERS} numbers")
    stored = len(tensor.raw_data) // np.dtype(types[tensor.data_type]).itemsize
    if size != (stored or len(tensor.float_data) or len(tensor.int64_data)):
        raise GraphError("has a weight with more or fewer numbers than its shape")
    array = np.array(numpy_helper.to_array(tensor), types[tensor.data_type])
    if not np.isfinite(array).all():
        raise GraphError("has weights that are not finite")
    return array


def _node(node: Any) -> Any:
    """A node rebuilt from its operator, names and numbers; GraphError for one that no agent may have."""
    from onnx import helper

    if node.domain not in DOMAINS or node.op_type not in OPERATORS:
        name = f"{node.domain}:{node.op_type}" if node.domain else node.op_type
        raise GraphError(f"uses the operator {name!r:.60}; allowed: {', '.join(OPERATORS)}")
    if len(node.input) > MAX_NODES or len(node.output) > MAX_NODES:
        raise GraphError(f"joins more than {MAX_NODES} tensors in one node")
    for attribute in node.attribute:
        plain = (attribute.INT, attribute.FLOAT, attribute.INTS, attribute.FLOATS)
        if attribute.type not in plain or attribute.ref_attr_name:
            raise GraphError(f"gives {node.op_type} an attribute that is not a number")
    numbers = {attribute.name: helper.get_attribute_value(attribute) for attribute in node.attribute}
    if len(numbers) != len(node.attribute):
        raise GraphError(f"gives {node.op_type} an attribute twice")
    return helper.make_node(node.op_type, list(node.input), list(node.output), **numbers)


def _width(value: Any) -> int:
    """Width k of a float32 value of shape (n, k) with open n; 0 for any other value."""
    tensor = value.type.tensor_type
    dims = [*tensor.shape.dim]
    floats = value.type.HasField("tensor_type") and tensor.elem_type == 1
    if not floats or len(dims) != 2 or dims[0].HasField("dim_value") or not dims[1].HasField("dim_value"):
        return 0
    return int(dims[1].dim_value)


def _check_shapes(graph: Any) -> None:
    """Refuse a graph whose results have unknown or large shapes, or that may mix the rows of different pullers."""
    shapes = {
        value.name: [dim.dim_param or dim.dim_value for dim in value.type.tensor_type.shape.dim]
        for value in (*graph.input, *graph.value_info, *graph.output)
    }
    rows, total = {value.name for value in graph.input}, 0
    for node in graph.node:
        given = [name for name in node.input if name in rows]
        if _mixes_rows(node, given, shapes):
            raise GraphError(f"its {node.op_type} may mix the rows of different pullers")
        for name in filter(None, node.output):
            numbers = _numbers(shapes.get(name, []), bool(given))
            if not numbers:
                raise GraphError(f"its {node.op_type} does not give each puller a row of known length")
            total += numbers
            rows |= {name} if given else set()
    if total > MAX_ACTIVATIONS:
        raise GraphError(f"makes more than {MAX_ACTIVATIONS} numbers for each puller")
    if not {value.name for value in graph.output} <= rows:
        raise GraphError("its outputs do not depend on its inputs")


def _numbers(dims: list[Any], per_row: bool) -> int:
    """Numbers of a result of this shape, of a row where it has rows; 0 for a shape that is not known or not allowed."""
    widths = dims[1:] if per_row else dims
    known = len(dims) <= MAX_RANK and all(isinstance(width, int) and width > 0 for width in widths)
    return int(np.prod(widths, dtype=object)) if known and (not per_row or dims[:1] == ["n"]) else 0


def _mixes_rows(node: Any, given: list[str], shapes: dict[str, list[Any]]) -> bool:
    """Tell a node whose axis of pullers may meet another one; ``given`` are its inputs with such an axis."""
    ranks = {len(shapes[name]) for name in given}
    product = node.op_type in ("MatMul", "Gemm") and node.input[1] in given and ranks == {2}
    axis = next((each.i for each in node.attribute if each.name == "axis"), -1)
    normalised = node.op_type == "LayerNormalization" and (axis != -1 or len(node.output) > 1)
    return len(ranks) > 1 or product or normalised
