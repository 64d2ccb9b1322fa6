"""Posterior of an identification: as comments of a puller file, as joint draws, and margins of loops over them."""

import math
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from cz_gym.baselines import margins
from cz_gym.baselines.analysis import Lags, linear_form
from cz_gym.baselines.margins import (
    DRAWS,
    EXPLAINED,
    NO_MARGIN,
    PLACES,
    POINTS,
    SHARE,
    Margin,
    Openings,
    lags_of,
    openings,
    worst_margins,
    worst_of,
)
from cz_gym.config import Config
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.evaluation.rollout import Floats
from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import make_puller
from cz_gym.puller.file import PullerFile
from cz_gym.support.errors import CzError

MARK = "identify: posterior"
"""Beginning of the comments that hold a posterior, one number a line: name, standard deviation, correlations with the
numbers above. A deviation is that of the logarithm [-], of the dead time in seconds.
"""
_LINE = re.compile(rf"# {MARK} (\w+) (\S+)((?: \S+)*)$")
DEAD_TIME = "heater_dead_time"


@dataclass(frozen=True)
class Posterior:
    """Gaussian posterior of the logarithms of a puller's numbers (of the dead time itself [s])."""

    names: tuple[str, ...]
    covariance: Floats

    def lines(self) -> list[str]:
        """Comments of a puller file that :meth:`of` reads."""
        sd = np.sqrt(np.diag(self.covariance))
        correlation = self.covariance / np.outer(sd, sd)
        rows = (
            (name, f"{sd[at]:.4g}", *(f"{each:.3f}" for each in correlation[at, :at]))
            for at, name in enumerate(self.names)
        )
        return [f"# {MARK} {' '.join(row)}" for row in rows]

    @classmethod
    def of(cls, puller: PullerFile) -> "Posterior | None":
        """The posterior in a puller's file; None without one. CzError if it is damaged."""
        text = puller.file.read_text("utf-8-sig") if puller.file is not None and puller.file.is_file() else ""
        found = [each for line in text.splitlines() if (each := _LINE.match(line))]
        if not found:
            return None
        try:
            names, sd = tuple(each[1] for each in found), np.array([float(each[2]) for each in found])
            correlation = np.eye(len(names))
            for at, each in enumerate(found):
                correlation[at, :at] = correlation[:at, at] = np.array(each[3].split(), float)
        except ValueError:
            raise CzError(f"{puller.file}: its comments '{MARK}' are damaged: identify the puller again") from None
        return cls(names, correlation * np.outer(sd, sd))

    def draws(self, puller: PullerFile, lags: Lags) -> Iterator[tuple[Parameters, Lags]]:
        """Joint draws around a puller and the lags of its loop; those of no possible puller are left out."""
        values, vectors = np.linalg.eigh(self.covariance)
        root, random = vectors * np.sqrt(np.maximum(values, 0.0)), np.random.default_rng(0)
        while True:
            away = dict(zip(self.names, root @ random.standard_normal(len(values)), strict=True))
            factors = {name: float(np.exp(move)) for name, move in away.items()}
            own = {
                name: getattr(puller.parameters, name) * by
                for name, by in factors.items() if name in Parameters._fields
            }  # fmt: skip
            late = max(lags.heater_dead_time + away.get(DEAD_TIME, 0.0), 0.0)
            lag, slow = (getattr(lags, name) * factors.get(name, 1.0) for name in ("heater_lag", "pyrometer_filter"))
            yield puller.parameters._replace(**own), Lags(lags.latency, lag, late, slow)


def quantiles(policy: Any, config: Config, posterior: Posterior, draws: int = DRAWS) -> Openings:
    """Margins that all but a :data:`SHARE` of joint draws have, each on the worse of Models I and II."""
    form = linear_form(policy, config.scenario.scenarios[0].sensor)
    found: list[Openings] = []
    for parameters, lags in islice(posterior.draws(config.puller, lags_of(config)), 10 * draws):
        with suppress(CzError, FloatingPointError):
            pullers = [make_puller(parameters, lam, config.meniscus) for lam in (1.0, 0.0)]
            both = openings(form, pullers, lags, POINTS // 2)
            found.append(Openings(*(worst_of(each) for each in zip(*both, strict=True))))
        if len(found) == draws:
            break
    at = int(SHARE * len(found))
    places = []
    for each in zip(*found, strict=True):
        low, high = (np.sort(np.array(each), axis=0)[row] for row in (at, -1 - at))
        places.append(Margin(*map(float, (low[0], high[1], low[2], low[3], high[4]))))
    return Openings(*places)


def shown(policy: Any, config: Config) -> list[tuple[str, ...]]:
    """Rows of :func:`cz_gym.baselines.margins.shown`; their quantiles are over the posterior in the puller's file, if
    it has one.
    """
    posterior = Posterior.of(config.puller)
    nominal = None if posterior is None else worst_margins(policy, config)
    if posterior is None or nominal is None or nominal.ring == NO_MARGIN:
        return margins.shown(policy, config)
    both = zip(nominal, quantiles(policy, config, posterior), strict=True)
    return [
        (place, *(f"{_text(value)} ({_text(one, least == NO_MARGIN)})" for value, one in zip(own, least, strict=True)))
        for place, (own, least) in zip(PLACES, both, strict=True)
    ]


def _text(value: float, unstable: bool = False) -> str:
    return "unstable" if unstable else f"{value:.3g}" if 0.0 < value < math.inf else "no limit"


def explained(puller: PullerFile) -> str:
    """Say what the margins are, and over which pullers."""
    spread = f"that differ as those of {RANDOMIZED.name} do"
    own = "drawn from the identification in its file, all its numbers and delays together"
    return EXPLAINED if Posterior.of(puller) is None else EXPLAINED.replace(spread, own)
