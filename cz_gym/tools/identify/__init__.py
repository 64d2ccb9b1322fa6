"""Identification of a puller from its log: excitation, log reader, estimation, report.

``cz-gym identify LOG.csv --puller start.toml --out my.toml`` does it in one command.
"""

from .estimate import Identified, identify
from .log import Log, read_log, record_log
from .moves import Excited

__all__ = ["Excited", "Identified", "Log", "identify", "read_log", "record_log"]
