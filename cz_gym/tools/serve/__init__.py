"""``cz-gym serve``: a virtual puller on OPC UA, with an operator's page."""

import argparse
import asyncio
import logging
import math
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from cz_gym.support.command_line import OneLineParser, between
from cz_gym.support.errors import CzError
from cz_gym.support.units import HOUR
from cz_gym.tools.play import add_crystal, crystal_config


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve one crystal until interrupted (130); 2 for bad input."""
    return commands().run(_serve, arguments, "plant", "the log is whole")


def commands() -> OneLineParser:
    """The parser of the command line."""
    parser = OneLineParser(
        "cz-gym serve",
        "A virtual puller: an OPC UA server with one crystal behind it, and an operator's page.",
        "Passwords are read from CZ_GYM_OPERATOR_PASSWORD and CZ_GYM_READER_PASSWORD. Ctrl-C ends.",
    )
    add = parser.add_argument
    parser.add_puller("the puller behind the server, at its control interval")
    add_crystal(parser)
    add("--speed", type=between(0, 10_000), default=1, metavar="N",
        help="times faster than real time; 0: every step waits for its setpoints (%(default)s)")  # fmt: skip
    add("--hours", type=between(1, 1000), metavar="N", help="length of the run (3; of a stage 1.3 times its recipe's)")
    add("--wait", action="store_true", help="time begins with the first setpoints of a client")
    add("--watchdog", type=between(5, 86_400), default=60, metavar="S",
        help="time of the crystal after which setpoints that are not renewed give way [s] (%(default)s)")  # fmt: skip
    add("--host", default="127.0.0.1", help="address to listen on (%(default)s); others need --operator")
    add(
        "--port",
        type=between(0, 65_535),
        default=4840,
        metavar="N",
        help="port of the OPC UA server (%(default)s); 0: a free one, which it prints",
    )
    add("--page-port", type=between(0, 65_535), default=8080, metavar="N",
        help="port of the operator's page (%(default)s); 0: no page")  # fmt: skip
    add("--operator", metavar="NAME", help="user who may write")
    add("--reader", metavar="NAME", help="user who may read only")
    add("--certificates", type=Path, default=Path("certificates"), metavar="DIR",
        help="folder of certificate.pem and key.pem, made there if absent (%(default)s)")  # fmt: skip
    add("--log", type=Path, metavar="FILE", help="CSV log to write, a row each step")
    add("--log-size", type=between(1, 10_000), metavar="MB", help="size at which the log goes on in a file FILE-2")
    add("--state", type=Path, metavar="FILE", help="file of the newest state; if it exists, its crystal goes on")
    return parser


def access_control(arguments: argparse.Namespace) -> Any:
    """The accounts that may log in; CzError for too short a password, and for another address without an operator."""
    from .opcua import AccessControl, Account, password

    given = (("operator", arguments.operator, True), ("reader", arguments.reader, False))
    accounts = tuple(Account(name, password(role), writes) for role, name, writes in given if name)
    remote = not _is_loopback(arguments.host)
    if remote and not arguments.operator:
        raise CzError(f"to listen on {arguments.host}, --operator and its password are needed; 127.0.0.1 needs neither")
    return AccessControl(accounts, remote)


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


@asynccontextmanager
async def serving(arguments: argparse.Namespace, access: Any) -> AsyncIterator[tuple[Any, asyncio.Task[None]]]:
    """Run a crystal, its server and page; yields the machine, and a task that ends only if the plant's thread fails."""
    from .machine import Clock, CrystalMachine, LogFile, Machine, StateFile
    from .opcua import Page, Tags, certify, publish_tags

    if arguments.log_size and not arguments.log:
        raise CzError("--log-size divides the file of --log, which is not named")
    if access.remote:
        await certify(arguments.certificates)
    log = LogFile(arguments.log, 1e6 * (arguments.log_size or math.inf)) if arguments.log else None
    state = StateFile(arguments.state) if arguments.state else None
    config = crystal_config(arguments, arguments.hours and arguments.hours * HOUR, "direct")
    kind = Machine if arguments.stage is None else CrystalMachine
    machine = kind(config, arguments.seed, arguments.watchdog, log, state)
    loop, queue = asyncio.get_running_loop(), asyncio.Queue[dict[str, Any]]()
    clock = Clock(
        machine, arguments.speed, arguments.wait, lambda tags: loop.call_soon_threadsafe(queue.put_nowait, tags)
    )
    place = access, arguments.host, arguments.certificates
    async with Tags(machine, *place, arguments.port) as tags, Page(machine, *place, arguments.page_port):
        publishing = asyncio.create_task(publish_tags(tags, queue, clock))
        clock.start()
        try:
            yield machine, publishing
        finally:
            clock.stopped.set()
            await asyncio.to_thread(clock.join)
            publishing.cancel()


def _serve(arguments: argparse.Namespace) -> None:
    logging.basicConfig(format="%(asctime)s %(name)s: %(message)s", level=logging.WARNING)
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)

    async def run() -> None:
        async with serving(arguments, access_control(arguments)) as (_, publishing):
            await publishing

    asyncio.run(run())
