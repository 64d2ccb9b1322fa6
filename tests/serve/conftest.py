"""A virtual puller in a thread of its own, as the command starts it."""

import asyncio
import math
import socket
import threading
import warnings
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("asyncua", reason="asyncua is absent: pip install '.[plant]'")
from asyncua import Client, ua

from cz_gym.serve.__main__ import commands, door_of, serving
from cz_gym.serve.machine import TAGS
from cz_gym.serve.opcua import KINDS, URI

PASSWORD = "correct horse"


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


class Running:
    """A running puller: its machine, its addresses, and where its files are."""

    def __init__(self, folder: Path, options: tuple[str, ...], remote: bool) -> None:
        self.folder, self.port, self.page = folder, free_port(), free_port()
        ports = ("--port", str(self.port), "--page-port", str(self.page))
        files = ("--certificates", str(folder / "certificates"), "--log", str(folder / "log.csv"))
        self.arguments, self.remote, self.machine = commands().parse_args([*ports, *files, *options]), remote, None
        self.ready, self.done, self.error = threading.Event(), threading.Event(), None

    @property
    def url(self) -> str:
        return f"opc.tcp://127.0.0.1:{self.port}/"

    def run(self) -> None:
        async def run() -> None:
            door = door_of(self.arguments)
            door.remote = self.remote
            async with serving(self.arguments, door) as (self.machine, _):
                self.door = door
                self.ready.set()
                await asyncio.to_thread(self.done.wait)

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                asyncio.run(run())
        except BaseException as error:
            self.error = error
        self.ready.set()


@contextmanager
def running(folder: Path, *options: str, remote: bool = False) -> Iterator[Any]:
    """A puller with these options; ``remote`` makes it as strict as on another address."""
    puller = Running(folder, options, remote)
    thread = threading.Thread(target=puller.run)
    thread.start()
    puller.ready.wait(600.0)
    try:
        if puller.error:
            raise puller.error
        yield puller
    finally:
        puller.done.set()
        thread.join(30.0)


class Hand:
    """A client that reads and writes tags by name."""

    def __init__(self, client: Client, space: int) -> None:
        self.client, self.nodes = client, {tag.name: client.get_node(ua.NodeId(tag.name, space)) for tag in TAGS}

    async def read(self, name: str) -> Any:
        return await self.nodes[name].read_value()

    async def write(self, **values: Any) -> list[str]:
        """The names of the status codes."""
        kinds = {tag.name: KINDS[tag.kind] for tag in TAGS}
        variants = [v if isinstance(v, ua.Variant) else ua.Variant(v, kinds[name]) for name, v in values.items()]
        nodes = [self.nodes[name] for name in values]
        return [code.name for code in await self.client.write_values(nodes, variants, raise_on_partial_error=False)]


async def connected(url: str, act: Callable[[Hand], Awaitable[Any]], user: str = "") -> Any:
    """What ``act`` returns for a connected client."""
    client = Client(url, timeout=30)
    if user:
        client.set_user(user)
        client.set_password(PASSWORD)
    async with client:
        return await act(Hand(client, await client.get_namespace_index(f"{URI}:tags")))


def with_client(url: str, act: Callable[[Hand], Awaitable[Any]], user: str = "") -> Any:
    return asyncio.run(connected(url, act, user))


def answer(step: int, pull: float = 1.2, heater: float = 57.0) -> dict[str, Any]:
    """Setpoints that answer a step."""
    return {"pull_speed_setpoint_mm_per_min": pull, "heater_power_setpoint_kW": heater, "watchdog": step}


NAN = math.nan
