"""Blender's lamps and world -> Mitsuba emitters."""
