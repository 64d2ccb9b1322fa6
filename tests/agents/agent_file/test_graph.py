"""Agents' graphs: what may run, and that hostile ones are refused before anything large or foreign happens."""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from cz_gym.agents import AgentFileError, OnnxPolicy, shipped
from cz_gym.agents.agent_file.contract import make_contract, read_agent
from cz_gym.agents.agent_file.graph import MAX_ACTIVATIONS, MAX_NODES, OPERATORS, GraphError, checked
from cz_gym.config import make_config
from cz_gym.observation import MEASURED
from tests import contracts
from tests.contracts import LINEAR, facts, graph_of, value
from tests.processes import python

CHANNELS = len(MEASURED)
WEIGHTS = {"weight": np.full((CHANNELS, 2), 0.01, np.float32), "bias": np.zeros(2, np.float32)}


def model_of(nodes: list[Any] | None = None, weights: dict[str, Any] | None = None, **changes: Any) -> Any:
    return contracts.model_of(
        [LINEAR] if nodes is None else nodes, WEIGHTS if weights is None else weights, CHANNELS, **changes
    )


def policy_of(model: Any) -> OnnxPolicy:
    config = make_config()
    content = model if isinstance(model, bytes) else model.SerializeToString()
    return OnnxPolicy.of(make_contract(content, **facts("measured", channels=CHANNELS)), content, config)


@pytest.mark.parametrize("name", ["gradient", "ppo"])
def test_the_shipped_agent_is_run_as_it_is_stored(name: str) -> None:
    contract, content = read_agent(shipped(name))
    clean, state = checked(content, contract.channels)
    assert (state > 0) == (name == "gradient")
    ours, theirs = onnx.load_from_string(clean).graph, onnx.load_from_string(content).graph
    assert [*ours.node] == [*theirs.node]
    for one, two in zip(ours.initializer, theirs.initializer, strict=True):
        np.testing.assert_array_equal(numpy_helper.to_array(one), numpy_helper.to_array(two))


def test_an_agent_with_a_memory_begins_each_episode_at_zero() -> None:
    """A counter: state + 1 each step, shown as the action."""
    nodes = [
        helper.make_node("Add", ["state", "one"], ["next_state"]),
        helper.make_node("MatMul", ["observation", "nothing"], ["still"]),
        helper.make_node("Add", ["still", "next_state"], ["action"]),
    ]
    weights = {"one": np.float32([[0.25, 0.5]]), "nothing": np.zeros((CHANNELS, 2), np.float32)}
    both = {
        "inputs": [value("observation", "n", CHANNELS), value("state", "n", 2)],
        "outputs": [value("action", "n", 2), value("next_state", "n", 2)],
    }
    policy = policy_of(model_of(nodes, weights, **both))
    assert policy.remembers == 2
    seen, state = np.zeros((3, CHANNELS), np.float32), None
    for begins in ([True] * 3, [0, 0, 0], [0.0, 1.0, 0.0]):
        action, state = policy.predict(seen, state, episode_start=np.array(begins))
    np.testing.assert_array_equal(action[:, 0], [0.75, 0.25, 0.75])
    one, state = policy.predict(seen[0])
    assert (one.shape, state.shape) == ((2,), (2,))
    assert policy.predict(seen[0], state)[0][0] == 0.5


def loop() -> Any:
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"]), helper.make_node("Identity", ["x"], ["y"])],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            value("x", "n", 2),
        ],
        [helper.make_tensor_value_info("on", TensorProto.BOOL, []), value("y", "n", 2)],
    )
    return helper.make_node("Loop", ["", "", "a"], ["action"], body=body)


def branch() -> Any:
    node = helper.make_node("Identity", ["observation"], ["action"])
    node.attribute.append(helper.make_attribute("then_branch", graph_of([LINEAR], WEIGHTS, CHANNELS)))
    return model_of([node])


def external(location: str) -> Any:
    model = model_of()
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, text in (("location", location), ("offset", "0"), ("length", "88")):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, text
    return model


def changed(change: Callable[[Any], Any]) -> Any:
    model = model_of()
    change(model)
    return model


def deep(nodes: int, width: int) -> Any:
    weights = {"first": np.ones((CHANNELS, width), np.float32), "one": np.ones(1, np.float32)}
    chain = [helper.make_node("MatMul", ["observation", "first"], ["x0"])]
    chain += [helper.make_node("Mul", [f"x{i}", "one"], [f"x{i + 1}"]) for i in range(nodes)]
    last = {"last": np.ones((width, 2), np.float32)}
    return model_of([*chain, helper.make_node("MatMul", [f"x{nodes}", "last"], ["action"])], weights | last)


def broadcast_bomb() -> Any:
    weights = {name: np.zeros((1000,) + (1,) * (i + 2), np.float32) for i, name in enumerate("abc")} | WEIGHTS
    names = ["observation", "x", "y", "z"]
    nodes = [helper.make_node("Add", [names[i], "abc"[i]], [names[i + 1]]) for i in range(3)]
    return model_of([*nodes, LINEAR], weights)


def honest_shape(model: Any, dims: list[int]) -> None:
    del model.graph.initializer[0].dims[:]
    model.graph.initializer[0].dims.extend(dims)


HOSTILE = {
    "external weights": (lambda: external("../../../etc/passwd"), "another file"),
    "endless loop": (lambda: model_of([helper.make_node("Gemm", ["observation", "weight"], ["a"]), loop()]), "'Loop'"),
    "branch in an attribute": (branch, "an attribute that is not a number"),
    "tensor made of a shape": (
        lambda: model_of([helper.make_node("ConstantOfShape", ["big"], ["action"])], {"big": np.int64([10**6, 10**6])}),
        "'ConstantOfShape'",
    ),
    "scripted operator": (
        lambda: model_of([helper.make_node("PyOp", ["observation"], ["action"], domain="ai.onnx.contrib")]),
        "'ai.onnx.contrib:PyOp'",
    ),
    "foreign operators": (
        lambda: changed(lambda model: model.opset_import.append(helper.make_opsetid("com.microsoft", 1))),
        "beyond the standard",
    ),
    "future operators": (lambda: model_of(opset=99), "version 99"),
    "function": (
        lambda: changed(
            lambda model: model.functions.append(
                helper.make_function("", "Gemm", ["x"], ["y"], [], [helper.make_opsetid("", 17)])
            )
        ),
        "more than a graph",
    ),
    "training": (lambda: changed(lambda model: model.training_info.add()), "more than a graph"),
    "broadcast bomb": (broadcast_bomb, "more than 3 axes"),
    "broadcast over pullers": (
        lambda: model_of(
            [
                helper.make_node("Add", ["observation", "five"], ["x"]),
                helper.make_node("MatMul", ["five", "w"], ["y"]),
                helper.make_node("Gemm", ["observation", "w"], ["action"]),
            ],
            {"five": np.zeros((5, 1, CHANNELS), np.float32), "w": np.ones((CHANNELS, 2), np.float32)},
        ),
        "row of known length",
    ),
    "deep graph": (lambda: deep(MAX_NODES, 2), f"{MAX_NODES + 2} nodes"),
    "wide graph": (lambda: deep(8, MAX_ACTIVATIONS // 8), "for each puller"),
    "weights used again and again": (
        lambda: model_of(
            [
                helper.make_node("Gemm", [f"x{i}" if i else "observation", "w"], [f"x{i + 1}"])
                for i in range(MAX_NODES - 1)
            ]
            + [LINEAR],
            {**WEIGHTS, "w": np.ones((CHANNELS, 900 * CHANNELS), np.float32)},
        ),
        "more than 1000000 weights",
    ),
    "shape of more numbers than stored": (
        lambda: changed(lambda model: honest_shape(model, [10**5, 10])), "more or fewer numbers"),
    "shape bomb": (lambda: changed(lambda model: honest_shape(model, [2**40, 2**40])), "1000000 numbers"),
    "negative shape": (lambda: changed(lambda model: honest_shape(model, [-1, -22])), "1000000 numbers"),
    "NaN weights": (lambda: model_of(weights={**WEIGHTS, "bias": np.float32([np.nan, 0])}), "not finite"),
    "double precision": (lambda: model_of(weights={**WEIGHTS, "bias": np.zeros(2)}), "neither float32 nor int64"),
    "two inputs": (
        lambda: model_of(inputs=[value("observation", "n", CHANNELS), value("truth", "n", 17)]),
        "must map observation",
    ),
    "too narrow": (lambda: model_of(inputs=[value("observation", "n", CHANNELS - 1)]), "must map observation"),
    "fixed number of pullers": (lambda: model_of(inputs=[value("observation", 1, CHANNELS)]), "must map observation"),
    "constant action": (
        lambda: model_of([helper.make_node("Identity", ["a"], ["action"])], {"a": np.zeros((2, 2), np.float32)}),
        "do not depend",
    ),
    "rows of others": (
        lambda: model_of(
            [
                helper.make_node("Gather", ["observation", "first"], ["x"], axis=0),
                helper.make_node("Add", ["observation", "x"], ["y"]),
                helper.make_node("MatMul", ["y", "weight"], ["action"]),
            ],
            {**WEIGHTS, "first": np.int64([0])},
        ),
        "row of known length",
    ),
    "products of others": (
        lambda: model_of(
            [
                helper.make_node("Gemm", ["observation", "observation"], ["x"], transA=1),
                helper.make_node("MatMul", ["observation", "x"], ["y"]),
                helper.make_node("MatMul", ["y", "weight"], ["action"]),
            ]
        ),
        "may mix the rows",
    ),
    "two pullers read as two numbers": (
        lambda: model_of(
            [
                helper.make_node("Gemm", ["observation", "weight", "bias"], ["linear"]),
                helper.make_node("Gather", ["linear", "both"], ["pairs"], axis=1),
                helper.make_node("Add", ["pairs", "linear"], ["x"]),
                helper.make_node("Gather", ["x", "first"], ["action"], axis=1),
            ],
            {**WEIGHTS, "both": np.int64([[0, 1], [0, 1]]), "first": np.int64(0)},
        ),
        "may mix the rows",
    ),
    "cycle": (lambda: model_of([helper.make_node("Add", ["action", "action"], ["action"])]), "not a sound"),
    "unknown attribute": (
        lambda: changed(lambda model: model.graph.node[0].attribute.append(helper.make_attribute("path", 1))),
        "not a sound",
    ),
    "no nodes": (lambda: model_of([]), "0 nodes"),
    "nothing": (lambda: b"", "not a sound"),
    "pickle": (lambda: b"\x80\x04c__builtin__\nexec\n.", "not a sound"),
    "many empty nodes": (lambda: OPSET + field(b"\x3a", b"\x0a\x00" * 1_900_000), "1900000 nodes"),
    "many empty weights": (lambda: OPSET + field(b"\x3a", b"\x0a\x00" + b"\x2a\x00" * 1_900_000), "1 nodes"),
    "nested messages": (lambda: nested(), "not a sound"),
}  # fmt: skip


OPSET = b"\x42\x02\x10\x11"
"""A model's first bytes: standard operators, version 17."""


def field(tag: bytes, content: bytes) -> bytes:
    """A part of a message, in the ONNX format's encoding."""
    length, size = b"", len(content)
    while size > 127:
        length += bytes([size % 128 | 128])
        size //= 128
    return tag + length + bytes([size]) + content


def nested() -> bytes:
    """Graphs in attributes in nodes in graphs, 1200 deep."""
    content = b""
    for tag in (b"\x3a", b"\x0a", b"\x2a", b"\x32") * 300:
        content = field(tag, content)
    return content


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_graphs_are_refused_with_the_reason(name: str) -> None:
    make, reason = HOSTILE[name]
    with pytest.raises(AgentFileError) as caught:
        policy_of(make())
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.skipif(sys.platform != "linux", reason="limits and measures memory as Linux does")
def test_hostile_graphs_stay_within_a_small_memory() -> None:
    """All of them in one process that may not have a gigabyte beyond what importing takes."""
    code = (
        "import resource, sys\n"
        "import onnxruntime, onnx.checker\n"
        "sys.path[:0] = ['.', 'tests/agents/agent_file']\n"
        "import test_graph as t\n"
        "t.policy_of(t.model_of())\n"
        "now = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (now + 2**29,) * 2)\n"
        "resource.setrlimit(resource.RLIMIT_CPU, (60, 60))\n"
        "for name, (make, reason) in t.HOSTILE.items():\n"
        "    try: t.policy_of(make())\n"
        "    except t.AgentFileError: continue\n"
        "    sys.exit(name)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
    )
    python("-c", code)


def test_every_operator_is_a_standard_one_without_control_flow() -> None:
    for name in OPERATORS:
        schema = onnx.defs.get_schema(name, 17)
        assert not any("GRAPH" in str(attribute.type) for attribute in schema.attributes.values())


def test_what_nobody_reads_is_not_handed_on() -> None:
    model = model_of()
    model.metadata_props.add(key="note", value="x" * 1000)
    model.graph.doc_string = "y" * 1000
    clean, _ = checked(model.SerializeToString(), CHANNELS)
    assert b"xxx" not in clean
    assert b"yyy" not in clean
    with pytest.raises(GraphError):
        checked(b"garbage", CHANNELS)
