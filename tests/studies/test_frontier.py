"""The frontier command on made-up benchmarks."""

import json

from studies import frontier


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
