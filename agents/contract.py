"""What an agent file promises: the JSON beside each ONNX file, and the errors for files that break it."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from cz_gym.evaluation.files import write_files

FORMAT = "cz-gym-agent"
FORMAT_VERSION = 1
MAX_BYTES = 4_000_000
"""Largest agent file that is read."""


class AgentFileError(ValueError):
    """An agent file is missing, broken, or made for something else; the message is one line."""


@dataclass(frozen=True)
class Contract:
    """What the agent saw, on which plant it was trained, and how it came about."""

    observation: str
    """Observation mode it reads."""
    channels: int
    """Length of that observation."""
    control_interval: float
    """Time between actions it was trained at [s]."""
    plant_hash: str
    """Hash of the nominal plant it was trained on."""
    scenario: str
    """Scenario it was trained on."""
    scenario_hash: str
    """Hash of that scenario."""
    algorithm: str
    """Name of the learning algorithm."""
    training_seed: int
    """Seed of the training run."""
    training_steps: int
    """Environment steps behind these weights."""
    validation_rmse_mm: float
    """Mean RMSE on the validation episodes it was picked by [mm]."""
    sha256: str
    """Hash of the ONNX file."""


def write_agent(path: Path, onnx_bytes: bytes, **facts: Any) -> Contract:
    """Write ``path`` (.onnx) and its contract (.json), each whole or not at all; ``facts`` are Contract's fields."""
    contract = Contract(**facts, sha256=hashlib.sha256(onnx_bytes).hexdigest())
    text = json.dumps({"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(contract)}, indent=2) + "\n"
    write_files({path: onnx_bytes, path.with_suffix(".json"): text.encode()})
    return contract


def read_agent(path: Path) -> tuple[Contract, bytes]:
    """The contract and the ONNX bytes of an agent file; AgentFileError with the reason if anything is wrong."""
    onnx_bytes = _read(path)
    contract = _parse(path.with_suffix(".json"), _read(path.with_suffix(".json")))
    if hashlib.sha256(onnx_bytes).hexdigest() != contract.sha256:
        raise AgentFileError(f"{path}: not the file its contract was written for (SHA-256 differs)")
    return contract, onnx_bytes


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise AgentFileError(f"{path}: no such file") from None
    except OSError as error:
        raise AgentFileError(f"{path}: cannot be read ({error.strerror})") from None
    if len(content) > MAX_BYTES:
        raise AgentFileError(f"{path}: larger than {MAX_BYTES} bytes")
    return content


def _parse(path: Path, content: bytes) -> Contract:
    try:
        data = json.loads(content)
    except (ValueError, RecursionError):
        raise AgentFileError(f"{path}: not JSON") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise AgentFileError(f"{path}: not a {FORMAT} contract")
    if data.get("format_version") != FORMAT_VERSION:
        raise AgentFileError(
            f"{path}: format version {data.get('format_version')!r}, this release reads {FORMAT_VERSION}"
        )
    wanted = {field.name: field.type for field in fields(Contract)}
    given = {name: value for name, value in data.items() if name not in ("format", "format_version")}
    if set(given) != set(wanted):
        odd = sorted(set(given) ^ set(wanted))[0]
        raise AgentFileError(f"{path}: field {odd!r} is {'missing' if odd in wanted else 'unknown'}")
    kinds: dict[str, tuple[type, ...]] = {"str": (str,), "int": (int,), "float": (int, float)}
    for name, value in given.items():
        if not isinstance(value, kinds[str(wanted[name])]) or isinstance(value, bool):
            raise AgentFileError(f"{path}: field {name!r} must be {wanted[name]}, not {value!r:.80}")
        if isinstance(value, float) and not math.isfinite(value):
            raise AgentFileError(f"{path}: field {name!r} must be finite, not {value!r}")
    return Contract(**given)
