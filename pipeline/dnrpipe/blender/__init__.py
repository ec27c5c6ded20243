"""Everything that imports bpy. Each module here that does runs in worker processes of its own.

``frozen`` and ``choice`` do not import bpy and may be used anywhere.
"""
