"""``python -m studies.paper --out results/paper``: Part II of the paper, redone on our plant (docs/paper.md)."""

import argparse
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path

from cz_gym import HURLE, make_puller
from cz_gym.baselines.analysis.compensator_design import design_compensator, margins
from cz_gym.baselines.pid.compensated_pid import CompensatedPID
from cz_gym.body.linearisation import radius_model
from cz_gym.evaluation.report.tables import markdown as table
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.support.atomic_files import check_writable, write_files
from cz_gym.support.command_line import OneLineParser
from cz_gym.support.units import MM

from . import experiments as ex
from .comparison import as_markdown, numbers, rows
from .experiments import CROSSOVER, PHASE_MARGIN_DEG, PID

CUT_OFFS = (1e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
"""High-pass cut-offs compared [rad/s]; 2e-4 is the paper's."""


def report(captions: Mapping[str, str]) -> str:
    """The whole report: template.md, filled in, with figures of these captions."""

    def figures(*marks: str) -> str:
        shown = {name: caption for name, caption in captions.items() if name.startswith(marks)}
        return "\n\n".join(f"![{caption}]({name})\n\n*{caption}*" for name, caption in shown.items())

    return Path(__file__).with_name("template.md").read_text("utf-8").format(
        CROSSOVER=CROSSOVER, PHASE_MARGIN_DEG=PHASE_MARGIN_DEG, PID=PID, ramp=ex.ramp_numbers(ex.ramp("I")),
        comparison=as_markdown(rows()), open_loop=figures("figure_02", "figure_03"), bode=figures("figure_09"),
        closed_loop=figures("figure_11", "figure_12", "figure_13", "figure_14"), margins=_margins(),
        without=_without(), cut_offs=_cut_offs(), menisci=_menisci(),
    )  # fmt: skip


def _table(head: str, lines: Iterable[Iterable[str]]) -> str:
    """A table; the names of its columns are separated by |."""
    return table(head.split(" | "), lines, "---")


def _margins() -> str:
    lines = []
    for compensated, source, model in product((True, False), ex.SOURCES, ex.MODELS):
        m = ex.loop_margins(source, model, compensated)
        numbers = f"{m.crossover:.4f}", f"{m.phase_margin_deg:.1f}", "yes" if m.stable else "no"
        poles = ", ".join(f"{pole:.3g}" if pole.imag else f"{pole.real:.3g}" for pole in m.poles)
        functions = source if source == "published" else "our plant"
        lines.append((model, functions, "with" if compensated else "without", *numbers, poles))
    head = "model | functions | compensator | crossover [rad/s] | phase margin [deg] | stable | poles [rad/s]"
    return _table(head, lines)


def _without() -> str:
    """The ramp without the compensator, beside the ramp with it."""
    lines = []
    for (label, policy), model in product((("with", ex.PRINTED), ("without", ex.BARE)), ex.MODELS):
        run = ex.ramp(model, policy)
        n = ex.ramp_numbers(run)
        fate = f"lost after {n['lived_min']:.0f} min" if run.failed else "kept"
        errors = f"{n['rmse_mm']:.3f}", f"{n['max_error_mm']:.2f}"
        lines.append((model, label, fate, *errors, f"{100 * n['at_limit']:.0f} %", f"{n['late_swing_mm']:.2f}"))
    head = (
        "model | compensator | crystal | true RMSE [mm] | largest true error [mm] | time at a pull limit | "
        "swing of r_c in its last hour [mm]"
    )
    return _table(head, lines)


def _cut_offs() -> str:
    lines = []
    for cut_off in CUT_OFFS:
        compensator, line = design_compensator(ex.linear_model("own", "I"), cut_off), [f"{cut_off:.0e}"]
        for model in ex.MODELS:
            run = ex.ramp(model, CompensatedPID(compensator=compensator))
            largest = ["lost"] * 2 if run.failed else [f"{abs(error).max() / MM:.2f}" for error in ex.errors(run)]
            margin = margins(ex.linear_model("own", model), compensator, PID).phase_margin_deg
            line += [*largest, f"{margin:.0f}"]
        lines.append(line)
    columns = "r_c, {0} [mm] | r_tilde, {0} [mm] | margin, {0} [deg]"
    return _table(" | ".join(["cut-off [rad/s]", *map(columns.format, ex.MODELS)]), lines)


def _menisci() -> str:
    both = []
    for meniscus in (HURLE, YOUNG_LAPLACE):
        puller = make_puller(meniscus=meniscus)
        linear = radius_model(puller, meniscus)
        rate, error = linear.numerator / puller.v_0, ex.ramp_numbers(ex.ramp("I", meniscus=meniscus))["max_error_mm"]
        both.append((puller.h_0 / MM, rate * MM, puller.ring_bias / MM, linear.lead, linear.zero, error))
    names = (
        *("height [mm]", "d alpha_c/d h [rad/mm]", "ring less radius [mm]", "coefficient of s in G_m [s]"),
        *("zero [rad/s]", "largest error in the ramp [mm]"),
    )
    lines = [(name, *(f"{value:.4f}" for value in values)) for name, *values in zip(names, *both, strict=True)]
    return _table("quantity | Hurle | exact", lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.paper", "Part II of the paper, redone on our plant.")
    parser.add_argument("--out", type=Path, default=Path("results/paper"), help="folder for the results")
    return parser.run(_compare, arguments, "benchmark")


def _compare(given: argparse.Namespace) -> None:
    import control  # noqa: F401  (missing? say so before the work, not after it)

    from cz_gym.evaluation.report.canvas import png

    from .figures import FIGURES

    check_writable(given.out)
    files = {"report.md": report({name: caption for name, (caption, _) in FIGURES.items()}).encode()}
    files |= {name: png(draw()) for name, (_, draw) in FIGURES.items()}
    files["numbers.json"] = (json.dumps(numbers(), indent=2, allow_nan=False) + "\n").encode()
    write_files({given.out / name: content for name, content in files.items()})
    print(as_markdown(rows()))
    print(f"\nreport: {given.out / 'report.md'}")


if __name__ == "__main__":
    sys.exit(main())
