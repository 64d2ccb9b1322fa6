"""The puller as a co-simulation unit, run by FMPy: the same crystal as in the environment, bit for bit."""

import fmpy
import pytest

from cz_gym import CzEnv
from cz_gym.machine.export.__main__ import main
from cz_gym.machine.export.fmu import SHOWN
from cz_gym.machine.export.ports import OUTPUTS, in_plant_units, in_shares, nominal_puller
from cz_gym.observation import decode


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
        return {port.name: get[port.logical]([at[port.name]])[0] for port in SHOWN}

    def expected(observation):
        return in_plant_units(decode(observation.astype(float), *config.ranges), puller)

    unit.setupExperiment(startTime=0.0)
    unit.enterInitializationMode()
    unit.setInteger([at["seed"]], [7])
    unit.setString([at["scenario"]], ["hard"])
    unit.exitInitializationMode()
    assert shown() == expected(env.reset(seed=7)[0])
    for k in range(60):
        values = puller.v_0 * 6e4 * (1.0 + 0.01 * (k % 7)), puller.Q_H_0 / 1e3 + 0.02 * k
        setpoints = dict(zip((port.name for port in OUTPUTS), values, strict=False))
        unit.setReal([at[name] for name in setpoints], values)
        unit.doStep(k * dt, dt)
        assert shown() == expected(env.step(in_shares(setpoints, config).clip(-1.0, 1.0))[0])
    assert unit.getBoolean([at["growing"]]) == [1]
    with pytest.raises(Exception, match="fmi2DoStep"):
        unit.doStep(60 * dt, 0.5 * dt)
