"""``cz-gym benchmark``: what it writes, what it refuses to overwrite, and one line for every mistake."""

import csv
import json
import pickle
import re
import shlex
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from cz_gym import HURLE, agents
from cz_gym.agents import shipped_names
from cz_gym.agents.contract import write_agent
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import SPEED, Metrics, names_of
from cz_gym.evaluation.parallel import run_tasks
from cz_gym.evaluation.protocol import CASES, TEST_SEEDS, find_case, find_cases
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.spaces import OBSERVATIONS
from cz_gym.support.errors import CzError
from cz_gym.tools import benchmark, run
from cz_gym.tools.episodes import read_episodes, values_of
from cz_gym.tools.registry import CONTROLLERS
from cz_gym.tools.run import check_targets
from tests.conftest import python
from tests.contracts import LINEAR, facts, model_of
from tests.observed import PLAIN

FILES = ["benchmark.json", "crystal.png", "episodes.csv", "pareto.svg", "report.html", "report.md", "result.svg"]
SMALL = ["--episodes", "3", "--scenarios", "randomized,reference-b", "--controllers", "open-loop,paper"]
ONE = ["--scenarios", "reference-b", "--controllers", "open-loop", "--quiet"]


def constant_agent(path, observation="measured", **changes):
    """An agent file that always answers with the nominal drives."""
    channels = len(OBSERVATIONS[observation])
    weights = {"weight": np.zeros((channels, 2), np.float32), "bias": np.zeros(2, np.float32)}
    write_agent(path, model_of([LINEAR], weights, channels).SerializeToString(), **facts(observation, **changes))
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a small run: two controllers and an agent of two training seeds, both as good as nothing."""
    folder = tmp_path_factory.mktemp("benchmark")
    agents = [f"--agent={constant_agent(folder / f'{seed}.onnx', training_seed=seed)}" for seed in (3, 8)]
    out = folder / "out"
    assert benchmark.main([*SMALL, "--out", str(out), "--json", str(folder / "copy.json"), "--quiet", *agents]) == 0
    return out


@pytest.fixture(scope="module")
def data(finished):
    return json.loads((finished / "benchmark.json").read_text())


@pytest.fixture
def no_work(monkeypatch):
    def refuse(*arguments):
        raise AssertionError("work was done")

    monkeypatch.setattr(run, "rollout", refuse)


@pytest.fixture
def refusal(refused):
    """The one line with which a command line is refused."""
    return partial(refused, benchmark.main)


def contenders(*arguments):
    given = benchmark.parse(arguments)
    return benchmark.contenders_of(given, benchmark.cases_of(given))


def test_default_contenders_are_those_of_the_registry_and_the_shipped_agents():
    usual = [each.name for each in CONTROLLERS if each.default] + shipped_names()
    assert [each.name for each in contenders()] == usual
    (gradient,) = contenders("--controllers", "gradient")
    assert len(gradient.trained) == len(agents.shipped_seeds("gradient"))


def test_the_folder_holds_every_file_and_nothing_else(finished):
    assert sorted(path.name for path in finished.iterdir()) == FILES
    assert (finished.parent / "copy.json").read_bytes() == (finished / "benchmark.json").read_bytes()
    report = (finished / "report.md").read_text()
    assert report.startswith("No verdict: 3 crystals, ")
    for image, begins in (("crystal.png", b"\x89PNG\r\n\x1a\n"), ("result.svg", b"<svg "), ("pareto.svg", b"<svg ")):
        assert (finished / image).read_bytes().startswith(begins)
        assert f"]({image})" in report


@pytest.fixture(scope="module")
def crystals(tmp_path_factory):
    """The folder of a small run of whole crystals' stages."""
    out = tmp_path_factory.mktemp("crystals") / "out"
    small = ["--episodes", "3", "--scenarios", "crown,tail-puller", "--controllers", "recipe,ring-pid,true-radius"]
    assert benchmark.main(["--env", "CzCrystal-v0", *small, "--out", str(out), "--quiet"]) == 0
    return out


@pytest.mark.slow
def test_stages_of_whole_crystals_have_the_same_report_with_metrics_of_their_own(crystals):
    assert sorted(path.name for path in crystals.iterdir()) == FILES
    data, report = json.loads((crystals / "benchmark.json").read_text()), (crystals / "report.md").read_text()
    assert list(data["results"]) == ["crown", "tail-puller"]
    found = data["results"]["crown"]["recipe"]
    assert (found["failure_rate"]["mean"], found["frozen"]["mean"], found["lost_in_crown"]["mean"]) == (2 / 3, 0.0, 0.0)
    assert found["tail_max_mm"] == {"mean": None, "ci95": None, "n": 3}
    assert data["largest"]["crown"]["true-radius"]["crown_max_mm"]["mean"] < 1.0
    assert data["provenance"]["parameters"]["heater_max"] is None
    assert report.startswith("No verdict: 3 crystals, ")
    assert "| recipe | - | 2 off | - |" in report
    assert "| controller | lost of crown / tail-puller [%] | 95 % of crowns [mm] | body within 0.5 mm [%] |" in report


@pytest.mark.slow
def test_whole_crystals_are_quoted_in_two_pages(crystals, tmp_path, monkeypatch):
    pages = [tmp_path / "README.md", tmp_path / "crystal.md"]
    for page in pages:
        page.write_text(
            "a\n<!-- crystal:begin -->\n<!-- crystal:end -->\n<!-- benchmark:begin -->\n<!-- benchmark:end -->"
        )
    monkeypatch.setattr(benchmark, "RESULTS", tmp_path)
    monkeypatch.setattr(benchmark, "PAGES", pages)
    monkeypatch.setattr(benchmark, "is_partial", lambda *_: False)
    small = ["--scenarios", "crown-nominal", "--controllers", "recipe", "--quiet"]
    assert benchmark.main(["--env", "CzCrystal-v0", *small]) == 0
    for page in pages:
        assert "| recipe | 0.00 | 0." in page.read_text()
        assert page.read_text().endswith("<!-- benchmark:begin -->\n<!-- benchmark:end -->")


@pytest.mark.slow
def test_processes_side_by_side_find_the_same(finished, tmp_path, monkeypatch):
    """All but the time in the policies, which is measured."""
    monkeypatch.setattr(run, "LONG", 0)
    agents = [f"--agent={finished.parent / f'{seed}.onnx'}" for seed in (3, 8)]
    assert benchmark.main([*SMALL, "--out", str(tmp_path / "apart"), "--quiet", *agents]) == 0
    assert (tmp_path / "apart" / "crystal.png").read_bytes() == (finished / "crystal.png").read_bytes()
    tables = (read_episodes(folder / "episodes.csv").drop(columns=SPEED) for folder in (tmp_path / "apart", finished))
    assert next(tables).equals(next(tables))
    ours, theirs = (json.loads((out / "benchmark.json").read_text()) for out in (tmp_path / "apart", finished))
    for part in ("paired", "cvar5", "verdicts"):
        assert ours[part] == theirs[part] != {}


def test_json_names_every_metric_of_everyone(data):
    """The agent does nothing, as open-loop does."""
    assert list(data["results"]) == ["randomized", "reference-b"]
    for name, scenario in data["results"].items():
        assert list(scenario) == ["open-loop", "paper", "ppo"]
        for controller, found in scenario.items():
            assert set(found) == {*names_of(Metrics), "microseconds_per_step"}
            for metric in names_of(Metrics):
                mean, interval, n = (found[metric][part] for part in ("mean", "ci95", "n"))
                assert n == (3 if name == "randomized" else 1)
                if metric == "rmse_survivors_mm":
                    continue  # there may be no survivors
                assert (interval is not None) == (name == "randomized" or controller == "ppo")
                assert interval is None or interval[0] <= mean <= interval[1]
                assert scenario["ppo"][metric]["mean"] == pytest.approx(scenario["open-loop"][metric]["mean"])
    verdict = data["verdicts"]["reference-b"]["ppo"]
    assert (verdict["wins"], verdict["rival"]) == (False, "paper")


def test_every_episode_is_in_the_table_and_provenance_says_what_was_run(finished, data):
    with (finished / "episodes.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert {line["training_seed"] for line in lines if line["controller"] == "ppo"} == {"3", "8"}
    chosen = [line for line in lines if (line["scenario"], line["controller"]) == ("randomized", "paper")]
    assert [line["seed"] for line in chosen] == [str(seed) for seed in TEST_SEEDS[:3]]
    mean = np.mean([float(line["rmse_mm"]) for line in chosen])
    assert data["results"]["randomized"]["paper"]["rmse_mm"]["mean"] == pytest.approx(mean, rel=1e-4)
    assert list(data["paired"]["randomized"]) == ["open-loop", "ppo"]
    told = data["provenance"]
    assert told["plant_hash"] == make_config(**PLAIN).plant_hash
    assert told["scenarios"]["randomized"]["hash"] == make_config("randomized", **PLAIN).scenario.hash
    assert told["scenarios"]["randomized"]["first_seed"] == 2_000_000
    assert told["scenarios"]["reference-b"]["model"] == "I"
    assert [agent["training_seed"] for agent in told["agents"]] == [3, 8]
    assert "--episodes 3" in told["command"]


@pytest.mark.usefixtures("no_work")
def test_agent_files_that_cannot_be_used_get_one_line(tmp_path, refusal):
    broken = constant_agent(tmp_path / "broken.onnx")
    broken.write_bytes(b"not a model")
    assert "broken.onnx" in refusal(["--agent", str(broken)])
    strange = constant_agent(tmp_path / "strange.onnx", plant_hash="0" * 16)
    assert "plant 0000000000000000; the environment has" in refusal(["--agent", str(strange)])
    for given in ("ppo", "mine=ppo"):
        assert "ppo is shipped and runs by its name: --controllers ppo" in refusal(["--agent", given])
    fast = str(constant_agent(tmp_path / "fast.onnx"))
    slow = constant_agent(tmp_path / "slow.onnx", control_interval=10.0)
    line = refusal(["--agent", str(slow)])
    assert "agent 'ppo' on randomized: OnnxPolicy: this controller or agent was made for" in line
    assert "control_interval=5, plant" in refusal(["--agent", fast, "--scenarios", "randomized-2s"])
    twice = str(constant_agent(tmp_path / "twice.onnx"))
    assert "appears twice" in refusal(["--agent", twice, "--agent", twice])
    called = constant_agent(tmp_path / "called.onnx", algorithm="paper")
    assert "two controllers are called 'paper'" in refusal(["--agent", str(called)])
    other = constant_agent(tmp_path / "other.onnx", training_seed=1, scenario="hard", scenario_hash="0" * 16)
    assert "different scenarios: hard, randomized" in refusal(["--agent", twice, "--agent", str(other)])
    assert "choose from" in (line := refusal(["--agent", f"mine={twice}", "--controllers", "your"]))
    assert "clairvoyant, mine, gradient, ppo, ppo-plain, sac, or all" in line


def test_a_file_may_be_named_and_stand_beside_the_shipped_agents(tmp_path):
    """Each agent's line says the scenarios that it was trained on."""
    file = constant_agent(tmp_path / "some.onnx", algorithm="ppo")
    found = contenders("--controllers", "paper,mine,gradient", "--agent", f"mine={file}")
    assert [each.name for each in found] == ["paper", "mine", "gradient"]
    everything = "0.2 hard + 0.1 hot-zone + 0.3 puller + 0.1 randomized + 0.3 sensor-fault"
    trained_on = [each.meaning.partition(" on ")[2] for each in found[1:]]
    assert trained_on == ["randomized, given as a file", everything]
    assert [len(each.trained) for each in found] == [0, 1, len(found[2].training_seeds)]
    alone = contenders("--controllers", "paper", "--agent", str(file))
    assert [each.name for each in alone] == ["paper", "ppo"]
    names = ("a", Path("b=c.onnx")), ("", Path("x/a=b.onnx"))
    assert benchmark.parse(["--agent", "a=b=c.onnx", "--agent", "x/a=b.onnx"]).agent == [*names]


@pytest.mark.usefixtures("no_work")
def test_files_are_replaced_by_a_full_run_or_when_told_to(tmp_path, finished, monkeypatch, refusal):
    """For results named by every option, and for other files of the user."""
    monkeypatch.setattr(benchmark, "folder_of", lambda arguments: finished)
    results, page = finished / "benchmark.json", tmp_path / "report.html"
    page.write_text("precious")
    for arguments in ([], ["--out", str(finished)], ["--json", str(results)], ["--out", str(tmp_path)]):
        for some in (SMALL, ["--controllers", "paper"]):
            assert "exists. Use --out runs/NAME (--overwrite would replace it)" in refusal([*some, *arguments])
    for folder, lone in ((tmp_path, None), (None, page)):
        with pytest.raises(ValueError, match="--overwrite"):
            check_targets(folder, lone, partial=False, overwrite=False)
    for arguments in (["--json", str(page)], ["--out", str(finished)]):
        with pytest.raises(AssertionError, match="work was done"):
            benchmark.main([*SMALL, *arguments, "--overwrite", "--quiet"])
    check_targets(finished, None, partial=False, overwrite=False)


def test_a_full_run_is_quoted_in_the_readme(tmp_path, monkeypatch):
    """Full as measured by a smaller protocol; a partial run leaves the page alone."""
    page = tmp_path / "README.md"
    page.write_text("before\n<!-- benchmark:begin -->\nold\n<!-- benchmark:end -->\nafter\n")
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "benchmark.json").write_text("old")
    monkeypatch.setattr(benchmark, "folder_of", lambda arguments: tmp_path / "results")
    monkeypatch.setattr(benchmark, "PAGES", [page])
    assert benchmark.main([*ONE, "--overwrite"]) == 0
    assert "old" in page.read_text()
    monkeypatch.setattr(benchmark, "is_partial", lambda *_: False)
    assert benchmark.main(ONE) == 0
    text = page.read_text()
    assert text.startswith("before\n<!-- benchmark:begin -->\n")
    assert text.endswith("\n<!-- benchmark:end -->\nafter\n")
    assert "old" not in text
    results = json.loads((tmp_path / "results" / "benchmark.json").read_text())["results"]
    assert f"| open-loop | {results['reference-b']['open-loop']['rmse_mm']['mean']:.3f} |" in text
    assert (tmp_path / "results" / "report.md").read_text().startswith("No learned agent")


@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize("package", ["matplotlib", "tqdm", "onnxruntime"])
def test_a_missing_extra_is_named(package, tmp_path, monkeypatch, refusal):
    agent = constant_agent(tmp_path / "agent.onnx")
    monkeypatch.setitem(sys.modules, package, None)
    line = refusal([*SMALL, "--agent", str(agent), "--out", str(tmp_path / "out")])
    assert 'pip install ".[benchmark]"' in line
    assert package in line


@pytest.mark.slow
def test_the_benchmark_needs_neither_torch_nor_stable_baselines3(tmp_path):
    agent = constant_agent(tmp_path / "agent.onnx")
    arguments = [*ONE[:3], "paper", "--agent", str(agent), "--out", str(tmp_path / "out"), "--quiet"]
    loaded = "{'torch', 'stable_baselines3'} & {*sys.modules}"
    code = (
        f"import sys; from cz_gym_command import main; sys.exit(main({['benchmark', *arguments]!r}) or len({loaded}))"
    )
    python("-W", "error", "-c", code)
    report = (tmp_path / "out" / "report.md").read_text()
    assert report.startswith("By crystals lost, then by cost, the first is a classical controller on ")


def test_scenarios_are_named_by_one_option_in_lists_or_again_and_again(tmp_path, monkeypatch):
    """The older spelling of names stays accepted; names come before one's own, and a file's name may have a comma."""
    monkeypatch.chdir(tmp_path)
    for file in ("mine.py", "mine,too.py"):
        Path(file).write_text(MINE)
    for given, found in (
        (["--scenario", "hard"], ["hard"]),
        (["--scenarios", "hard, puller"], ["hard", "puller"]),
        (["--scenario", "mine.py:later,hard"], ["hard", "later"]),
        (
            ["--scenario", "mine,too.py:later", "--scenarios", "hard", "--scenario", "puller"],
            ["hard", "puller", "later"],
        ),
        ([], [case.name for case in CASES if case.default]),
    ):
        assert [row.name for row in benchmark.cases_of(benchmark.parse(given))] == found


def test_rows_have_the_settings_that_their_names_say():
    assert find_case("hard").seeds(7) == range(2_000_000, 2_000_007)
    assert len(find_case("reference-b").seeds(500)) == 1
    assert find_case("paper-ramp-II").config().mix == (0.0, 0.0)
    assert [case.name for case in find_cases("paper-ramp")] == ["paper-ramp-I", "paper-ramp-II"]
    assert [case.name for case in find_cases("randomized")] == ["randomized"]
    assert find_case("randomized-2s").config("history").control_interval == 2.0
    exact = find_case("randomized-exact")
    assert (exact.config().meniscus, exact.design_config().meniscus) == (YOUNG_LAPLACE, HURLE)


MINE = """
from dataclasses import dataclass, replace
import numpy as np
from cz_gym.episodes.scenarios import REFERENCE_B

@dataclass(frozen=True)
class Still:
    control_interval: float = 1.0
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        assert self.control_interval == 5.0
        return np.zeros((len(observation), 2), np.float32), state

still = Still(5.0)
def made(config): return Still(config.control_interval)
number = 3
later = replace(REFERENCE_B, name="later")
"""


@pytest.mark.slow
def test_one_s_own_controller_runs_beside_a_few_into_its_own_folder(tmp_path, monkeypatch, capsys, refusal):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(MINE)
    command = ["--scenarios", "reference-b", "--controller", "mine.py:Still"]
    assert benchmark.main(command) == 0
    assert capsys.readouterr().out.endswith("\nwrote runs/Still; open runs/Still/report.html\n")
    results = json.loads(Path("runs/Still/benchmark.json").read_text())["results"]["reference-b"]
    assert list(results) == ["paper", "paper-tuned", "lqg-at-0.02", "lqg-one-design", "Still"]
    assert "runs/Still/benchmark.json exists. Use --out runs/NAME" in refusal(command)
    monkeypatch.setattr(benchmark, "benchmark", lambda arguments, command: folders.append(arguments.out) or 0)
    folders = []
    benchmark.main([*ONE, "--agent", "some.onnx", "--scenario", "mine.py:later"])
    assert folders == [Path("runs/later-some")]


@pytest.mark.parametrize(
    "method",
    [
        pytest.param("spawn", marks=pytest.mark.slow),
        pytest.param("fork", marks=[pytest.mark.slow, pytest.mark.skipif("sys.platform == 'win32'")]),
    ],
)
def test_everything_of_a_benchmark_passes_to_other_processes_as_a_value(method, tmp_path, monkeypatch):
    """Controllers, agents, and code of one's own, which another process reads from its file again."""
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(MINE)
    own = [part for name in ("Still", "still", "made") for part in ("--controller", f"mine.py:{name}")]
    arguments = benchmark.parse([*own, "--scenario", "mine.py:later", "--controllers", "paper-tuned,lqg,ppo"])
    (row,) = benchmark.cases_of(arguments)
    tasks = [(each, row, row.seeds(1), tmp_path) for each in benchmark.contenders_of(arguments, [row])]
    monkeypatch.chdir("/")
    with ProcessPoolExecutor(1, get_context(method)) as pool:
        found = dict(run_tasks(pool, values, tasks))
    for number, task in enumerate(tasks):
        np.testing.assert_array_equal(found[number], values(task))
    assert pickle.loads(pickle.dumps([*CONTROLLERS, *CASES]))[-len(CASES) :] == [*CASES]


def values(task):
    return values_of(run.run_task(task)[0], names_of(Metrics))


def test_a_report_on_one_s_own_shows_it_and_prints_a_command_that_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my files").mkdir()
    mine = Path("my files/mine.py")
    mine.write_text(MINE)
    own = [part for name in ("Still", "still", "made") for part in ("--controller", f"{mine}:{name}")]
    command = ["--controllers", "open-loop,paper", *own, "--scenario", f"{mine}:later", "--out", "out", "--quiet"]
    assert benchmark.main(command) == 0
    results = json.loads(Path("out/benchmark.json").read_text())["results"]["later"]
    assert list(results) == ["open-loop", "paper", "Still", "still", "made"]
    assert len({each["rmse_mm"]["mean"] for name, each in results.items() if name != "paper"}) == 1
    told = re.search("`python (.*)` runs it", Path("out/report.md").read_text())
    assert told
    arguments = benchmark.parse(shlex.split(told[1])[1:])
    assert [row.name for row in benchmark.cases_of(arguments)] == ["later"]
    check_targets(arguments.out, arguments.json, True, arguments.overwrite)
    page, puller = Path("out/report.html").read_text(), make_config(**PLAIN).plant_hash
    assert "5 controllers, 1 scenario, up to 1 crystal each" in page
    for text in (page, Path("out/report.md").read_text()):
        assert f"on the default puller: radius 87.5 mm, pull speed 1.2 mm/min, plant {puller}." in text


@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--episodes", "0", "between 1 and 500, not 0"),
        ("--env", "Cz", "invalid choice: 'Cz'"),
        ("--scenarios=crow", "--env=CzCrystal-v0", "unknown scenario 'crow': did you mean 'crown'"),
        ("--controllers=paper", "--env=CzCrystal-v0", "'paper' is for Cz-v0: add --env Cz-v0"),
        ("--controllers=pid", "--env=CzCrystal-v0", "unknown controller 'pid'; choose from recipe, ring-pid"),
        ("--controllers", "gradient-along", "'gradient-along' is for CzCrystal-v0: add --env CzCrystal-v0"),
        ("--agent", str(agents.shipped("gradient-along")), "trained for CzCrystal-v0, not for Cz-v0: gym.make("),
        ("--tolerance=1", "--env=CzCrystal-v0", "beside --puller FILE.toml, of Cz-v0"),
        ("--controllers", "pid", "unknown controller 'pid'; choose from open-loop, paper"),
        ("--controllers", "paper,,ppo", "names with commas between"),
        ("--scenarios", "easy", "unknown scenario 'easy'; choose from randomized, hard"),
        ("--scenarios", "soon", "randomized-exact\n"),
        ("--scenario", "hard,mine.py:", "must be FILE.py:NAME, not 'mine.py:'"),
        ("--scenario", "mine.py:soon", "unknown scenario 'soon'; choose from later\n"),
        ("--agent", "nowhere.onnx", "nowhere.onnx: no such file"),
        ("--out", "mine.py/results", "not a folder"),
        ("--json", "/", "is a folder"),
        ("--controller", "mine.py", "must be FILE.py:NAME"),
        ("--controller", "mine.py:Stil", "controller 'Stil': did you mean 'Still'? Choose from Still, still, made\n"),
        ("--controller", "mine.py:number", "no controller"),
        ("--controller", "mine.py:later", "no controller"),
        ("--controller", "lqg.py:lqg", "two controllers are called 'lqg'"),
        ("--controller", "lqg.py:gradient", "two controllers are called 'gradient'"),
    ],
)
def test_a_wrong_command_is_refused_in_one_line(option, value, message, tmp_path, monkeypatch, refusal):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(MINE)
    Path("lqg.py").write_text(f"{MINE}\nlqg = gradient = still")
    line = refusal([option, value])
    assert line.startswith("cz-gym benchmark: ")
    assert message in line


RAISES = """
def helper():
    return [1, 2][7]

class Mine:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        {}

made = Mine()
"""


@pytest.mark.parametrize(
    ("body", "place", "line"),
    [("return helper(), state", "Mine", 3), ("observation + [1, 2, 3, 4, 5]", "made", 7), ("pass\n1 / 0", "Mine", 8)],
)
def test_a_bug_in_one_s_own_file_shows_its_file_and_line(body, place, line, tmp_path, monkeypatch):
    """Whether it is in ``predict`` or stops the import."""
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(RAISES.format(body))
    with pytest.raises((IndexError, ValueError, ZeroDivisionError)) as caught:
        benchmark.main(["--controllers", "open-loop", "--controller", f"mine.py:{place}", *ONE[:2], "--quiet"])
    assert not isinstance(caught.value, CzError)
    last = caught.traceback[-1]
    assert (Path(last.path).name, last.lineno + 1) == ("mine.py", line)
