"""A virtual puller in a thread of its own, as the command starts it."""

import asyncio
import socket
import threading
import warnings
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

pytest.importorskip("asyncua", reason="asyncua is absent: pip install '.[plant]'")
from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

from cz_gym.tools.serve import access_control, commands, serving
from cz_gym.tools.serve.machine import TAGS
from cz_gym.tools.serve.opcua import KINDS, URI

PASSWORD = "correct horse"


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@contextmanager
def running(folder, *options, remote=False):
    """A puller with these options, its addresses and machine; ``remote`` makes it as strict as on another address."""
    port, page = free_port(), free_port()
    files = ("--certificates", str(folder / "certificates"), "--log", str(folder / "log.csv"))
    arguments = commands().parse_args(["--port", str(port), "--page-port", str(page), *files, *options])
    puller = SimpleNamespace(folder=folder, port=port, page=page, url=f"opc.tcp://127.0.0.1:{port}/", error=None)
    ready, done = threading.Event(), threading.Event()

    async def serve():
        puller.access = access_control(arguments)
        puller.access.remote = remote
        async with serving(arguments, puller.access) as (puller.machine, _):
            ready.set()
            await asyncio.to_thread(done.wait)

    def run():
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                asyncio.run(serve())
        except BaseException as error:
            puller.error = error
        ready.set()

    thread = threading.Thread(target=run)
    thread.start()
    ready.wait(600.0)
    try:
        if puller.error:
            raise puller.error
        yield puller
    finally:
        done.set()
        thread.join(30.0)


class Hand:
    """A client that reads and writes tags by name."""

    def __init__(self, client, space):
        self.client, self.nodes = client, {tag.name: client.get_node(ua.NodeId(tag.name, space)) for tag in TAGS}

    async def read(self, name):
        return await self.nodes[name].read_value()

    async def write(self, **values):
        """The names of the status codes."""
        kinds = {tag.name: KINDS[tag.kind] for tag in TAGS}
        variants = [v if isinstance(v, ua.Variant) else ua.Variant(v, kinds[name]) for name, v in values.items()]
        nodes = [self.nodes[name] for name in values]
        return [code.name for code in await self.client.write_values(nodes, variants, raise_on_partial_error=False)]


async def connected(url, act, user="", password=PASSWORD, keys=None):
    """What ``act`` returns for a connected client; with a folder of ``keys``, an encrypted one."""
    client = Client(url, timeout=10 if keys else 30)
    if user:
        client.set_user(user)
        client.set_password(password)
    if keys:
        client.application_uri = URI
        own = keys / "certificate.pem", keys / "key.pem"
        await client.set_security(SecurityPolicyBasic256Sha256, *own, server_certificate=str(own[0]))
    async with client:
        return await act(Hand(client, await client.get_namespace_index(f"{URI}:tags")))


def with_client(url, act, *account):
    return asyncio.run(connected(url, act, *account))


def answer(step, pull=1.2, heater=57.0):
    """Setpoints that answer a step."""
    return {"pull_speed_setpoint_mm_per_min": pull, "heater_power_setpoint_kW": heater, "watchdog": step}
