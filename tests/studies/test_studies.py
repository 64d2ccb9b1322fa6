"""Studies on small runs: cards, frontier, leaderboard, speed, stock learners, robustness; README's first screen."""

import io
import json
import re
import shutil
import timeit
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import yaml
from PIL import Image

from cz_gym import agents, make_puller
from cz_gym.body.process import radius_model
from cz_gym.evaluation import protocol
from cz_gym.evaluation.protocol import CASES, TRAINING_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.tools import leaderboard
from cz_gym.tools.registry import agent_hash
from cz_gym.tools.report.task_records import contract_hash
from cz_gym.tools.run import earlier_robustness
from studies import cards, faults, frontier, picture, ranks, robustness, sensors, speed, stock
from tests.conftest import ROOT

FIGURES = {key: {"mean": 0.0, "ci95": [0.0, 0.5]} for key in (*(of.metric for of in cards.FIGURES), cards.RETURN)}


def test_every_shipped_agent_has_a_card_with_the_benchmark_s_figures(tmp_path):
    shipped = agents.shipped_names()
    assert set(shipped) <= set(cards.AGENTS)
    lost = {**FIGURES, "rmse_mm": {"mean": 1.25, "ci95": [1.0, 2.0]}, "failure_rate": {"mean": 0.25, "ci95": None}}
    results = {
        "hard": dict.fromkeys(cards.AGENTS, FIGURES),
        "puller": {**dict.fromkeys(cards.AGENTS, FIGURES), "ppo": lost},
    }
    (tmp_path / "benchmark.json").write_text(json.dumps({"results": results}))
    command = ["--benchmark", str(tmp_path / "benchmark.json"), "--out", str(tmp_path / "cards.md")]
    assert cards.main([*command, "--hub", str(tmp_path / "hub")]) == 0
    _, metadata, text = (tmp_path / "hub" / "ppo" / "README.md").read_text().split("---\n")
    (entry,) = yaml.safe_load(metadata)["model-index"]
    assert [result["dataset"]["name"] for result in entry["results"]] == ["Cz-v0 hard", "Cz-v0 puller"]
    assert text.startswith("\n# `ppo`")
    agents.OnnxPolicy.load(tmp_path / "hub" / "ppo" / "ppo-seed0.onnx")
    sections = (tmp_path / "cards.md").read_text().split("\n## ")[1:]
    assert [section.split("`")[1] for section in sections] == shipped
    for section in sections:
        fails = section.startswith("`ppo`")
        assert ("loses crystals of `puller`." in section) == fails
        assert ("| puller | 1.2500 [1.0000, 2.0000] |" in section) == fails


def test_results_without_the_shipped_agents_are_refused(tmp_path, refused):
    (tmp_path / "some.json").write_text('{"results": {"hard": {}}}')
    command = ["--benchmark", str(tmp_path / "some.json"), "--out", str(tmp_path / "cards.md")]
    assert "no results of gradient, ppo" in refused(cards.main, command)


def entry(activity, rmse):
    found = {"pull_step_rms_mm_per_min": activity, "rmse_mm": rmse, "return": -rmse}
    return {name: {"mean": value} for name, value in found.items()}


def test_a_benchmark_is_compared_at_equal_activity(tmp_path, capsys):
    scenario = {name: entry(a, 0.01 * a**-0.5) for name, a in (("lqg-at-0.005", 0.005), ("lqg-quiet", 0.02))}
    others = {"ppo": (0.01, 0.2), "calm": (0.001, 0.4), "lively": (0.03, 0.1), "wild": (0.01, 0.5)}
    scenario |= {name: entry(*pair) for name, pair in others.items()}
    file = tmp_path / "benchmark.json"
    file.write_text(json.dumps({"results": {"randomized": scenario, "nominal": {"ppo": entry(0.01, 0.2)}}}))
    assert frontier.main([str(file)]) == 0
    told = capsys.readouterr().out
    assert "| ppo | 0.0100 | 0.2000 | 2.000 | -0 |" in told
    assert "| calm | 0.0010 | 0.4000 | quieter than any LQG | -0 |" in told
    assert "| lively | 0.0300 | 0.1000 | 1.414, more active than any LQG (0.0200) | -0 |" in told
    assert "1.00 over the 3 controllers outside the reference family, 0.82 with its members" in told
    assert "Of 9 pairs whose ratios are more than 5% apart, the return ranks 8 as the ratio does." in told
    assert "## nominal\n\na frontier needs two settings" in told


def test_episodes_beside_a_benchmark_give_intervals_unless_they_are_of_another_run(tmp_path, capsys, refused):
    values = {"lqg-at-0.02": (0.02, 0.05), "lqg-quiet": (0.01, 0.07), "agent": (0.015, 0.06)}
    lines = ["scenario,controller,training_seed,seed,pull_step_rms_mm_per_min,rmse_mm"]
    lines += [f"randomized,{name},,{seed},{a},{e}" for name, (a, e) in values.items() for seed in (1, 2)]
    (tmp_path / "episodes.csv").write_text("\n".join(lines))
    path = tmp_path / "benchmark.json"
    path.write_text(json.dumps({"results": {"randomized": {name: entry(*pair) for name, pair in values.items()}}}))
    assert frontier.main([str(path), "--out", str(tmp_path / "ratios.md")]) == 0
    assert "| 1.044 [1.044, 1.044] | -0 |" in (tmp_path / "ratios.md").read_text()
    assert "| 1.044 [1.044, 1.044] | -0 |" in capsys.readouterr().out
    (tmp_path / "episodes.csv").write_text("\n".join([*lines[:-1], lines[-1].replace("0.06", "nan")]))
    assert "no episodes of a benchmark, or damaged" in refused(frontier.main, [str(path)])
    (tmp_path / "episodes.csv").write_text("\n".join(lines))
    path.write_text(path.read_text().replace("0.06", "0.0601"))
    assert "episodes.csv is of another run: agent on randomized" in refused(frontier.main, [str(path)])


MEAN = {"mean": 0.0125, "ci95": None}


@pytest.fixture
def submissions(tmp_path, monkeypatch):
    """A folder with one submission, the shipped PPO under another name, with a claim that is too good."""
    monkeypatch.setattr(protocol, "RANDOM_CASES", CASES[:1])
    monkeypatch.setattr(leaderboard, "CONTROLLERS", leaderboard.CONTROLLERS[:2])
    folder = tmp_path / "submissions" / "mine"
    folder.mkdir(parents=True)
    for file in agents.MODELS.glob("ppo-seed0.*"):
        shutil.copy(file, folder)
    results, contract = {"randomized": {"mine": {"rmse_mm": MEAN}}}, contract_hash(CASES[:1])
    claim = {"results": results, "provenance": {"contract": contract}}
    (folder / "benchmark.json").write_text(json.dumps(claim))
    return folder.parent


def test_a_claim_stands_beside_what_fresh_crystals_show(submissions, tmp_path):
    command = [str(submissions), "--episodes", "2", "--first-seed", "3000007", "--out", str(tmp_path)]
    assert leaderboard.main(command) == 0
    page = (tmp_path / "leaderboard.md").read_text()
    (line,) = (line for line in page.splitlines() if line.startswith("| open |"))
    cells = [cell.strip() for cell in line.split("|")]
    _, budget, place, name, told, seeds, lost, cost, here, claimed, contract, made, _ = cells
    assert (budget, place, name, told, seeds, claimed) == ("open", "1", "mine", "state, in training", "1", "0.013")
    assert (lost, contract) == ("0.00", "the same")
    assert 0.002 < float(cost) < 0.1
    assert made == f"`{agents.load(agents.MODELS / 'ppo-seed0.onnx').contract.hash[:12]}`"
    assert 0.02 < float(here.split()[0]) < 0.3
    assert "seeds 3000007 to 3000008" in page
    assert "| paper |" in page
    found = json.loads((tmp_path / "leaderboard.json").read_text())
    assert found["provenance"]["scenarios"]["randomized"]["first_seed"] == 3_000_007


@pytest.mark.parametrize(
    ("steps", "name"), [(1_048_576, "1 M"), (1_100_000, "5 M"), (5_242_880, "5 M"), (20_447_232, "20 M"), (6e7, "open")]
)
def test_an_agent_has_the_smallest_budget_that_its_longest_training_keeps(steps, name):
    """The recipe ppo, asked for 1, 5 and 20 million steps, ends with its update: after 2,048 x 64 x 4 steps each."""
    trained = [SimpleNamespace(contract=SimpleNamespace(training_steps=each)) for each in (9, steps)]
    assert leaderboard.budget(cast("Any", SimpleNamespace(trained=trained))) == name


def test_fresh_seeds_are_nobody_else_s():
    taken = {seed for row in CASES for seed in row.seeds(500)} | {TRAINING_SEEDS.stop}
    assert max(taken) < leaderboard.FRESH.start


def test_what_is_no_submission_is_named(submissions, tmp_path, refused):
    assert "no such" in refused(leaderboard.main, [str(tmp_path / "nowhere")]).lower()
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "no submissions" in refused(leaderboard.main, [str(empty)])
    for broken in ("", "[]", '{"results": {"randomized": {"mine": {"rmse_mm": {"mean": "x"}}}}}', '{"results": 1}'):
        (submissions / "mine" / "benchmark.json").write_text(broken)
        assert "is no benchmark.json" in refused(leaderboard.main, [str(submissions), "--out", str(tmp_path)])
    (submissions / "mine" / "benchmark.json").write_text('{"results": {"randomized": {}}}')
    assert "no results of 'mine'" in refused(leaderboard.main, [str(submissions), "--out", str(tmp_path)])


QUICK = {
    "Cz-v0 scalar": partial(gym.make, "Cz-v0"),
    "Pendulum-v1 scalar": partial(gym.make, "Pendulum-v1"),
    "Cz-v0 batch, measured, 2 threads": partial(speed.our_batch, 8, 2),
    "bare compiled plant and ring, 1 thread": partial(speed.bare_plant, 8, 1),
}


@pytest.fixture
def one_call(monkeypatch):
    monkeypatch.setattr(timeit.Timer, "autorange", lambda timer: (1, 0.0))


@pytest.mark.usefixtures("one_call")
@pytest.mark.slow
def test_the_speed_command_writes_json_and_prints_a_table(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(speed, "cases", lambda: {**QUICK, "peer": partial(__import__, "no_such_package")})
    file = tmp_path / "new" / "speed.json"
    assert speed.main(["--quick", "--json", str(file)]) == 0
    found = json.loads(file.read_text())
    assert list(found["ratios"]) == [*speed.RATIOS]
    assert found["ratios"]["scalar_vs_pendulum"] > 0
    assert found["ratios"]["vector1024_vs_envpool_pendulum"] is None
    assert [(row["name"], row["steps_per_s"] > 0) for row in found["rows"]] == [(name, True) for name in QUICK]
    assert found["skipped"] == {"peer": "ModuleNotFoundError: No module named 'no_such_package'"}
    said = capsys.readouterr().out
    assert all(name in said for name in (*found["ratios"], "skipped: ModuleNotFoundError", "Pendulum-v1 scalar"))


@pytest.mark.slow
@pytest.mark.usefixtures("one_call")
def test_every_row_of_ours_can_be_made_and_steps():
    wanted = {name: make for name, make in speed.cases(8, 2).items() if not name.startswith("EnvPool")}
    result = speed.measure(wanted, 1)
    assert result["skipped"] == {}
    assert len(result["rows"]) == len(wanted)


def test_runs_are_kept_and_the_table_has_each_seed(tmp_path, monkeypatch, capsys):
    trained = []

    def train(name, seed):
        trained.append((name, seed))
        return [(stock.LEARNERS[name].words, seed, steps, 0.1 + seed, 0.005) for steps in (1_000_000, 2_000_000)]

    monkeypatch.setattr(stock, "train", train)
    name = next(iter(stock.LEARNERS))
    for seeds in ("1", "2"):
        assert stock.main([name, "--seeds", seeds, "--out", str(tmp_path)]) == 0
    assert trained == [(name, 0), (name, 1)]
    assert (
        f"| {stock.LEARNERS[name].words} | 2 M | 2 | 0.100 / 1.100 | 0.5 / 0.5 |" in (tmp_path / "table.md").read_text()
    )
    assert capsys.readouterr().out.count("# Stock learners") == 2
    assert stock.main(["sac", "--out", str(tmp_path)]) == 2
    assert "unknown learner 'sac'" in capsys.readouterr().err
    (tmp_path / "runs.csv").write_text("learner\n\nppo")
    assert stock.main([name, "--out", str(tmp_path)]) == 2
    assert "no runs of this study, or damaged" in capsys.readouterr().err


# Robustness: the search on a grid and the altered policy


def test_robustness_is_the_largest_change_that_a_bisection_finds():
    assert [robustness.largest((1.0, 2.0, 3.0, 4.0), lambda x, end=end: x <= end) for end in (0.5, 1.0, 3.5, 9.0)] == [
        None, 1.0, 3.0, 4.0,
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["paper-tuned", "gradient", "ppo"])
def test_an_altered_policy_scales_the_pull_and_holds_its_setpoints_back(name):
    """Unaltered it does what the policy does in its own environment, whose actions may be moves."""
    policy, config = robustness.with_setpoints(name, 0.1)
    same = rollout(robustness.Altered(policy, config), config, [1, 2])
    own, its = robustness.policy_and_config(name, "randomized", 0.1)
    plain = rollout(own, its, [1, 2])
    np.testing.assert_allclose(same.signals.v_p, plain.signals.v_p, rtol=1e-5)
    late = rollout(robustness.Altered(policy, config, factor=2.0, late=3), config, [1, 2]).signals
    v_0 = config.parameters.v_0
    np.testing.assert_array_equal(late.v_p[:3], v_0)
    np.testing.assert_allclose(late.v_p[3] - v_0, 2.0 * (plain.signals.v_p[0] - v_0), rtol=1e-3, atol=1e-6 * v_0)


def test_a_report_shows_robustness_of_this_contract_and_of_these_agent_files(monkeypatch, tmp_path):
    monkeypatch.setattr(robustness, "robustness", lambda *_: (2.0, 0.5, 5.0))
    assert robustness.main(["lqg", "gradient", "--out", str(tmp_path)]) == 0
    file = tmp_path / "robustness.csv"
    both = {"lqg": ("2", "0.5", "5"), "gradient": ("2", "0.5", "5")}
    assert earlier_robustness(file) == both
    hashes = contract_hash([robustness.SCENARIO]), agent_hash("gradient")
    for old, left in zip(hashes, ({}, {"lqg": both["lqg"]}), strict=True):
        other = tmp_path / "other.csv"
        other.write_text(file.read_text().replace(old, "0123456789ab"))
        assert earlier_robustness(other) == left
    assert set(robustness.CONTROLLERS) >= set(earlier_robustness(ROOT / "results" / "robustness" / "robustness.csv"))


# Faults: a row made anew


def test_a_fault_made_anew_leaves_the_other_rows_of_the_report(monkeypatch, tmp_path, capsys):
    grown = []
    monkeypatch.setattr(faults, "make_block", lambda name, _: name)
    monkeypatch.setattr(faults, "CompiledBlock", lambda block: block)
    monkeypatch.setattr(faults, "grow", lambda name, fault, *_: grown.append((name, fault)) or made)
    command, made = ["--crystals", "2", "--out", str(tmp_path)], faults.Row(0.25, 0, 0, faults.Alarm(1), 0.1)
    assert faults.main(["paper-tuned", "lqg", *command]) == 0
    before, count = (tmp_path / "report.md").read_text().splitlines(), len(grown)
    made = faults.Row(0.5, 3, 1, faults.Alarm(0), 0.0)
    row = "operator left -0.1 mm/min"
    assert faults.main(["lqg", *command, "--fault", row]) == 0
    after = (tmp_path / "report.md").read_text().splitlines()
    assert grown[count:] == [("lqg", row)]
    changed = [pair for pair in zip(before, after, strict=True) if pair[0] != pair[1]]
    assert [new for _, new in changed] == [f"| lqg | {row} | 0.500 | 2.00 | 3 (1) | 0.0% |  |"]
    assert faults.main(["lqg", "--crystals", "3", "--out", str(tmp_path), "--fault", row]) == 2
    assert "give its --crystals" in capsys.readouterr().err
    assert (tmp_path / "report.md").read_text().splitlines() == after


# Ranks under moved estimates, and the limit


@pytest.mark.slow
def test_the_limit_is_what_a_simulated_linear_loop_has():
    """Error and pull step of the filter and the regulator on the linear plant, from 4,000 runs of independent noise."""
    puller, price, rng = make_puller(lam=0.5), 1.0, np.random.default_rng(5)
    loop = ranks.linear_loop(puller, ranks.CAMERA, 1.0, price)
    error, step = ranks.linear_error(puller, ranks.CAMERA, 1.0, price)
    n, known = 4000, len(loop.A)
    x, estimate, u = np.zeros((n, known)), np.zeros((n, known)), np.zeros((n, 2))
    for _ in range(4000):
        reading = x @ loop.H.T + rng.normal(size=(n, 2)) @ np.sqrt(loop.R)
        estimate = estimate + (reading - estimate @ loop.H.T) @ loop.learns.T
        move = -np.concatenate([estimate, u], axis=1) @ loop.F.T
        u = u + move
        x = x @ loop.A.T + u @ loop.B.T + rng.multivariate_normal(np.zeros(known), loop.Q, n)
        estimate = estimate @ loop.A.T + u @ loop.B.T
        if _ == 3999:
            assert 1e-3 * np.sqrt((x[:, 0] ** 2).mean()) == pytest.approx(error, rel=0.05)
            assert np.sqrt((move[:, 0] ** 2).mean()) * ranks.MM_PER_MIN == pytest.approx(step, rel=0.05)


def test_the_limit_falls_with_the_zero_and_grows_with_the_noise():
    puller = make_puller(lam=0.5)
    assert ranks.zero_of(1.0) == pytest.approx(radius_model(puller).zero, rel=1e-9)
    by_gain = [ranks.limit(puller, ranks.CAMERA, gain) for gain in ranks.GAINS]
    by_noise = [ranks.limit(puller, noise) for noise in ranks.NOISES]
    assert by_gain == sorted(by_gain)
    assert by_noise == sorted(by_noise)


def test_places_go_by_crystals_lost_then_by_cost():
    found = [(0, 2.0), (1, 0.5), (0, 1.0)]
    metrics = {
        str(k): SimpleNamespace(failure_rate=np.array([n]), cost=np.array([c])) for k, (n, c) in enumerate(found)
    }
    assert ranks.places(metrics) == [1, 2, 0]


def test_who_moves_less_has_a_larger_least_error_and_moving_more_gains_nothing_in_the_end():
    puller = make_puller(lam=ranks.MIX)
    least = [ranks.limit(puller, ranks.CAMERA, activity=step / 60000.0) for step in (0.01, 0.02, 5.0, 50.0)]
    assert least[0] > least[1] > least[2] == least[3]


@pytest.mark.slow
def test_sensors_alone_and_together_are_rows_of_a_table(tmp_path):
    assert sensors.main(["--crystals", "1", "--out", str(tmp_path)]) == 0
    rows = [line for line in (tmp_path / "table.md").read_text().splitlines() if line.startswith("| ")][1:]
    assert [row.split(" | ")[0].strip("| ") for row in rows] == [", ".join(choice) for choice in sensors.CHOICES]


@pytest.mark.slow
def test_ranks_write_their_table_and_figure(tmp_path):
    assert ranks.main(["paper-filtered", "pid-conventional", "--crystals", "2", "--out", str(tmp_path)]) == 0
    table = (tmp_path / "table.md").read_text()
    assert all(f"| {each.about} | " in table for each in ranks.variants())
    assert (tmp_path / "ranks.png").read_bytes().startswith(b"\x89PNG")


# README's moving picture, its result and its words

README = ROOT / "README.md"


def test_a_frame_shows_both_sides_and_the_picture_moves():
    frames = [*picture.frames(time=60.0)]
    assert {frame.shape for frame in frames} == {(picture.SIZE[1], 2 * picture.SIZE[0], 3)}
    assert len(frames) == 12 // picture.EVERY + 1
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 100
    with Image.open(io.BytesIO(picture.moving(frames))) as image:
        assert (image.format, image.n_frames) == ("GIF", len(frames) + 1)
        first, length = np.asarray(image.convert("RGB")), image.info["duration"]
        image.seek(image.n_frames - 1)
        assert length == image.info["duration"] == 2000
        assert np.array_equal(first, np.asarray(image.convert("RGB")))  # the end stands first, and stays


def test_the_committed_results_fill_pages_and_pictures_again(tmp_path, monkeypatch):
    page, results = tmp_path / "page.md", tmp_path / "benchmark.json"
    page.write_text("a <!-- finding:begin --><!-- finding:end --> b <!-- benchmark:begin --><!-- benchmark:end -->")
    results.write_bytes((ROOT / "results" / "benchmark" / "benchmark.json").read_bytes())
    monkeypatch.setattr(picture, "PAGES", [page])
    assert picture.main([str(results)]) == 0
    (said,) = re.findall(r"begin -->\n(\*\*Not told .*)\n<!-- finding:end", page.read_text())
    assert said in README.read_text()
    for name in ("result.svg", "pareto.svg"):
        assert (tmp_path / name).read_bytes() == (ROOT / "results" / "benchmark" / name).read_bytes()


def test_readmes_first_screen_is_short_and_light():
    text = README.read_text()
    words = re.sub(r"```.*?```|<!--.*?-->|\]\([^)]*\)", " ", text, flags=re.DOTALL)
    assert len(re.findall(r"\w[\w.'-]*", words)) <= 450
    assert text[: text.index("```")].count("\n") < 40
    pictures = [ROOT / name for name in re.findall(r"!\[[^]]+\]\(([^)]+)\)", text)]
    assert [each.name for each in pictures] == ["lost-and-held.gif", "result.svg"]
    assert sum(each.stat().st_size for each in pictures) < 1_500_000


@pytest.mark.parametrize("name", ["benchmark", "crystal", "bounds", "frontier"])
def test_every_report_shows_its_pictures(name):
    folder = ROOT / "results" / name
    shown = re.findall(r"^!\[[^]]+\]\(([^)]+)\)$", (folder / "report.md").read_text(), re.MULTILINE)
    assert "pareto.svg" in shown
    assert all((folder / each).is_file() for each in shown)
