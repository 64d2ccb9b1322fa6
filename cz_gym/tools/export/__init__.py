"""Controllers outside Python: C99 and IEC 61131-3 structured text, both written from one description.

:mod:`.trace` records what a controller computes as a list of operations on numbers of fixed length. :mod:`.shell` puts
limits, takeover, hold and fallback around it. :mod:`.program` runs the recorded operations in NumPy; :mod:`.text`
writes them.
"""
