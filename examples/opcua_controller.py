"""A controller of a puller over OPC UA: any that ``cz_gym.tools.export`` can write, in Python or as compiled C.

It reads the tags of ``cz-gym serve``, calls the exported block, which has inputs of the same names,
and writes both setpoints and the step that they answer.
"""

import argparse
import asyncio
import logging
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

from cz_gym.config import Config, make_config
from cz_gym.evaluation.protocol import scenarios
from cz_gym.support.command_line import OneLineParser, between
from cz_gym.support.errors import CzError
from cz_gym.tools.export.block import SETPOINT_NAMES
from cz_gym.tools.export.controllers import make_block
from cz_gym.tools.export.shell import Runner
from cz_gym.tools.export.text import CompiledBlock
from cz_gym.tools.serve.machine import TAGS
from cz_gym.tools.serve.opcua import URI, WRITABLE, certify, password


class Controller:
    """Controller in its shell, which holds bad readings, limits its setpoints and takes over without a jump."""

    def __init__(self, name: str, config: Config, compiled: bool = False) -> None:
        block = make_block(name, config)
        self._runner: Runner = CompiledBlock(block) if compiled else block
        self._memory = self._runner.start(1)

    def setpoints(self, tags: dict[str, Any]) -> list[float]:
        """Compute the setpoints for the tags of a step, whose names are those of the block's inputs and settings."""
        given = tags | {"ring_time_s": tags["time_s"], "automatic": True}
        outputs, self._memory = self._runner.run(given, self._memory)
        return [float(outputs[name][0]) for name in SETPOINT_NAMES]


async def control(controller: Controller, label: str, client: Client, steps: int) -> int:
    """Control until the crystal ends, or for so many steps; returns how many were answered."""
    space = await client.get_namespace_index(f"{URI}:tags")
    nodes = {tag.name: client.get_node(ua.NodeId(tag.name, space)) for tag in TAGS}
    last, answered = -1, 0
    while answered < steps:
        step, state = await client.read_values([nodes["step"], nodes["state"]])
        if state != "growing":
            break
        if step == last:
            await asyncio.sleep(0.002)
            continue
        tags = dict(zip(nodes, await client.read_values(nodes.values()), strict=True))
        if tags["puller"] != label:
            raise CzError(f"the server's puller is {tags['puller']}: --puller must be its file")
        last = tags["step"]
        values = zip((*controller.setpoints(tags), last), WRITABLE.values(), strict=True)
        with suppress(ua.UaStatusCodeError):  # refused: the server says why, and holds what it had
            await client.write_values([nodes[name] for name in WRITABLE], [ua.Variant(*value) for value in values])
            answered += 1
    return answered


async def run(arguments: argparse.Namespace) -> None:
    """Connect, with encryption if the server's certificate is given, and control."""
    scenario, puller = scenarios(arguments.scenario), arguments.puller
    config = make_config(scenario, observation="measured", action="direct", puller=puller)
    controller = Controller(arguments.controller, config, arguments.compiled)
    client = Client(arguments.url)
    if arguments.operator:
        client.set_user(arguments.operator)
        client.set_password(password("operator"))
    if arguments.encrypt:
        await certify(arguments.certificates)
        certificate, key = arguments.certificates / "certificate.pem", arguments.certificates / "key.pem"
        client.application_uri = URI
        await client.set_security(
            SecurityPolicyBasic256Sha256, certificate, key, server_certificate=str(arguments.encrypt)
        )
    try:
        async with client:
            print(f"{await control(controller, config.puller.label, client, arguments.steps)} steps answered")
    except (OSError, ua.UaError) as error:
        raise CzError(f"{arguments.url}: {error or type(error).__name__}") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Control a puller; 0 when its crystal has ended, 2 for bad input, 130 when interrupted."""
    logging.getLogger("asyncua").setLevel(logging.ERROR)
    parser = OneLineParser("python -m cz_gym.examples.opcua_controller", "Control a puller over OPC UA.")
    add = parser.add_argument
    add("--url", default="opc.tcp://127.0.0.1:4840/", help="server (%(default)s)")
    add("--controller", default="paper", metavar="NAME", help="controller, agent or agent file (%(default)s)")
    add("--compiled", action="store_true", help="as C, compiled by this machine's compiler")
    parser.add_puller("the server's")
    parser.add_scenario("scenario whose tuned settings it has (%(default)s)", "puller")
    add("--steps", type=between(1, 10**9), default=10**9, metavar="N", help="most steps to answer")
    add("--operator", metavar="NAME", help="user; the password is in CZ_GYM_OPERATOR_PASSWORD")
    add("--encrypt", type=Path, metavar="FILE", help="encrypt; the server's certificate.pem")
    add("--certificates", type=Path, default=Path("client"), metavar="DIR",
        help="folder of this client's certificate, made there if absent (%(default)s)")  # fmt: skip
    return parser.run(lambda given: asyncio.run(run(given)), arguments, "plant", "the server holds the last setpoints")


if __name__ == "__main__":
    sys.exit(main())
