"""Path tracing with Mitsuba 3: the only package that imports mitsuba, and only in worker processes.

variants   which Mitsuba variant runs on this machine (probed in a subprocess); imports no mitsuba
tracer     the worker: one bundle, many views, EXR files
"""
