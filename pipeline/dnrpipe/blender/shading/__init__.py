"""Blender's materials -> Mitsuba BSDFs and textures."""
