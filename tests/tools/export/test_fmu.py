"""The puller as a co-simulation unit, run by FMPy: the same crystal as in the environment, bit for bit."""

import atexit
import subprocess
import sys

import fmpy
import pytest
from fmpy.validation import validate_fmu

from cz_gym import CzEnv, decode, make_puller
from cz_gym.puller.file import find_puller
from cz_gym.support.units import MM
from cz_gym.tools.export.block import SETPOINT_NAMES, in_plant_units, in_shares, nominal_puller
from cz_gym.tools.export.command import main
from cz_gym.tools.export.fmu import SHOWN, TRUTH

OUTPUT = ["growing", TRUTH.name, *SETPOINT_NAMES, *SETPOINT_NAMES.values()]


@pytest.fixture(scope="module")
def unit(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unit")
    assert main(["--plant", "--to", "fmu", "--out", str(folder)]) == 0
    return str(folder / "CzPuller.fmu")


@pytest.mark.parametrize("own", [(), ("--puller", "silicon-300mm")])
def test_fmpy_grows_the_crystal_of_the_environment(own, tmp_path):
    assert main(["--plant", "--to", "fmu", "--out", str(tmp_path), *own]) == 0
    env = CzEnv("hard", observation="measured", action="direct", puller=own[1] if own else None)
    config, puller, dt = env.config, nominal_puller(env.config), env.config.control_interval
    file = str(tmp_path / "CzPuller.fmu")
    model = fmpy.read_model_description(file)
    at = {variable.name: variable.valueReference for variable in model.modelVariables}
    unit = fmpy.instantiate_fmu(fmpy.extract(file, str(tmp_path / "unit")), model)

    def shown():
        get = {True: unit.getBoolean, False: unit.getReal}
        return {port.name: get[port.logical]([at[port.name]])[0] for port in (*SHOWN, TRUTH)}

    def expected(observation, info):
        seen = in_plant_units(decode(observation.astype(float), *config.ranges), puller)
        return seen | {TRUTH.name: info["r_c"] / MM}

    unit.setupExperiment(startTime=0.0)
    unit.enterInitializationMode()
    unit.setInteger([at["seed"]], [7])
    unit.setString([at["scenario"]], ["hard"])
    unit.exitInitializationMode()
    assert shown() == expected(*env.reset(seed=7))
    for k in range(60):
        values = puller.v_0 * 6e4 * (1.0 + 0.01 * (k % 7)), puller.Q_H_0 / 1e3 + 0.02 * k
        setpoints = dict(zip(SETPOINT_NAMES, values, strict=True))
        unit.setReal([at[name] for name in setpoints], values)
        unit.doStep(k * dt, dt)
        observation, *_, info = env.step(in_shares(setpoints, config).clip(-1.0, 1.0))
        assert shown() == expected(observation, info)
    assert unit.getBoolean([at["growing"]]) == [1]


def test_the_description_is_valid_and_says_units(unit):
    assert validate_fmu(unit) == []
    model = fmpy.read_model_description(unit)
    units = {each.name: each.unit for each in model.modelVariables if each.type == "Real"}
    assert {units[name] for name in SETPOINT_NAMES} == {"mm/min", "kW"}
    assert None not in units.values()
    assert {each.name: each.baseUnit.factor for each in model.unitDefinitions} == {
        "mm": 1e-3, "mm/min": pytest.approx(1e-3 / 60.0), "K": 1.0, "kW": 1e3,
    }  # fmt: skip
    assert "no sensor" in next(each.description for each in model.modelVariables if each.name == TRUTH.name)


@pytest.mark.parametrize("given", [{}, {"pull_speed_setpoint_mm_per_min": 0.55}])
def test_setpoints_begin_at_the_operating_point_of_the_puller_that_the_parameter_names(unit, given):
    """A unit of the default puller whose user sets the parameter ``puller``: its 1.2 mm/min would lose germanium."""
    last = fmpy.simulate_fmu(unit, stop_time=600.0, start_values={"puller": "germanium", **given}, output=OUTPUT)[-1]
    assert last["pull_speed_setpoint_mm_per_min"] == given.get("pull_speed_setpoint_mm_per_min", 0.5)
    assert last["heater_power_setpoint_kW"] == pytest.approx(8.12, abs=0.01)
    assert last["growing"]


def test_a_step_that_is_refused_is_an_error_and_not_the_end_of_the_run(unit):
    """FMPy #353: a step that is discarded ends the run without an error."""
    code = f"import fmpy; fmpy.simulate_fmu({unit!r}, stop_time=600.0, output_interval=7.0, debug_logging=True)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 1
    assert "fmi2DoStep failed" in run.stderr
    assert "a step must be a multiple of the control interval, 5 s, not 7 s" in run.stdout


def test_a_folder_with_a_space_holds_a_unit(unit, tmp_path):
    """FMPy #230: pythonfmu reads spaces in paths; what it does not read is on the page."""
    folder = fmpy.extract(unit, str(tmp_path / "a unit"))
    assert len(fmpy.simulate_fmu(folder, stop_time=10.0)) == 3


@pytest.mark.skipif(sys.platform != "linux", reason="the last function of the C library on Linux")
def test_a_unit_ends_before_its_python(unit, monkeypatch):
    """PythonFMU #228: its library frees its state twice at the end of a process, which aborts then now and again."""
    ended, register = list[str](), atexit.register

    def note(function, *given):
        ended.append(function.__name__)
        register(function, *given)

    monkeypatch.setattr(atexit, "register", note)
    for count in (1, 2):  # the second is another copy of the library
        assert len(fmpy.simulate_fmu(unit, stop_time=10.0)) == 3
        assert ended.count("finalizePythonInterpreter") == count


@pytest.mark.slow
def test_units_of_one_process_are_each_its_own(tmp_path):
    """PythonFMU #97: Python keeps one module of a name, so the second unit was silently the first."""
    own = {
        "nominal": ("--scenario", "nominal"),
        "ramp": ("--scenario", "paper-ramp"),
        "germanium": ("--puller", "germanium", "--scenario", "nominal"),
    }
    for name, options in own.items():
        assert main(["--plant", "--to", "fmu", "--out", str(tmp_path / name), *options]) == 0
    code = (
        "import sys, fmpy\nfor file in sys.argv[1:]:\n"
        "    print(fmpy.simulate_fmu(file + '/CzPuller.fmu', stop_time=1200, output=['T_1_ref_K'])[-1][1])"
    )
    rest, germanium = make_puller().T_1_0, make_puller(find_puller("germanium").parameters).T_1_0
    expected = {"nominal": rest, "ramp": rest + 5.0, "germanium": germanium}
    for names in ([*own], [*reversed(own)]):
        run = subprocess.run([sys.executable, "-c", code, *names], cwd=tmp_path, capture_output=True, text=True)
        ends = [float(line) for line in run.stdout.split()]
        assert ends == pytest.approx([expected[name] for name in names], abs=1e-3)
