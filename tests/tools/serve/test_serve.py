"""The OPC UA server, the page and a controller over it: who may do what, and what clients cannot break."""

import asyncio
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa

from cz_gym.baselines.clairvoyant import episodes_of
from cz_gym.config import make_config
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.errors import CzError
from cz_gym.support.units import KILO, MM, MM_PER_MIN
from cz_gym.tools import serve
from cz_gym.tools.export.block import SETPOINT_NAMES
from cz_gym.tools.export.controllers import make_block
from cz_gym.tools.export.shell import BlockPolicy
from cz_gym.tools.identify.log import read_log
from cz_gym.tools.serve.opcua import certify
from examples import opcua_controller
from tests.conftest import ROOT
from tests.tools.serve.conftest import PASSWORD, answer, connected, free_port, running, with_client

from asyncua import ua  # isort: skip

PULL, HEATER = SETPOINT_NAMES


@pytest.fixture(scope="module")
def puller(tmp_path_factory):
    """A puller on the loopback, 200 times as fast as real, for everybody."""
    with running(tmp_path_factory.mktemp("open"), "--speed", "200", "--hours", "1000") as one:
        yield one


@pytest.fixture(scope="module")
def locked(tmp_path_factory):
    """A puller with accounts, as strict as one that listens on another address."""
    patch = pytest.MonkeyPatch()
    for role in ("OPERATOR", "READER"):
        patch.setenv(f"CZ_GYM_{role}_PASSWORD", PASSWORD)
    users = ("--operator", "olga", "--reader", "rita")
    with running(tmp_path_factory.mktemp("locked"), *users, "--speed", "20", remote=True) as one:
        yield one
    patch.undo()


def test_values_of_wrong_type_or_size_are_refused_and_logged(puller):
    async def act(hand):
        low, high = puller.machine.limits[PULL]
        for bad in (np.nan, np.inf, low - 1.0, high + 1.0):
            assert await hand.write(**{PULL: bad}) == ["BadOutOfRange"]
        for wrong in ("1.2", [1.2, 1.3], None, True):
            assert await hand.write(**{PULL: ua.Variant(wrong)}) == ["BadTypeMismatch"], wrong
        assert await hand.write(watchdog=ua.Variant(7.0)) == ["BadTypeMismatch"]
        for name, value in (("ring_radius_mm", 100.0), ("step", 7), ("state", "growing")):
            assert await hand.write(**{name: value}) == ["BadUserAccessDenied"]
        assert await hand.write(**answer(await hand.read("step") + 1000)) == ["BadInvalidState"] * 2 + ["BadOutOfRange"]
        assert await hand.write(**answer(await hand.read("step"), heater=np.nan)) == [
            "BadInvalidState", "BadOutOfRange", "BadInvalidState",
        ]  # fmt: skip
        assert low <= await hand.read(PULL) <= high, "nothing that was refused is kept"

    with_client(puller.url, act)
    assert any(f"{HEATER} = nan" in line for line in puller.access.events)


@pytest.mark.parametrize(("kind", "value"), [("Float", 1.31), ("Double", 1.32), ("Int16", 1), ("UInt64", 2)])
def test_setpoints_of_every_numeric_type_are_taken(puller, kind, value):
    async def act(hand):
        setpoints = {PULL: ua.Variant(value, ua.VariantType[kind]), HEATER: 57.0}
        assert await hand.write(**setpoints) == ["Good"] * 2
        shown = await hand.nodes[PULL].read_data_value()
        for _ in range(100):  # the step that is shown may lag behind the one that the last client answered
            step = ua.Variant(await hand.read("step"), ua.VariantType.Int32)
            if await hand.write(watchdog=step) == ["Good"]:
                return shown
            await asyncio.sleep(0.05)

    shown = with_client(puller.url, act)
    assert shown.Value.VariantType == ua.VariantType.Double
    wait_until(lambda: any(row[PULL] == pytest.approx(value, rel=1e-6) for row in [*puller.machine.hour]))


def test_tags_say_their_units_and_ranges(puller):
    async def act(hand):
        async def about(name):
            parts = [await each.read_value() for each in await hand.nodes[name].get_properties()]
            unit = ua.EUInformation
            return [each.DisplayName.Text if isinstance(each, unit) else (each.Low, each.High) for each in parts]

        assert await about("step") == []
        assert await about("watchdog_s") == ["s"]
        span = tuple(puller.machine.limits[PULL])
        assert await about(PULL) == await about("pull_speed_mm_per_min") == ["mm/min", span]
        unit, (low, high) = await about("T_1_K")
        assert unit == "K"
        assert low < await hand.read("T_1_K") < high
        return await (await hand.nodes[PULL].get_child("0:EngineeringUnits")).read_value()

    assert with_client(puller.url, act).UnitId == 4732977, "UNECE code H81, millimetres per minute"


def test_ten_clients_at_once_of_which_one_floods_and_no_step_is_late(puller):
    async def reads(hand):
        seen = set()
        for _ in range(50):
            values = await hand.client.read_values([hand.nodes["time_s"], hand.nodes["step"]])
            assert values[0] == pytest.approx(5.0 * values[1])
            seen.add(values[1])
            await asyncio.sleep(0.01)
        return len(seen)

    async def floods(hand):
        refused = 0
        for _ in range(100):
            codes = await asyncio.gather(*(hand.write(**{PULL: 99.0}) for _ in range(10)))
            refused += codes.count(["BadOutOfRange"])
        return refused

    async def all_of_them():
        acts = [reads] * 9 + [floods]
        return await asyncio.gather(*(connected(puller.url, act) for act in acts))

    begin, first = time.monotonic(), puller.machine.k
    found = asyncio.run(all_of_them())
    expected = (time.monotonic() - begin) * 40.0
    assert puller.machine.k - first == pytest.approx(expected, abs=40)
    assert min(found[:9]) > 5
    assert found[9] == 1000
    assert len(puller.access.events) <= 100


def test_a_client_that_dies_in_the_middle_of_a_message_leaves_all_as_it_was(puller):
    async def takes(hand):
        step = await hand.read("step")
        assert await hand.write(**answer(step, 1.25, 57.2)) == ["Good"] * 3
        await hand.write(**{PULL: 2.0})  # half of what it meant to say
        return step

    first = with_client(puller.url, takes)
    for message in (b"HELF\x40\x00\x00\x00half", b"MSGF" + b"\xff" * 4, os.urandom(4096), b""):
        with socket.create_connection(("127.0.0.1", puller.port)) as one:
            one.sendall(message)
    wait_until(lambda: puller.machine.control == "fallback")
    before = puller.machine.k
    wait_until(lambda: puller.machine.k >= before + 40)
    rows = [row for row in puller.machine.hour if row["step"] > first + 1]
    assert {row["control"] for row in rows} <= {"client", "held", "fallback"}
    told = [row[PULL] for row in rows if row["control"] != "fallback"]  # the PID may well pull as fast for a while
    assert told
    assert max(told) < 1.9, "2.0 was never committed"
    assert with_client(puller.url, lambda hand: hand.read("control")) == "fallback"


def wait_until(holds):
    until = time.monotonic() + 30.0
    while not holds():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_the_page_is_read_only_on_a_puller_without_accounts(puller):
    data = json.load(urllib.request.urlopen(f"http://127.0.0.1:{puller.page}/data"))
    assert (data["user"], data["writes"], data["accounts"]) == ("", False, False)
    assert [row["step"] for row in data["hour"]] == list(range(data["hour"][0]["step"], data["now"]["step"] + 1))
    picture = urllib.request.urlopen(f"http://127.0.0.1:{puller.page}/crystal.png").read()
    assert picture.startswith(b"\x89PNG")
    assert posted(f"http://127.0.0.1:{puller.page}", {})[0] == 403


def posted(page, body, user="", kind="application/json", context=None):
    return asked(f"{page}/setpoints", json.dumps(body).encode(), user, {"Content-Type": kind}, context)


def asked(url, body=None, user="", headers=None, context=None):
    """Status and text of an answer of the page."""
    import base64

    headers = dict(headers or {})
    if user:
        headers["Authorization"] = "Basic " + base64.b64encode(f"{user}:{PASSWORD}".encode()).decode()
    try:
        with urllib.request.urlopen(urllib.request.Request(url, body, headers), context=context) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


@pytest.mark.parametrize("after", ["x", "1.5", "", "9" * 5000])
def test_a_bad_query_is_answered_in_one_line(puller, caplog, after):
    """bottle #654: the answer was 500, with a traceback in the log."""
    answer = 400, "after must be the number of a step"
    assert asked(f"http://127.0.0.1:{puller.page}/data?after={after}") == answer
    assert "Traceback" not in caplog.text


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:80", 200), ("localhost", 200), ("[::1]:8080", 200), ("192.168.1.7", 200),
        ("attacker.example", 421), ("127.0.0.1.nip.io:8080", 421), ("[::1", 421),
    ],
)  # fmt: skip
def test_a_name_that_is_not_this_server_reads_nothing(puller, host, status):
    """DNS rebinding: another site points its name at this machine, and its page asks for the tags."""
    assert asked(f"http://127.0.0.1:{puller.page}/data", headers={"Host": host})[0] == status


@pytest.mark.slow
def test_ipv6_has_brackets_in_addresses(tmp_path, capsys):
    """opcua-asyncio #1129."""
    with running(tmp_path, "--host", "::1", "--speed", "20") as puller:
        url, page = f"opc.tcp://[::1]:{puller.port}/", f"http://[::1]:{puller.page}/"
        assert capsys.readouterr().out.split() == ["OPC", "UA:", url, "page:", page]
        assert with_client(url, lambda hand: hand.read("state")) == "growing"
        assert asked(f"{page}data")[0] == 200


def test_elsewhere_nobody_reads_without_an_account_and_encryption(locked):
    for user, password in (("", ""), ("olga", "wrong horse"), ("nobody", PASSWORD)):
        with pytest.raises((ua.UaError, ConnectionError, TimeoutError)):
            encrypted(locked, lambda hand: hand.read("step"), user, password)
    with pytest.raises((ua.UaError, ConnectionError, TimeoutError)):
        with_client(locked.url, lambda hand: hand.read("step"), "olga")
    assert any("login as 'olga'" in line for line in locked.access.events)


def test_a_reader_reads_and_an_operator_writes(locked):
    async def act(hand):
        step = await hand.read("step")
        return step, await hand.write(**answer(step))

    assert encrypted(locked, act, "rita", PASSWORD)[1] == ["BadUserAccessDenied"] * 3
    assert encrypted(locked, act, "olga", PASSWORD)[1] == ["Good"] * 3
    assert any(line.endswith(f"reader rita: {PULL} = 1.2: BadUserAccessDenied") for line in locked.access.events)
    files = {file.name: file.stat().st_mode & 0o077 for file in (locked.folder / "certificates").iterdir()}
    assert files == {"certificate.pem": 0, "key.pem": 0}


def encrypted(puller, act, user, password):
    return with_client(puller.url, act, user, password, puller.folder / "certificates")


def test_the_page_elsewhere_is_encrypted_and_only_an_operator_sets_drives(locked):
    import ssl

    context = ssl.create_default_context(cafile=str(locked.folder / "certificates" / "certificate.pem"))
    context.check_hostname = False
    page, wanted = f"https://127.0.0.1:{locked.page}", {PULL: 1.3, HEATER: 57.0}
    with pytest.raises(urllib.error.HTTPError, match="401"):
        urllib.request.urlopen(f"{page}/data", context=context)
    assert posted(page, wanted, context=context)[0] == 401
    assert posted(page, wanted, "rita", context=context)[0] == 403
    assert posted(page, wanted, "olga", "text/plain", context)[0] == 403, "what another site's form could send"
    for bad in ({PULL: 1.3}, {PULL: "1.3", HEATER: 57.0}, [1.3], None):
        assert posted(page, bad, "olga", context=context) == (400, "two numbers, or none")
    for bad in (b"{", b"", b"\xff", b"[" * 999):
        headers = {"Content-Type": "application/json; charset=none"}
        assert asked(f"{page}/setpoints", bad, "olga", headers, context) == (400, "two numbers, or none")
    assert posted(page, {PULL: 99.0, HEATER: 57.0}, "olga", context=context) == (400, f"{PULL}: outside 0 to 2.4")
    assert posted(page, wanted, "olga", context=context) == (200, "")
    assert locked.machine.control == "manual"
    assert posted(page, {}, "olga", context=context)[0] == 200


@pytest.mark.slow
def test_a_killed_server_leaves_a_whole_log_and_goes_on_with_the_same_crystal(tmp_path):
    log = tmp_path / "log.csv"
    options = ["--speed", "2000", "--port", str(free_port()), "--page-port", "0", "--log", str(log)]
    command_line = [sys.executable, "-m", "cz_gym", "serve", *options, "--state", str(tmp_path / "state")]

    def killed_at(rows):
        server = subprocess.Popen(command_line, cwd=ROOT, stdout=subprocess.PIPE)
        try:
            assert server.stdout is not None
            server.stdout.readline()
            until = time.monotonic() + 60.0
            while (before := log.read_bytes().count(b"\n") if log.exists() else 0) < rows and time.monotonic() < until:
                time.sleep(0.05)
        finally:
            server.send_signal(signal.SIGKILL)
            server.wait()
            server.stdout.close()
        assert log.read_bytes().endswith(b"\n")
        return before

    first = killed_at(500)
    assert killed_at(first + 500) >= first + 500
    rows = read_log(log)
    assert np.array_equal(rows.time, 5.0 * np.arange(len(rows.time)))
    assert rows.notes == ()


def test_it_listens_on_the_loopback_unless_told_and_elsewhere_only_with_a_user(refused, monkeypatch):
    assert serve.commands().parse_args([]).host == "127.0.0.1"
    for host in ("0.0.0.0", "::", "192.168.1.7", "puller.local"):
        assert "--operator and its password are needed" in refused(serve.main, ["--host", host])
    monkeypatch.delenv("CZ_GYM_OPERATOR_PASSWORD", raising=False)
    assert "CZ_GYM_OPERATOR_PASSWORD" in refused(serve.main, ["--host", "0.0.0.0", "--operator", "olga"])
    monkeypatch.setenv("CZ_GYM_OPERATOR_PASSWORD", "short")
    assert "at least 8 characters" in refused(serve.main, ["--operator", "olga"])
    assert re.search("did you mean", refused(serve.main, ["--scenario", "pulller"]))
    assert "did you mean 'whole'?" in refused(serve.main, ["--stage", "whol"])
    assert "stage = 9 m begins outside of the crystal" in refused(serve.main, ["--stage", "9"])


def test_a_port_that_is_taken_and_half_a_certificate_are_said_in_one_line(puller, refused, tmp_path, monkeypatch):
    wait_until((puller.folder / "log.csv").exists)
    assert "log.csv: File exists" in refused(serve.main, ["--log", str(puller.folder / "log.csv")])
    taken = ["--port", str(puller.port), "--page-port", "0", "--log", str(tmp_path / "new.csv")]
    assert "address already in use" in refused(serve.main, taken).lower()
    assert not (tmp_path / "new.csv").exists(), "it would stand in the corrected command's way"
    monkeypatch.setenv("CZ_GYM_OPERATOR_PASSWORD", PASSWORD)
    (tmp_path / "key.pem").touch()
    options = ["--host", "0.0.0.0", "--operator", "olga", "--certificates", str(tmp_path)]
    assert "both certificate.pem and key.pem" in refused(serve.main, options)
    for place in (tmp_path / "key.pem", Path("/proc/none")):
        assert str(place) in refused(serve.main, [*options[:-1], str(place)])
    assert "--log-size divides" in refused(serve.main, ["--log-size", "5"])


def pair(folder, days=(-1, 1), kind="rsa", secret=None, other=False, damaged=None):
    """A certificate and a key in a folder, as openssl would make them."""
    make = {"rsa": lambda: rsa.generate_private_key(65537, 2048), "ec": lambda: ec.generate_private_key(ec.SECP256R1())}
    own, now = make[kind](), datetime.now(UTC)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "a")])
    builder = x509.CertificateBuilder(name, name, own.public_key(), 7)
    first, last = (now + timedelta(days=day) for day in days)
    signed = builder.not_valid_before(first).not_valid_after(last).sign(own, hashes.SHA256())
    (folder / "certificate.pem").write_bytes(signed.public_bytes(serialization.Encoding.PEM))
    lock = serialization.BestAvailableEncryption(secret) if secret else serialization.NoEncryption()
    form = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, lock
    (folder / "key.pem").write_bytes((make[kind]() if other else own).private_bytes(*form))
    if damaged:
        (folder / damaged).write_bytes(b"\x00\x01")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"days": (-9, -2)}, r"certificate\.pem expired on \d{4}-\d\d-\d\d"),
        ({"days": (2, 9)}, r"certificate\.pem is not valid before"),
        ({"other": True}, r"key\.pem is not the key of .*certificate\.pem"),
        ({"secret": b"secret"}, r"key\.pem: locked by a password"),
        ({"kind": "ec"}, r"key\.pem: OPC UA's Basic256Sha256 needs a key of RSA"),
        *(({"damaged": name}, f"{name}: not a") for name in ("certificate.pem", "key.pem")),
    ],
)
def test_a_certificate_that_no_client_could_trust_is_refused(tmp_path, given, says):
    pair(tmp_path)
    asyncio.run(certify(tmp_path))
    pair(tmp_path, **given)
    with pytest.raises(CzError, match=says) as caught:
        asyncio.run(certify(tmp_path))
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_port_0_is_a_free_one_that_is_named(tmp_path, capsys):
    with running(tmp_path, "--port", "0"):
        url = re.search(r"OPC UA: (\S+)", capsys.readouterr().out)[1]
        assert with_client(url, lambda hand: hand.read("step")) >= 0
    assert not url.endswith(":0/")


# The controller over OPC UA

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="cc is not installed: no C can be compiled")


@pytest.mark.parametrize(
    ("name", "scenario", "options", "steps"),
    [
        pytest.param("paper", "randomized", (), 200, marks=pytest.mark.slow),
        pytest.param("ppo", "puller", (), 100, marks=pytest.mark.slow),
        ("paper", "puller", (), 40),
        pytest.param("gradient", "puller", ("--compiled",), 200, marks=(needs_compiler, pytest.mark.slow)),
        pytest.param("paper", "randomized", (), 2160, marks=pytest.mark.slow),
    ],
)
def test_the_loop_over_opc_ua_is_the_loop_in_python(name, scenario, options, steps, tmp_path):
    """To the float32 of observations and of the twin's actions."""
    with running(tmp_path, "--speed", "0", "--scenario", scenario) as puller:
        chosen = ["--controller", name, "--scenario", scenario, "--steps", str(steps), *options]
        assert opcua_controller.main(["--url", puller.url, *chosen]) == 0
        rows = np.genfromtxt(tmp_path / "log.csv", delimiter=",", names=True)[1:]
    shown = "ring_radius_mm", "pull_speed_mm_per_min", "heater_power_kW"
    found = np.stack([rows[name] for name in shown], axis=-1)
    config = make_config(scenario, observation="measured", action="direct", horizon=steps * 5.0)
    s = rollout(BlockPolicy(make_block(name, config)), config, [1]).signals
    (e,) = episodes_of(config, [1])  # its drives are read with these errors
    read = e.pull_scale * s.v_p / MM_PER_MIN, e.heater_scale * s.Q_H / KILO
    twin = np.concatenate([s.r_br_measured / MM, *read], axis=-1)
    assert len(found) >= steps - 1
    np.testing.assert_allclose(found, twin[: len(found)], rtol=0, atol=5e-6)


def test_it_logs_in_over_an_encrypted_channel(tmp_path, monkeypatch):
    monkeypatch.setenv("CZ_GYM_OPERATOR_PASSWORD", PASSWORD)
    with running(tmp_path, "--operator", "olga", "--speed", "0", remote=True) as puller:
        login = ["--operator", "olga", "--encrypt", str(tmp_path / "certificates" / "certificate.pem")]
        own = ["--certificates", str(tmp_path / "client"), "--steps", "3"]
        assert opcua_controller.main(["--url", puller.url, *login, *own]) == 0
        assert puller.machine.answered == 2
    assert sorted(os.listdir(tmp_path / "client")) == ["certificate.pem", "key.pem"]


def test_a_server_that_is_not_there_and_a_controller_that_is_not_are_said_in_one_line(refused):
    assert "127.0.0.1" in refused(opcua_controller.main, ["--url", "opc.tcp://127.0.0.1:9/"])
    assert "did you mean 'paper'" in refused(opcua_controller.main, ["--controller", "papr"])
