"""Controllers outside Python: C99 and IEC 61131-3 structured text, both written from one description.

:mod:`.shell` puts limits, takeover, hold, fallback and alarms around a controller, out of the parts in :mod:`.block`.
:mod:`.trace` records a block as a list of operations on numbers of fixed length; :mod:`.writer` and :mod:`.text` write
them. :mod:`.controllers` finds controllers and agents by name.
"""
