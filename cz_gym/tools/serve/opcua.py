"""The OPC UA server, its accounts and refusals, and the operator's page beside it with the same accounts."""

import asyncio
import hmac
import json
import logging
import os
import ssl
from collections import deque
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime
from io import BytesIO
from ipaddress import ip_address
from pathlib import Path
from socket import AF_INET, AF_INET6, gethostname, socket
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from aiohttp import BasicAuth, web
from asyncua import Server, ua
from asyncua.crypto.cert_gen import setup_self_signed_certificate
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.address_space import AttributeService
from asyncua.server.user_managers import UserManager
from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.rsa import RSAPrivateKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID

from cz_gym.rendering.canvas import load
from cz_gym.support.errors import CzError
from cz_gym.support.files import check_writable, name_file_in_errors
from cz_gym.tools.export.block import SETPOINT_NAMES

from .machine import TAGS, Clock, Machine, PullerAlarm, Tag

URI = "urn:cz-gym:puller"
"""Namespace of the tags, and the application's name."""
KINDS = {
    float: ua.VariantType.Double, int: ua.VariantType.UInt32, bool: ua.VariantType.Boolean, str: ua.VariantType.String,
}  # fmt: skip
WHOLE = {getattr(ua.VariantType, f"{sign}Int{bits}") for sign in ("", "U") for bits in (16, 32, 64)}
WHOLE |= {ua.VariantType.SByte, ua.VariantType.Byte}
TAKEN = {ua.VariantType.UInt32: WHOLE, ua.VariantType.Double: WHOLE | {ua.VariantType.Float, ua.VariantType.Double}}
"""Types that clients may write to a tag, by the tag's own."""
KIND_OF = {tag.name: tag.kind for tag in TAGS if tag.writable}
WRITABLE = {name: KINDS[kind] for name, kind in KIND_OF.items()}
UNITS = {
    "_mm": ("mm", "MMT"), "_mm_per_min": ("mm/min", "H81"), "_K": ("K", "KEL"), "_kW": ("kW", "KWT"),
    "_s": ("s", "SEC"), "_kg": ("kg", "KGM"),
}  # fmt: skip
"""Units by the endings of tags: name, and common code of UNECE Recommendation 20."""
CODES = "http://www.opcfoundation.org/UA/units/un/cefact"
MOST_CLIENTS = 100
"""Connections at once; further ones are closed."""
SHORTEST = 8
"""Fewest characters of a password."""
LINES_PER_SECOND = 50
"""Most events of a second that are logged; a flood of refusals must not become a flood of lines."""
logger = logging.getLogger("cz_gym.tools.serve")


class Account(NamedTuple):
    """A user who must log in."""

    name: str
    password: str
    writes: bool


class AccessControl(UserManager):  # type: ignore[misc]
    """The accounts that may log in to the server and its page, and the list of what was refused.

    Without accounts everybody on this machine may read and write tags. With accounts only operators write; elsewhere
    than on this machine nobody reads without an account.
    """

    def __init__(self, accounts: tuple[Account, ...], remote: bool) -> None:
        self.accounts, self.remote = accounts, remote
        self.events: deque[str] = deque(maxlen=100)
        """The newest refusals, oldest first."""
        self._second, self._count = 0, 0

    def login(self, name: str | None, password: str | None) -> Account | None:
        """The account of a name and its password; without a name, a guest's if guests may come in, else None."""
        if not name:
            return None if self.remote else Account("", "", not self.accounts)
        for account in self.accounts:
            same = hmac.compare_digest(account.password.encode(), (password or "").encode())
            if account.name == name and same:
                return account
        self.refused(f"login as {name!r:.40}")
        return None

    def get_user(
        self, iserver: Any, username: Any = None, password: Any = None, certificate: Any = None
    ) -> User | None:
        """The user of an OPC UA session as asyncua asks for it, None if it is refused."""
        account = self.login(username, password)
        role = "operator" if account and account.writes else "reader"
        return account and User(UserRole.User, f"{role} {account.name or 'guest'}")

    def refused(self, what: str) -> None:
        """Log a refusal."""
        now = datetime.now(UTC)
        if int(now.timestamp()) != self._second:
            self._second, self._count = int(now.timestamp()), 0
        self._count += 1
        if self._count <= LINES_PER_SECOND:
            what += " (and more in this second)" * (self._count == LINES_PER_SECOND)
            self.events.append(f"{now:%H:%M:%S} refused: {what}")
            logger.warning("refused: %s", what)


class Writes(AttributeService):  # type: ignore[misc]
    """Writes of clients: all values of a request are taken by the machine, or none."""

    def __init__(self, server: Server, machine: Machine, access: AccessControl, nodes: dict[ua.NodeId, str]) -> None:
        super().__init__(server.iserver.aspace)
        self.machine, self.access, self.nodes = machine, access, nodes

    async def write(self, params: Any, user: Any = User(role=UserRole.Admin)) -> list[ua.StatusCode]:  # noqa: B008
        """Return a status for each value; the server's own writes pass."""
        if user.role == UserRole.Admin:
            return await super().write(params, user)  # type: ignore[no-any-return]
        codes = [self._check(each, user.name) for each in params.NodesToWrite]
        wanted = {self.nodes[each.NodeId]: each.Value.Value.Value for each in params.NodesToWrite if not any(codes)}
        reasons = self.machine.write_setpoints(wanted)
        for at, each in enumerate(params.NodesToWrite):
            name = self.nodes.get(each.NodeId, str(each.NodeId))
            if name in reasons:
                codes[at] = ua.StatusCodes.BadUserAccessDenied if self.machine.manual else ua.StatusCodes.BadOutOfRange
            if codes[at]:
                value = each.Value.Value.Value if each.Value.Value is not None else None
                reason = reasons.get(name) or ua.StatusCode(codes[at]).name
                self.access.refused(f"{user.name}: {name} = {value!r:.40}: {reason}")
        if any(codes):
            return [ua.StatusCode(code or ua.StatusCodes.BadInvalidState) for code in codes]
        for each in params.NodesToWrite:
            each.Value = data_value(KIND_OF[self.nodes[each.NodeId]], each.Value.Value.Value)
        return await super().write(params, User(UserRole.Admin))  # type: ignore[no-any-return]

    def _check(self, write: Any, user: str) -> int:
        """The status of a write that is refused whatever its value's size, else 0."""
        kind, variant = WRITABLE.get(self.nodes.get(write.NodeId, "")), write.Value.Value
        if kind is None or write.AttributeId != ua.AttributeIds.Value or not user.startswith("operator "):
            return int(ua.StatusCodes.BadUserAccessDenied)
        bad = variant is None or variant.VariantType not in TAKEN[kind] or variant.is_array or write.IndexRange
        bad = bad or not isinstance(variant.Value, float | int) or not write.Value.StatusCode.is_good()
        return int(ua.StatusCodes.BadTypeMismatch) if bad else 0


def free_port(host: str) -> int:
    """A free port of an address; CzError if it is none of this machine."""
    try:
        with socket(AF_INET6 if ":" in host else AF_INET) as place:
            place.bind((host, 0))
            port: int = place.getsockname()[1]
            return port
    except OSError as error:
        raise CzError(f"{host}: {error.strerror or error}") from None


class Tags:
    """The server with the machine's tags; :meth:`publish` shows new values."""

    def __init__(self, machine: Machine, access: AccessControl, host: str, certificates: Path, port: int) -> None:
        self.machine, self.access, self.certificates = machine, access, certificates
        self.server = Server(user_manager=access)
        self.endpoint = f"opc.tcp://{in_address(host)}:{port or free_port(host)}/"
        self.nodes: dict[str, ua.NodeId] = {}

    async def __aenter__(self) -> "Tags":
        server, aspace = self.server, self.server.iserver
        await server.init()
        server.set_endpoint(self.endpoint)
        server.name = "Cz-v0 virtual puller"
        await server.set_application_uri(URI)
        aspace.max_connections = MOST_CLIENTS
        if self.access.remote:
            await server.load_certificate(self.certificates / "certificate.pem")
            await server.load_private_key(self.certificates / "key.pem")
            server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
            server.set_identity_tokens([ua.UserNameIdentityToken])
        else:
            server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
            server.set_identity_tokens([ua.AnonymousIdentityToken, ua.UserNameIdentityToken])
        space = await server.register_namespace(f"{URI}:tags")
        puller = await server.nodes.objects.add_object(ua.NodeId("tags", space), f"{space}:Puller")
        values = self.machine.hour[-1]
        for tag in self.machine.tags:
            node_id = self.nodes[tag.name] = ua.NodeId(tag.name, space)
            node = await puller.add_variable(node_id, f"{space}:{tag.name}", values[tag.name], KINDS[tag.kind])
            await self._describe(node, tag, space)
            if tag.writable:
                await node.set_writable()
        names = {node_id: name for name, node_id in self.nodes.items()}
        aspace.attribute_service = Writes(server, self.machine, self.access, names)
        try:
            await server.start()
        except OSError as error:
            raise CzError(f"{self.endpoint}: {error.strerror or error}") from None
        print(f"OPC UA: {self.endpoint}", flush=True)
        return self

    async def _describe(self, node: Any, tag: Tag, space: int) -> None:
        """Write what a tag means, its unit and its range."""
        await node.write_attribute(ua.AttributeIds.Description, ua.DataValue(ua.LocalizedText(tag.meaning)))
        properties: dict[str, Any] = {}
        for unit, code in (each for end, each in UNITS.items() if tag.name.endswith(end)):
            text = ua.LocalizedText(unit)
            properties["EngineeringUnits"] = ua.EUInformation(CODES, int.from_bytes(code.encode(), "big"), text, text)
        if span := self.machine.spans.get(tag.name):
            properties["EURange"] = ua.Range(*span)
        for name, value in properties.items():
            await node.add_property(ua.NodeId(f"{tag.name}.{name}", space), ua.QualifiedName(name, 0), value)
        if properties:
            await node.delete_reference(ua.ObjectIds.BaseDataVariableType, ua.ObjectIds.HasTypeDefinition)
            await node.add_reference(ua.ObjectIds.BaseAnalogType, ua.ObjectIds.HasTypeDefinition, bidirectional=False)

    async def __aexit__(self, *_: object) -> None:
        await self.server.stop()

    async def publish(self, values: dict[str, Any]) -> None:
        """Show values; ``step`` comes last, so that whoever sees a new step sees all that belongs to it."""
        now = datetime.now(UTC)
        for tag in self.machine.tags:
            value = data_value(tag.kind, values[tag.name], now)
            await self.server.write_attribute_value(self.nodes[tag.name], value)


def data_value(kind: type, value: Any, now: datetime | None = None) -> ua.DataValue:
    """The value of a tag in the type that the tag has."""
    return ua.DataValue(ua.Variant(kind(value), KINDS[kind]), SourceTimestamp=now, ServerTimestamp=now)


def in_address(host: str) -> str:
    """The host as an address has it: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


async def certify(folder: Path) -> None:
    """Make ``certificate.pem`` and ``key.pem`` in a folder that has neither.

    CzError if it has only one, or if these cannot serve: expired, locked, not a pair, or not of RSA.
    """
    certificate, key = folder / "certificate.pem", folder / "key.pem"
    if certificate.is_file() != key.is_file():
        raise CzError(f"{folder} must hold both certificate.pem and key.pem, or neither")
    if certificate.is_file():
        check_pair(certificate, key)
        return
    mask = os.umask(0o077)
    try:
        with name_file_in_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder)
        use, der = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH], folder / "certificate.der"
        await setup_self_signed_certificate(key, der, URI, gethostname(), use, {"commonName": "Cz-v0 virtual puller"})
        certificate.write_text(ssl.DER_cert_to_PEM_cert(der.read_bytes()))
        der.unlink()
    finally:
        os.umask(mask)


def check_pair(certificate: Path, key: Path) -> None:
    """Raise CzError unless a certificate is valid now, and this is its key, of RSA, without a password."""
    with name_file_in_errors(certificate):
        shown = certificate.read_bytes()
    with name_file_in_errors(key):
        hidden = key.read_bytes()
    try:
        public = x509.load_pem_x509_certificate(shown)
    except ValueError:
        raise CzError(f"{certificate}: not a certificate in PEM") from None
    try:
        private = load_pem_private_key(hidden, None)
    except TypeError:
        raise CzError(f"{key}: locked by a password, which this server cannot ask for") from None
    except (ValueError, UnsupportedAlgorithm):
        raise CzError(f"{key}: not a private key in PEM") from None
    if private.public_key() != public.public_key():
        raise CzError(f"{key} is not the key of {certificate}")
    if not isinstance(private, RSAPrivateKey):
        raise CzError(f"{key}: OPC UA's Basic256Sha256 needs a key of RSA")
    now, first, last = datetime.now(UTC), public.not_valid_before_utc, public.not_valid_after_utc
    if not first <= now <= last:
        said = f"expired on {last:%Y-%m-%d}" if now > last else f"is not valid before {first:%Y-%m-%d}"
        raise CzError(f"{certificate} {said}: without both files new ones are made")


def password(role: str) -> str:
    """The password of a role, from its environment variable; CzError if it is too short."""
    variable = f"CZ_GYM_{role.upper()}_PASSWORD"
    given = os.environ.get(variable, "")
    if len(given) < SHORTEST:
        raise CzError(f"--{role} needs a password of at least {SHORTEST} characters in the variable {variable}")
    return given


async def publish_tags(tags: Tags, queue: asyncio.Queue[dict[str, Any]], clock: Clock) -> None:
    """Publish what the plant's thread sends; raises its error once it fails."""
    while values := await queue.get():
        await tags.publish(values)
    raise clock.error or RuntimeError("the clock sent no tags")


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
            web.get("/", self._html), web.get("/data", self._data), web.get("/crystal.png", self._crystal),
            web.get("/login", self._login), web.post("/setpoints", self._write),
        ])  # fmt: skip
        self._runner = web.AppRunner(app, access_log=None)
        self._picture: tuple[int, bytes] = -1, b""

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
        """True if a Host header names this server: an address, or a name that another site cannot point here."""
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
