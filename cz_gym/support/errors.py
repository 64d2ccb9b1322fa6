"""The error that this project raises on purpose."""


class CzError(ValueError):
    """An error whose message tells the user what to change.

    Commands print it as one line; every other exception is a bug, the user's or ours, and keeps its traceback.
    """


class UnexpectedKeyword(CzError, TypeError):
    """A keyword that a function does not have: a TypeError with Python's words, for libraries that look for those."""
