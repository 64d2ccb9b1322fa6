"""A controller of a puller over OPC UA: the paper's, any other of the table, or an agent that reads "measured".

It reads the tags of ``python -m cz_gym.serve``, computes, and writes both setpoints and the step that they answer.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

from cz_gym import agents
from cz_gym.baselines.registry import make_controller
from cz_gym.commands import OneLineParser
from cz_gym.config import make_config
from cz_gym.errors import CzError
from cz_gym.observation import CLIP, MEASURED, Measured, scales
from cz_gym.serve.machine import TAGS
from cz_gym.serve.opcua import KINDS, URI, certify, password
from cz_gym.task import drives_of
from cz_gym.units import KILO, MM, MM_PER_MIN

WRITTEN = {tag.name: KINDS[tag.kind] for tag in TAGS if tag.writable}


def observe(tags: dict[str, Any]) -> Any:
    """The tags as a "measured" observation."""
    r_0, T_0 = tags["nominal_radius_mm"], tags["nominal_T_1_K"]
    seen = Measured(
        ring_error=(tags["ring_radius_mm"] - tags["ring_bias_mm"] - tags["r_ref_mm"]) * MM,
        valid=float(tags["valid"]),
        **{name: (tags[f"{name}_mm"] - r_0) * MM for name in ("r_ref", "r_ref_1min", "r_ref_5min")},
        **{name: tags[f"{name}_K"] - T_0 for name in ("T_1_ref", "T_1_ref_1min", "T_1_ref_5min", "T_1")},
        v_p=(tags["pull_speed_mm_per_min"] - tags["nominal_pull_speed_mm_per_min"]) * MM_PER_MIN,
        Q_H=(tags["heater_power_kW"] - tags["nominal_heater_power_kW"]) * KILO,
    )
    ranges = (
        tags["nominal_pull_speed_mm_per_min"] * MM_PER_MIN,
        (tags["heater_power_max_kW"] - tags["nominal_heater_power_kW"]) * KILO,
    )
    return np.clip(np.array(seen) / scales(MEASURED, *ranges), -CLIP, CLIP).astype(np.float32)


def setpoints(tags: dict[str, Any], action: Any, mode: str) -> tuple[float, ...]:
    """Pull speed [mm/min] and heater power [kW] of an action in this mode."""
    names = ("pull_speed", "mm_per_min"), ("heater_power", "kW")
    applied, nominal, most = (
        np.array([tags[pattern.format(*name)] for name in names]) for pattern in ("{}_{}", "nominal_{}_{}", "{}_max_{}")
    )
    drives, reach = drives_of(mode, tags["control_interval_s"]), most - nominal
    gains, clipped = np.array([drives.pull, drives.heater]), np.clip(np.asarray(action, float), -1.0, 1.0)
    moved = drives.keep * (applied - nominal) / reach + gains * clipped
    return tuple((nominal + reach * np.clip(moved, -1.0, 1.0)).tolist())


def controller(name: str, puller: str | None) -> Any:
    """The controller of that name, or the agent of a name or file, for a puller."""
    agent = Path(name).suffix == ".onnx" or name in agents.shipped_names()
    found = agents.load(name) if agent else None
    config = make_config(observation="measured", action=found.settings["action"] if found else "direct", puller=puller)
    return agents.load(name, config) if found else make_controller(name, config)


async def control(acting: Any, label: str, client: Client, steps: int) -> int:
    """Control until the crystal ends, or for so many steps; returns how many were answered."""
    space = await client.get_namespace_index(f"{URI}:tags")
    nodes = {tag.name: client.get_node(ua.NodeId(tag.name, space)) for tag in TAGS}
    memory, last, answered = None, -1, 0
    while answered < steps:
        tags = dict(zip(nodes, await client.read_values(nodes.values()), strict=True))
        if tags["puller"] != label:
            raise CzError(f"the server's puller is {tags['puller'] or 'the default one'}: --puller must be its file")
        if tags["state"] != "growing":
            break
        if tags["step"] == last:
            await asyncio.sleep(0.001)
            continue
        last = tags["step"]
        action, memory = acting.predict(observe(tags), memory)
        values = (*setpoints(tags, action, acting.action), last)
        variants = [ua.Variant(value, kind) for value, kind in zip(values, WRITTEN.values(), strict=True)]
        with suppress(ua.UaStatusCodeError):  # refused: the server says why, and holds what it had
            await client.write_values([nodes[name] for name in WRITTEN], variants)
            answered += 1
    return answered


async def run(arguments: argparse.Namespace) -> None:
    """Connect, with encryption if there is a user, and control."""
    acting, config = controller(arguments.controller, arguments.puller), make_config(puller=arguments.puller)
    client = Client(arguments.url)
    if arguments.operator:
        client.application_uri = URI
        client.set_user(arguments.operator)
        client.set_password(password("operator"))
    if arguments.encrypt:
        await certify(arguments.certificates)
        certificate, key = arguments.certificates / "certificate.pem", arguments.certificates / "key.pem"
        await client.set_security(
            SecurityPolicyBasic256Sha256, certificate, key, server_certificate=str(arguments.encrypt)
        )
    try:
        async with client:
            print(f"{await control(acting, config.puller.label, client, arguments.steps)} steps answered")
    except (OSError, ua.UaError) as error:
        raise CzError(f"{arguments.url}: {error or type(error).__name__}") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Control a puller; 0 when its crystal has ended, 2 for bad input, 130 when interrupted."""
    parser = OneLineParser("python -m examples.opcua_controller", "Control a puller over OPC UA.")
    add = parser.add_argument
    add("--url", default="opc.tcp://127.0.0.1:4840/", help="server (%(default)s)")
    add("--controller", default="paper", metavar="NAME", help="controller, agent or agent file (%(default)s)")
    parser.add_puller("the server's")
    add("--steps", type=int, default=10**9, metavar="N", help="most steps to answer")
    add("--operator", metavar="NAME", help="user; the password is in CZ_GYM_OPERATOR_PASSWORD")
    add("--encrypt", type=Path, metavar="FILE", help="encrypt; the server's certificate.pem")
    add("--certificates", type=Path, default=Path("client"), metavar="DIR",
        help="folder of this client's certificate, made there if absent (%(default)s)")  # fmt: skip
    return parser.run(lambda given: asyncio.run(run(given)), arguments, "plant", "the server holds the last setpoints")


if __name__ == "__main__":
    sys.exit(main())
