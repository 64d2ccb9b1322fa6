"""Controllers outside Python: C99 and IEC 61131-3 structured text, both written from one description.

:mod:`cz_gym.export.trace` records what a controller computes as a list of operations on numbers of fixed length.
:mod:`cz_gym.export.shell` puts limits, takeover, hold and fallback around it. :mod:`cz_gym.export.program` runs the
recorded operations in NumPy; :mod:`cz_gym.export.text` writes them.
"""
