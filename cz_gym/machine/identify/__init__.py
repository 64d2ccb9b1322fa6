"""Identification of a puller from its log: excitation, log reader, estimation, report.

``cz-gym identify LOG.csv --puller start.toml --out my.toml`` does it in one command.
"""

from .estimate import Identified, identify
from .excitation import Excited
from .grid import Log
from .log import read_log, record_log

__all__ = ["Excited", "Identified", "Log", "identify", "read_log", "record_log"]
