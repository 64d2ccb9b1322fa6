"""The plant's hash follows from what it computes, not from a number bumped by hand (trap 5)."""

from cz_gym import HURLE, Parameters
from cz_gym.body.process import BODY
from cz_gym.config import make_config
from cz_gym.jit import hash_files, jittable


def test_a_changed_equation_is_another_plant_and_the_same_said_otherwise_is_not(monkeypatch):
    def with_rates(change):
        return make_config(process=BODY._replace(rates=lambda *at: change(BODY.rates(*at)))).plant_hash

    assert with_rates(lambda x: x) == make_config().plant_hash
    assert with_rates(lambda x: x._replace(T_b=x.T_b * (1.0 + 1e-8))) != make_config().plant_hash
    assert with_rates(lambda x: x._replace(T_b=x.T_b * (1.0 + 1e-14))) == make_config().plant_hash
    assert make_config(parameters=Parameters(eps=0.201)).plant_hash != make_config().plant_hash


def stretched(by):
    """Hurle's meniscus, its height stretched."""

    @jittable
    def height(r_c, theta, a):
        return by * HURLE.height(r_c, theta, a)

    return HURLE._replace(name="stretched", height=height)


def test_two_menisci_of_one_factory_are_two_plants():
    hashes = {make_config(meniscus=stretched(by)).plant_hash for by in (1.0, 1.01, 1.02)}
    assert len(hashes) == 3
    assert make_config().plant_hash in hashes
    assert make_config(meniscus=stretched(1.01)).plant_hash in hashes
    assert make_config(meniscus=HURLE._replace(name="another name")).plant_hash == make_config().plant_hash


def test_the_hash_of_files_counts_code_and_not_text(tmp_path):
    module, hashes = tmp_path / "thing.py", []
    for text in ('"""A."""\nx = 1\n"""B."""\n', '"""C."""\n# why\nx = (\n    1\n)\n', "x = 2\n"):
        module.write_text(text)
        hashes.append(hash_files([module]))
    assert hashes[0] == hashes[1] != hashes[2]
    assert hash_files([module]) != hash_files([module.rename(tmp_path / "other.py")])
