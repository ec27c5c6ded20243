"""Everything that imports bpy. Modules that do run in worker processes of their own.

`tasks`, `finding_lines`, `geometry.frozen` and `passes.choice` do not import bpy and may be used anywhere.
"""
