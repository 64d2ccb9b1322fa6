"""The operator's page: readings, strip charts of the last hour and the crystal, in a browser."""

import asyncio
import json
import ssl
from collections.abc import Awaitable, Callable
from io import BytesIO
from ipaddress import ip_address
from pathlib import Path
from socket import gethostname
from urllib.parse import urlsplit

from aiohttp import BasicAuth, web
from plotly.offline import get_plotlyjs

from cz_gym.rendering.canvas import load
from cz_gym.support.errors import CzError
from cz_gym.tools.export.block import SETPOINT_NAMES

from .machine import Machine, PullerAlarm
from .opcua import AccessControl, Account, in_address

HTML = Path(__file__).parent / "page.html"
ASK = {"WWW-Authenticate": 'Basic realm="virtual puller", charset="UTF-8"'}
HEADERS = {"Content-Security-Policy": "frame-ancestors 'none'", "X-Content-Type-Options": "nosniff"}
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Page:
    """Serves the page beside the OPC UA server, with the same accounts; with TLS where that one is encrypted."""

    def __init__(self, machine: Machine, access: AccessControl, host: str, certificates: Path, port: int) -> None:
        self.machine, self.access, self.place = machine, access, (host, port)
        self.certificates = certificates
        app = web.Application(middlewares=[self._guard], client_max_size=1000)
        app.add_routes([
            web.get("/", self._html), web.get("/plotly.js", self._plotly), web.get("/data", self._data),
            web.get("/crystal.png", self._crystal), web.get("/login", self._login), web.post("/setpoints", self._write),
        ])  # fmt: skip
        self._runner = web.AppRunner(app, access_log=None)
        self._picture: tuple[int, bytes] = -1, b""
        self._script = get_plotlyjs().encode()

    async def __aenter__(self) -> "Page":
        host, port = self.place
        if port:
            context = None
            if self.access.remote:
                context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
                context.load_cert_chain(self.certificates / "certificate.pem", self.certificates / "key.pem")
            await self._runner.setup()
            try:
                await web.TCPSite(self._runner, host, port, ssl_context=context).start()
            except OSError as error:
                raise CzError(f"page on {in_address(host)}:{port}: {error.strerror or error}") from None
            print(f"page: http{'s' if context else ''}://{in_address(host)}:{port}/", flush=True)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._runner.cleanup()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Let in whoever may; guests may read on this machine, operators may write."""
        if not self._is_served(request.host):
            return web.Response(status=421, text="this is neither the address nor the name of this machine")
        account = self._account(request)
        writes = request.method == "POST"
        # JSON cannot be posted by another site's page without this server's consent.
        if account is None or (request.path == "/login" and not account.name):
            return web.Response(status=401, headers=ASK, text="log in")
        if writes and not (account.name and account.writes and request.content_type == "application/json"):
            self.access.refused(f"{account.name or 'guest'}: {request.path} of the page")
            return web.Response(status=403, text="only an operator who has logged in may write")
        response = await handler(request)
        response.headers.update(HEADERS)
        return response

    def _is_served(self, given: str) -> bool:
        """Whether a Host header names this server: an address, or a name that another site cannot point here."""
        host = ""
        try:
            host = urlsplit(f"//{given}").hostname or ""
            ip_address(host)
        except ValueError:
            return host in {"localhost", self.place[0].lower(), gethostname().lower()}
        return True

    def _account(self, request: web.Request) -> Account | None:
        try:
            given = BasicAuth.decode(request.headers["Authorization"], "utf-8")
        except (KeyError, ValueError):
            return self.access.login(None, None)
        return self.access.login(given.login, given.password)

    async def _html(self, _: web.Request) -> web.Response:
        return web.Response(text=HTML.read_text("utf-8"), content_type="text/html")

    async def _plotly(self, _: web.Request) -> web.Response:
        headers = {"Cache-Control": "max-age=86400"}
        return web.Response(body=self._script, content_type="text/javascript", charset="utf-8", headers=headers)

    async def _login(self, _: web.Request) -> web.Response:
        raise web.HTTPSeeOther("/")

    async def _data(self, request: web.Request) -> web.Response:
        """The newest tags, and the last hour after the step that the page has."""
        rows = list(self.machine.hour)
        try:
            after = int(request.query.get("after", "-1"))
        except ValueError:
            raise web.HTTPBadRequest(text="after must be the number of a step") from None
        account, now = self._account(request) or Account("", "", False), rows[-1]
        return web.json_response({
            "now": now,
            "hour": [row for row in rows if row["step"] > after],
            "alarms": [alarm.name for alarm in PullerAlarm if now["alarms"] & alarm],
            "events": list(self.access.events)[-5:],
            "limits": self.machine.limits,
            "user": account.name,
            "writes": bool(account.name) and account.writes,
            "accounts": bool(self.access.accounts),
        })  # fmt: skip

    async def _crystal(self, _: web.Request) -> web.Response:
        """The picture of the newest step, drawn once however many look."""
        if self._picture[0] != self.machine.k:
            step = self.machine.k
            self._picture = step, await asyncio.to_thread(self._draw)
        return web.Response(body=self._picture[1], content_type="image/png", headers={"Cache-Control": "no-store"})

    def _draw(self) -> bytes:
        frame, pygame, file = self.machine.picture(), load(), BytesIO()
        pygame.image.save(pygame.surfarray.make_surface(frame.swapaxes(0, 1)), file, "crystal.png")
        return file.getvalue()

    async def _write(self, request: web.Request) -> web.Response:
        """Setpoints of the operator; none gives control back to the clients."""
        try:
            given = json.loads(await request.read())
        except (ValueError, RecursionError):
            given = None
        good = isinstance(given, dict) and set(given) in (set(), set(SETPOINT_NAMES))
        if not good or not all(type(value) in (int, float) for value in given.values()):
            return web.Response(status=400, text="two numbers, or none")
        reasons = self.machine.set_manual(given)
        return web.Response(status=400 if reasons else 200, text="; ".join(f"{n}: {r}" for n, r in reasons.items()))
