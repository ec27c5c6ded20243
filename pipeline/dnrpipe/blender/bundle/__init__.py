"""The portable Mitsuba bundle: XML, meshes, units, display transform."""
