"""dnrtrain: the deferred neural renderer and its view selector (torch; no Blender, no Mitsuba).

Submodules are imported where they are used: ``import dnrtrain`` itself costs nothing.
"""
