"""Networks of any library as agent files: torch modules, and ONNX models as ordinary exporters write them."""

import io
import json
import warnings
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from cz_gym import agents
from cz_gym.agents import recipes
from cz_gym.agents.contract import AgentFileError, OnnxPolicy, facts_of, write_agent
from cz_gym.agents.from_torch import save_agent
from cz_gym.config import make_config
from tests.contracts import facts

CONFIG = make_config(observation="measured", action="rate", horizon=200.0)
WIDTH, SIZE = 12, 8


class MLP(nn.Module):
    def __init__(self, *layers):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(WIDTH, SIZE), *layers, nn.Linear(SIZE, 2))

    def forward(self, x):
        return self.layers(x)


class Noisy(MLP):
    """Draws its actions."""

    def forward(self, x):
        return super().forward(x) + torch.randn(2)


class Cell(nn.Module):
    """A cell of one state, GRU or RNN, or of two, LSTM, which share a vector."""

    def __init__(self, kind):
        super().__init__()
        self.cell, self.head = kind(WIDTH, SIZE), nn.Linear(SIZE, 2)

    def forward(self, x, state):
        if isinstance(self.cell, nn.LSTMCell):
            state = self.cell(x, tuple(state.chunk(2, -1)))
            return self.head(state[0]), torch.cat(state, -1)
        state = self.cell(x, state)
        return self.head(state), state


class Sequence(nn.Module):
    """A recurrent layer with an axis of time, of one step; an LSTM has two inputs and outputs besides."""

    def __init__(self, kind, batch_first):
        super().__init__()
        self.layer, self.head, self.axis = kind(WIDTH, SIZE, batch_first=batch_first), nn.Linear(SIZE, 2), batch_first

    def forward(self, x, *state):
        state = tuple(each.unsqueeze(0) for each in state)
        seen, after = self.layer(x.unsqueeze(int(self.axis)), state if len(state) > 1 else state[0])
        after = after if isinstance(after, tuple) else (after,)
        return (self.head(seen.squeeze(int(self.axis))), *(each.squeeze(0) for each in after))


class TwoLayers(nn.Module):
    """Two recurrent layers, whose state is one row."""

    def __init__(self, kind):
        super().__init__()
        self.layer, self.head = kind(WIDTH, SIZE, num_layers=2), nn.Linear(SIZE, 2)

    def forward(self, x, state):
        parts = state.view(-1, state.shape[1] // SIZE, SIZE).transpose(0, 1).contiguous()
        seen, after = self.layer(x.unsqueeze(0), (parts[:2], parts[2:]) if isinstance(self.layer, nn.LSTM) else parts)
        after = torch.cat(after) if isinstance(after, tuple) else after
        return self.head(seen[0]), after.transpose(0, 1).reshape(-1, state.shape[1])


class Gaussian(nn.Module):
    """The mean of a squashed Gaussian policy, whose observations are normalised with running statistics."""

    def __init__(self):
        super().__init__()
        self.net = nn.Linear(WIDTH, 4)
        self.register_buffer("mean", torch.randn(WIDTH, dtype=torch.float64))
        self.register_buffer("var", torch.rand(WIDTH, dtype=torch.float64) + 0.5)

    def forward(self, x):
        normal = ((x - self.mean) / torch.sqrt(self.var + 1e-8)).clamp(-10.0, 10.0).float()
        mean, log_sd = self.net(normal).chunk(2, dim=-1)
        return torch.distributions.Normal(mean, log_sd.clamp(-20.0, 2.0).exp(), validate_args=False).mean.tanh()


NETWORKS = {
    "tanh": (lambda: MLP(nn.Tanh()), []),
    "silu and layer norm": (lambda: MLP(nn.SiLU(), nn.LayerNorm(SIZE)), []),
    "batch norm, gelu, dropout": (lambda: MLP(nn.Flatten(), nn.BatchNorm1d(SIZE), nn.GELU(), nn.Dropout()), []),
    "GRU cell": (lambda: Cell(nn.GRUCell), [SIZE]),
    "RNN cell": (lambda: Cell(nn.RNNCell), [SIZE]),
    "LSTM cell": (lambda: Cell(nn.LSTMCell), [2 * SIZE]),
    "GRU": (lambda: Sequence(nn.GRU, True), [SIZE]),
    "LSTM": (lambda: Sequence(nn.LSTM, False), [SIZE, SIZE]),
    "RNN": (lambda: Sequence(nn.RNN, True), [SIZE]),
    "GRU of two layers": (lambda: TwoLayers(nn.GRU), [2 * SIZE]),
    "LSTM of two layers": (lambda: TwoLayers(nn.LSTM), [4 * SIZE]),
    "squashed Gaussian": (Gaussian, []),
}
"""Networks, and the widths of their states."""


def exported(module, widths, rows=True, opset=None):
    """An ONNX model as torch's exporter writes it, with names of its own; ``rows``: of any number of pullers."""
    examples = [torch.zeros(2, width) for width in (WIDTH, *widths)]
    names = [f"in{i}" for i in range(len(examples))], [f"out{i}" for i in range(len(examples))]
    axes = {name: {0: "batch"} for name in (*names[0], *names[1])} if rows else None
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(module.eval(), tuple(examples), file, dynamo=False, dynamic_axes=axes,
                          input_names=names[0], output_names=names[1], opset_version=opset)  # fmt: skip
    return file.getvalue()


def measured_facts(**others):
    return {**facts(), **facts_of(CONFIG), **others}


def check_alike(agent, module, widths):
    """Raise AssertionError unless an agent acts as its module for three samples."""
    assert agent.memory_length == sum(widths)
    random = np.random.default_rng(0)
    seen, state = random.normal(size=(5, WIDTH)).astype(np.float32), None
    own = [torch.zeros(5, width) for width in widths]
    for _ in range(3):
        action, state = agent.predict(seen, state)
        with torch.no_grad():
            wanted = module(torch.tensor(seen), *own)
        wanted, own = (wanted[0], list(wanted[1:])) if widths else (wanted, own)
        np.testing.assert_allclose(action, wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "rows"),
    [(name, rows) for name in NETWORKS for rows in (True, False) if rows or name != "squashed Gaussian"],
)
def test_models_of_an_ordinary_exporter_act_as_they_did(tmp_path, name, rows):
    """Constants are nodes, a recurrent layer has an axis of time, inputs have other names."""
    make, widths = NETWORKS[name]
    torch.manual_seed(0)
    module = make()
    write_agent(tmp_path / "a.onnx", exported(module, widths, rows), **measured_facts())
    check_alike(OnnxPolicy.load(tmp_path / "a.onnx", CONFIG), module, widths)


@pytest.mark.parametrize("opset", [11, 13, 16, 20])
@pytest.mark.parametrize("name", ["batch norm, gelu, dropout", "LSTM cell"])
def test_models_of_other_opsets_act_alike(tmp_path, opset, name):
    """ONNX's own library computes a BatchNormalization before opset 14 as in training."""
    make, widths = NETWORKS[name]
    module = make()
    write_agent(tmp_path / "a.onnx", exported(module, widths, opset=opset), **measured_facts())
    check_alike(OnnxPolicy.load(tmp_path / "a.onnx", CONFIG), module, widths)


def test_a_state_of_several_layers_is_one_row_of_them(tmp_path):
    layers, head, file = nn.GRU(WIDTH, SIZE, num_layers=2), nn.Linear(SIZE, 2), io.BytesIO()

    class Own(nn.Module):
        def __init__(self):
            super().__init__()
            self.layers, self.head = layers, head

        def forward(self, x, state):
            seen, after = self.layers(x.unsqueeze(0), state)
            return self.head(seen[0]), after

    axes = {"x": {0: "n"}, "h": {1: "n"}, "a": {0: "n"}, "after": {1: "n"}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(Own(), (torch.zeros(2, WIDTH), torch.zeros(2, 2, SIZE)), file, dynamo=False,
                          input_names=["x", "h"], output_names=["a", "after"], dynamic_axes=axes)  # fmt: skip
    write_agent(tmp_path / "a.onnx", file.getvalue(), **measured_facts())
    random = np.random.default_rng(0)
    seen, state = (random.normal(size=(5, width)).astype(np.float32) for width in (WIDTH, 2 * SIZE))
    action, after = OnnxPolicy.load(tmp_path / "a.onnx").predict(seen, state)
    with torch.no_grad():
        wanted = Own()(torch.tensor(seen), torch.tensor(state.reshape(5, 2, SIZE)).transpose(0, 1).contiguous())
    np.testing.assert_allclose(action, wanted[0].clamp(-1.0, 1.0), atol=1e-5)
    np.testing.assert_allclose(after, wanted[1].transpose(0, 1).reshape(5, -1), atol=1e-5)


def test_weights_beside_the_file_are_folded_in(tmp_path):
    model = onnx.load_from_string(exported(MLP(nn.Tanh()), []))
    onnx.save(model, tmp_path / "m.onnx", save_as_external_data=True, location="m.data", size_threshold=0)
    write_agent(tmp_path / "a.onnx", tmp_path / "m.onnx", **measured_facts())
    (tmp_path / "m.data").unlink()
    assert OnnxPolicy.load(tmp_path / "a.onnx").predict(np.zeros(WIDTH, np.float32))[0].shape == (2,)


def graph(*nodes, weights=(), inputs=(("x", [None, WIDTH]),), outputs=(("y", [None, 2]),)):
    """A model of these nodes."""
    values = [
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, dims) for n, dims in each] for each in (inputs, outputs)
    ]
    tensors = [numpy_helper.from_array(np.asarray(array), name) for name, array in weights]
    made = helper.make_graph(list(nodes), "g", *values, tensors)
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=9).SerializeToString()


PICK = ("w", np.ones((WIDTH, 2), np.float32))
OF_OTHER_ROWS = helper.make_node("MatMul", ["x", "w"], ["m"]), helper.make_node("Softmax", ["m"], ["y"], axis=0)


OF_BOTH_ROWS = (
    helper.make_node("Constant", [], ["two"], value=numpy_helper.from_array(np.array([0, 1]))),
    helper.make_node("Gather", ["x", "two"], ["m"], axis=1),
    helper.make_node("Transpose", ["m"], ["t"]),
    helper.make_node("Constant", [], ["shape"], value=numpy_helper.from_array(np.array([-1, 2]))),
    helper.make_node("Reshape", ["t", "shape"], ["y"]),
)

OF_ANOTHER_DOMAIN = helper.make_node("Scaler", ["x"], ["y"], domain="ai.onnx.ml", offset=[0.0], scale=[1.0])
"""As scikit-learn's models are exported."""


def test_shape_arithmetic_halves_and_double_precision_are_computed(tmp_path):
    """A model in double precision that reads the length of its rows."""
    model = graph(
        helper.make_node("Cast", ["x"], ["wide"], to=TensorProto.DOUBLE),
        helper.make_node("Shape", ["wide"], ["shape"]),
        helper.make_node("Constant", [], ["one"], value=numpy_helper.from_array(np.int64(1))),
        helper.make_node("Gather", ["shape", "one"], ["width"]),
        helper.make_node("Constant", [], ["two"], value=numpy_helper.from_array(np.int64(2))),
        helper.make_node("Div", ["width", "two"], ["half"]),
        helper.make_node("Constant", [], ["axes"], value=numpy_helper.from_array(np.array([0]))),
        helper.make_node("Unsqueeze", ["half", "axes"], ["from"]),
        helper.make_node("Unsqueeze", ["width", "axes"], ["to"]),
        helper.make_node("Unsqueeze", ["one", "axes"], ["at"]),
        helper.make_node("Slice", ["wide", "from", "to", "at"], ["later"]),
        helper.make_node("MatMul", ["later", "w"], ["z"]),
        helper.make_node("Cast", ["z"], ["y"], to=TensorProto.FLOAT),
        weights=[("w", np.ones((WIDTH // 2, 2)))],
    )
    write_agent(tmp_path / "a.onnx", model, **measured_facts())
    seen = np.arange(2.0 * WIDTH, dtype=np.float32).reshape(2, WIDTH)
    action, _ = OnnxPolicy.load(tmp_path / "a.onnx").predict(seen)
    np.testing.assert_allclose(action[:, 0], seen[:, WIDTH // 2 :].sum(axis=1), rtol=1e-6)


@pytest.mark.parametrize(
    ("model", "says"),
    [
        (lambda: graph(*OF_OTHER_ROWS, weights=[PICK]), "uses the operator 'Softmax'"),
        (lambda: graph(*OF_BOTH_ROWS), r"changes the order of numbers, from \[2, 'n'\] to \['n', 2\]"),
        (lambda: graph(OF_ANOTHER_DOMAIN), r"beyond the standard ONNX ones, ai\.onnx\.ml\.Scaler"),
        (lambda: exported(MLP(nn.Tanh()), []).replace(b"batch", b"batcj") + b"\0", "not a sound ONNX model"),
    ],
)
def test_what_no_agent_may_hold_is_not_written(tmp_path, model, says):
    with pytest.raises(AgentFileError, match=says):
        write_agent(tmp_path / "a.onnx", model(), **measured_facts())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"colour": 1}, "facts: unknown colour"),
        ({"training_steps": None, "training_seed": None}, "facts: missing training_seed, training_steps"),
        ({"channels": None}, r"facts: missing channels \(cz_gym.agents.contract.facts_of"),
        ({"learned_from": "magic"}, "learned_from must be in reward, state, plant, not 'magic'"),
    ],
)
def test_facts_of_an_agent_are_complete_and_known(tmp_path, changes, says):
    given = {name: value for name, value in {**measured_facts(), **changes}.items() if value is not None}
    with pytest.raises(AgentFileError, match=says):
        write_agent(tmp_path / "a.onnx", exported(MLP(nn.Tanh()), []), **given)
    assert not list(tmp_path.iterdir())


def test_names_of_files_and_numbers_of_numpy_are_taken(tmp_path):
    (tmp_path / "m.onnx").write_bytes(exported(MLP(nn.Tanh()), []))
    given = {**measured_facts(), "training_steps": np.int64(9), "validation_cost": np.float32(0.5)}
    contract = write_agent(str(tmp_path / "a.onnx"), str(tmp_path / "m.onnx"), **given)
    assert OnnxPolicy.load(tmp_path / "a.onnx").contract == contract
    with pytest.raises(AgentFileError, match=r"none.onnx: cannot be read \(No such file"):
        write_agent(tmp_path / "b.onnx", str(tmp_path / "none.onnx"), **given)


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(recipes, "JUDGING_SEEDS", recipes.JUDGING_SEEDS[:4])


@pytest.mark.parametrize("name", ["tanh", "GRU cell", "LSTM cell"])
def test_a_module_is_saved_in_one_call(tmp_path, quick, name):
    make, widths = NETWORKS[name]
    torch.manual_seed(0)
    module = make().train()
    contract = agents.save_agent(
        tmp_path / "mine.onnx", module, CONFIG, sum(widths), training_steps=500_000, training_seed=3
    )
    agent = OnnxPolicy.load(tmp_path / "mine.onnx", CONFIG)
    assert agent.contract == contract
    assert (contract.algorithm, contract.training_steps, contract.training_seed) == ("mine", 500_000, 3)
    assert (contract.learned_from, contract.action, contract.observation) == ("reward", "rate", "measured")
    assert contract.validation_cost > 0.0
    assert module.training, "it goes on training"
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.mul_(30.0)
    save_agent(tmp_path / "mine.onnx", module, CONFIG, sum(widths))
    seen = np.random.default_rng(0).normal(size=(9, WIDTH)).astype(np.float32)
    action, _ = OnnxPolicy.load(tmp_path / "mine.onnx").predict(seen)
    assert np.abs(action).max() == 1.0, "the file clips"


@pytest.mark.parametrize(
    ("module", "options", "says"),
    [
        (nn.Linear(WIDTH, 4), {}, r"gives \[\(2, 4\)\] for two crystals, not \[\(2, 2\)\]"),
        (Cell(nn.GRUCell), {}, "Cell fails on inputs of shape .2, 12.: "),
        (Cell(nn.GRUCell), {"state_size": 5}, r"Cell fails on inputs of shape .2, 12. and .2, 5.: "),
        (nn.Linear(73, 2), {}, "Linear fails on inputs of shape .2, 12."),
        (MLP(nn.Tanh()), {"learned_from": "nothing"}, "learned_from must be 'reward', 'state' or 'plant'"),
        (lambda x: x, {}, "this needs a Module"),
        (Noisy(nn.Tanh()), {}, r"RandomNormal|act otherwise than the module"),
    ],
)
@pytest.mark.usefixtures("quick")
def test_a_module_that_is_no_agent_is_refused(tmp_path, module, options, says):
    with pytest.raises(ValueError, match=says) as caught:
        save_agent(tmp_path / "a.onnx", module, CONFIG, **options)
    assert "\n" not in str(caught.value)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("change", [{"training_steps": 500_000}, {"learned_from": "reward"}, {"algorithm": "other"}])
def test_a_contract_that_was_edited_is_refused(tmp_path, change):
    """The hash of the network alone let a file of 64 million steps enter the class of one million."""
    shipped = agents.shipped("ppo")
    file, text = tmp_path / "a.onnx", json.loads(shipped.with_suffix(".json").read_text())
    file.write_bytes(shipped.read_bytes())
    file.with_suffix(".json").write_text(json.dumps(text))
    assert OnnxPolicy.load(file).contract.hash == text["hash"]
    assert text[next(iter(change))] not in change.values()
    file.with_suffix(".json").write_text(json.dumps({**text, **change}))
    with pytest.raises(AgentFileError, match=r"a\.json: changed after it was written \(its hash differs\)"):
        OnnxPolicy.load(file)


def test_the_hash_is_of_network_and_declarations():
    contract = OnnxPolicy.load(agents.shipped("ppo")).contract
    assert replace(contract).hash == contract.hash
    others = {replace(contract, **each).hash for each in ({"sha256": "0" * 64}, {"training_seed": 77}, {"puller": "x"})}
    assert len({contract.hash, *others}) == 4
