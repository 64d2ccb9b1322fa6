"""Agents' graphs: what may run, and that hostile ones are refused before anything large or foreign happens."""

import json
import sys

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper, parser

from cz_gym.agents import AgentFileError, OnnxPolicy, shipped
from cz_gym.agents.contract import make_contract, read_agent
from cz_gym.agents.graph import MAX_ACTIVATIONS, MAX_NODES, OPERATORS, check_graph
from cz_gym.config import make_config
from cz_gym.spaces import MEASURED
from cz_gym.support.errors import CzError
from tests import contracts
from tests.conftest import python
from tests.contracts import LINEAR, facts, graph_of, value

CHANNELS = len(MEASURED)
WEIGHTS = {"weight": np.full((CHANNELS, 2), 0.01, np.float32), "bias": np.zeros(2, np.float32)}


def model_of(nodes=(LINEAR,), weights=WEIGHTS, **changes):
    return contracts.model_of([*nodes], weights, CHANNELS, **changes)


def policy_of(model):
    config = make_config()
    content = model if isinstance(model, bytes) else model.SerializeToString()
    return OnnxPolicy.of(make_contract(content, **facts("measured", channels=CHANNELS)), content, config)


@pytest.mark.parametrize("name", ["gradient", "ppo", "ppo-plain"])
def test_the_shipped_agent_is_run_as_it_is_stored(name):
    contract, content = read_agent(shipped(name))
    clean, state = check_graph(content, contract.channels)
    assert state > 0
    ours, theirs = onnx.load_from_string(clean).graph, onnx.load_from_string(content).graph
    for node in theirs.node:
        node.ClearField("name")
    assert [*ours.node] == [*theirs.node]
    for one, two in zip(ours.initializer, theirs.initializer, strict=True):
        np.testing.assert_array_equal(numpy_helper.to_array(one), numpy_helper.to_array(two))


def nodes_of(text):
    """Nodes in ONNX's text format."""
    return list(parser.parse_graph(f"graph (float[n] observation) => (float[n] action) {{ {text} }}").node)


def written(text, **weights):
    """A model of these nodes."""
    return model_of(nodes_of(text), {**WEIGHTS, **weights})


def test_an_agent_with_a_memory_begins_each_episode_at_zero():
    """A counter: state + 1 each step, shown as the action."""
    nodes = nodes_of("next_state = Add(state, one) still = MatMul(observation, zero) action = Add(still, next_state)")
    weights = {"one": np.float32([[0.25, 0.5]]), "zero": np.zeros((CHANNELS, 2), np.float32)}
    both = {
        "inputs": [value("observation", "n", CHANNELS), value("state", "n", 2)],
        "outputs": [value("action", "n", 2), value("next_state", "n", 2)],
    }
    policy = policy_of(model_of(nodes, weights, **both))
    assert policy.memory_length == 2
    seen, state = np.zeros((3, CHANNELS), np.float32), None
    for begins in ([True] * 3, [0, 0, 0], [0.0, 1.0, 0.0]):
        action, state = policy.predict(seen, state, episode_start=np.array(begins))
    np.testing.assert_array_equal(action[:, 0], [0.75, 0.25, 0.75])
    one, state = policy.predict(seen[0])
    assert (one.shape, state.shape) == ((2,), (2,))
    assert policy.predict(seen[0], state)[0][0] == 0.5
    with pytest.raises(CzError, match=r"the state that predict returned, shape \(1, 2\), not \(3,\)"):
        policy.predict(seen[0], np.zeros(3))


LOOP = """
    a = Gemm(observation, weight)
    action = Loop("", "", a) <body = body (int64 i, bool go, float[n,2] x) => (bool on, float[n,2] y) {
        on = Identity(go) y = Identity(x)
    }>
"""


def branch():
    model = written("action = Identity(observation)")
    model.graph.node[0].attribute.append(helper.make_attribute("then_branch", graph_of([LINEAR], WEIGHTS, CHANNELS)))
    return model


def external(location):
    model = model_of()
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, text in (("location", location), ("offset", "0"), ("length", "88")):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, text
    return model


def changed(change):
    model = model_of()
    change(model)
    return model


def deep(nodes, width):
    chain = "".join(f"x{i + 1} = Mul(x{i}, one) " for i in range(nodes))
    first, last = np.ones((CHANNELS, width), np.float32), np.ones((width, 2), np.float32)
    text = f"x0 = MatMul(observation, first) {chain} action = MatMul(x{nodes}, last)"
    return written(text, first=first, last=last, one=np.ones(1, np.float32))


def broadcast_bomb():
    weights = {name: np.zeros((1000,) + (1,) * (i + 2), np.float32) for i, name in enumerate("abc")}
    return written("x = Add(observation, a) y = Add(x, b) z = Add(y, c) action = Gemm(z, weight, bias)", **weights)


def honest_shape(model, dims):
    del model.graph.initializer[0].dims[:]
    model.graph.initializer[0].dims.extend(dims)


ONES = np.ones((CHANNELS, 2), np.float32)
HOSTILE = {
    "external weights": (lambda: external("../../../etc/passwd"), "another file"),
    "endless loop": (lambda: written(LOOP), "'Loop'"),
    "branch in an attribute": (branch, "an attribute that is not a number"),
    "tensor made of a shape": (
        lambda: written("action = ConstantOfShape(big)", big=np.int64([10**6, 10**6])), "'ConstantOfShape'"),
    "scripted operator": (lambda: written("action = ai.onnx.contrib.PyOp(observation)"), "'ai.onnx.contrib:PyOp'"),
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
        lambda: written(
            "x = Add(observation, five) y = MatMul(five, w) action = Gemm(observation, w)",
            five=np.zeros((5, 1, CHANNELS), np.float32), w=ONES,
        ),
        "row of known length",
    ),
    "deep graph": (lambda: deep(MAX_NODES, 2), f"{MAX_NODES + 2} nodes"),
    "wide graph": (lambda: deep(8, MAX_ACTIVATIONS // 8), "for each puller"),
    "weights used again and again": (
        lambda: written(
            "x1 = Gemm(observation, w) "
            + "".join(f"x{i + 1} = Gemm(x{i}, w) " for i in range(1, MAX_NODES - 1))
            + "action = Gemm(observation, weight, bias)",
            w=np.ones((CHANNELS, 900 * CHANNELS), np.float32),
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
    "constant action": (lambda: written("action = Identity(a)", a=np.zeros((2, 2), np.float32)), "do not depend"),
    "rows of others": (
        lambda: written(
            "x = Gather <axis = 0> (observation, first) y = Add(observation, x) action = MatMul(y, weight)",
            first=np.int64([0]),
        ),
        "row of known length",
    ),
    "products of others": (
        lambda: written(
            "x = Gemm <transA = 1> (observation, observation) y = MatMul(observation, x) action = MatMul(y, weight)"
        ),
        "may mix the rows",
    ),
    "norms over pullers": (
        lambda: written(
            "x = LayerNormalization <axis = 0> (observation, s) action = MatMul(x, weight)", s=np.ones(1, np.float32)
        ),
        "may mix the rows",
    ),
    "two pullers read as two numbers": (
        lambda: written(
            """linear = Gemm(observation, weight, bias) pairs = Gather <axis = 1> (linear, both)
            x = Add(pairs, linear) action = Gather <axis = 1> (x, first)""",
            both=np.int64([[0, 1], [0, 1]]), first=np.int64(0),
        ),
        "may mix the rows",
    ),
    "cycle": (lambda: written("action = Add(action, action)"), "not a sound"),
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


def field(tag, content):
    """A part of a message, in the ONNX format's encoding."""
    length, size = b"", len(content)
    while size > 127:
        length += bytes([size % 128 | 128])
        size //= 128
    return tag + length + bytes([size]) + content


def nested():
    """Graphs in attributes in nodes in graphs, 1200 deep."""
    content = b""
    for tag in (b"\x3a", b"\x0a", b"\x2a", b"\x32") * 300:
        content = field(tag, content)
    return content


IN_LITTLE_MEMORY = """
import ctypes, json, resource, sys
ctypes.CDLL(None).mallopt(-8, 1)  # glibc's M_ARENA_MAX: each thread's own pool would reserve 128 MB of the limit
import onnxruntime, onnx.checker
sys.path[:0] = ["."]
from tests.agents import test_graph as t
t.policy_of(t.model_of())
now = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (now + 2**29,) * 2)
resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
print(json.dumps({name: t.refusal(make) for name, (make, _) in t.HOSTILE.items()}))
"""
"""Reads all of them in a process that may not have a gigabyte beyond what importing takes."""


def refusal(make):
    """What is said of a model, or nothing where it is taken."""
    try:
        policy_of(make())
    except AgentFileError as error:
        return str(error)
    return ""


@pytest.fixture(scope="module")
def refusals():
    if sys.platform == "linux":  # which limits and measures memory so
        return json.loads(python("-c", IN_LITTLE_MEMORY))
    return {name: refusal(make) for name, (make, _) in HOSTILE.items()}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_graphs_are_refused_with_the_reason_and_within_a_small_memory(name, refusals):
    assert HOSTILE[name][1] in refusals[name]
    assert "\n" not in refusals[name]
    assert len(refusals[name]) < 400


def test_every_operator_is_a_standard_one_without_control_flow():
    for name in OPERATORS:
        schema = onnx.defs.get_schema(name, 17)
        assert not any("GRAPH" in str(attribute.type) for attribute in schema.attributes.values())
